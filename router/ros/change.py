"""From the topics of one table to those of another: what stays open, what is opened beside it, what is closed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from time import sleep
from typing import TypeVar

from router.compiler.program import TopicPlan
from router.errors import SourceSpan, StartError
from router.ros.opened import Publication, Subscription
from router.ros.threads import MessageThread
from router.ros.types import checked_class

Opened = TypeVar("Opened", Publication, Subscription)

_ON_ITS_WAY_S = 0.005
"""For how long the middleware may still be handing a message to the second of two subscriptions."""


@dataclass(slots=True)
class RosChange:
    """All topics of the table that comes, by name; what was opened for it, and what it has no use for."""

    publications: dict[str, Publication]
    subscriptions: dict[str, Subscription]
    opened: Sequence[Publication | Subscription]
    left: Sequence[Publication | Subscription] = ()


def opened_beside(
    now: Mapping[str, Opened],
    plans: Sequence[TopicPlan],
    spans: Mapping[str, SourceSpan],
    open_one: Callable[[TopicPlan, type, SourceSpan], Opened],
) -> tuple[dict[str, Opened], list[Opened]]:
    """What `plans` want, by topic, and what of it was opened here: `now` is open. Raises StartError."""
    classes = {}
    for plan in plans:
        if plan.label in now and now[plan.label].plan.type_name != plan.type_name:
            kept = now[plan.label].plan.type_name  # DDS has one type for a topic in a process
            what = f"topic '{plan.label}' is {kept} in the running router, and cannot become {plan.type_name}"
            raise StartError(f"{spans[plan.label]}: {what} while it runs; restart it, or take another name")
        classes[plan.label] = checked_class(plan.type_name, plan.definitions, spans[plan.label])
    opened: list[Opened] = []
    with ExitStack() as opening:
        for plan in plans:
            if plan.label not in now or now[plan.label].plan != plan:
                opened.append(open_one(plan, classes[plan.label], spans[plan.label]))
                opening.callback(opened[-1].close)
        opening.pop_all()
    beside = {each.plan.label: each for each in opened}
    return {plan.label: beside.get(plan.label) or now[plan.label] for plan in plans}, opened


def left_by(kept: Mapping[str, Opened], now: Mapping[str, Opened]) -> list[Opened]:
    """What is open now and not kept."""
    return [each for topic, each in now.items() if kept.get(topic) is not each]


def hand_over(
    messages: MessageThread, now: Mapping[str, Subscription], then: Mapping[str, Subscription]
) -> list[tuple[str, bytes, int]]:
    """Has what arrived on subscriptions that are not kept received as until now, while `messages` is paused.

    A topic that has a new subscription in place of one hears each message twice, and takes it once: what came until now
    from the one that is left. Returns what came to the new one alone: topic, CDR bytes and when it set out.
    """
    left = left_by(then, now)
    anew = {each.plan.label: then[each.plan.label] for each in left if each.plan.label in then}
    if anew:
        sleep(_ON_ITS_WAY_S)  # what was taken from the one that is left before the pause has come to the other one then
    for each in anew.values():
        each.raw.take_all()
    if anew:
        sleep(_ON_ITS_WAY_S)
    heard = {each.plan.label: messages.finish(each.raw) for each in left}
    return [
        (topic, *message)
        for topic, each in anew.items()
        for message in each.raw.take_all()
        if message not in heard[topic]
    ]
