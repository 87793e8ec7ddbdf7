"""What clients may publish: every request is checked, counted and handed to ROS, or refused. Knows no socket."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from router.compiler.metrics import CLIENTS, GATEWAY_REJECT_REASONS, INBOUND_DROP_REASONS, Counters
from router.compiler.program import GatewayPlan, InboundPlan
from router.engine import Report
from router.engine.delivery import Feed as FeedDeadman
from router.engine.freshness import Freshness
from router.engine.pacing import RateLimit
from router.gateway.documents import PublishRequest
from router.gateway.json_longest import longest_text
from router.gateway.json_reading import InvalidMessageError, cdr_builder
from router.gateway.letters import Letter
from router.gateway.style import Style
from router.table.model import Gateway

_BESIDES = 4 << 10
"""Bytes that a document may have besides its message."""


class RefusedError(Exception):
    """What a client sent is not published. `reason` is one of GATEWAY_REJECT_REASONS or of INBOUND_DROP_REASONS."""

    def __init__(self, reason: str, detail: str, topic: str = "") -> None:
        super().__init__(detail)
        self.reason = reason
        self.topic = topic


@dataclass(frozen=True, slots=True)
class InletOutlets:
    """Where requests go. `publish` takes CDR bytes by topic and may raise `publish_errors`; `feed_deadman` is by
    the deadman's route, each called with the monotonic time before a message is published. Clocks in ns.
    """

    publish: Mapping[str, Callable[[bytes], None]]
    publish_errors: tuple[type[Exception], ...]
    feed_deadman: Mapping[str, FeedDeadman]
    report: Callable[[Report], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]


class _Topic:
    """One topic that clients may publish on."""

    def __init__(self, plan: InboundPlan, style: Style, counters: Counters, gateway: Gateway) -> None:
        self.plan = plan
        self.most = int(min(longest_text(plan.type, style) + _BESIDES, gateway.max_message))
        self.build = cdr_builder(plan.type, style)
        self.max_rate, ttl = plan.settings.topic.max_rate, plan.settings.ttl
        self.ttl = ttl.value if ttl else None
        self.may_pass = RateLimit(self.max_rate).may_pass if self.max_rate is not None else None
        self.published = counters.index("messages_published", gateway.name, plan.label)
        self.dropped = {
            reason: counters.index("messages_dropped", gateway.name, plan.label, reason)
            for reason in INBOUND_DROP_REASONS
        }


class Checked(NamedTuple):
    """A message that may be published, as CDR bytes. `time` is when the client says that it was sent."""

    topic: _Topic
    cdr: bytes
    time: float | None


class Inlet:
    """Of one gateway, for the thread that owns `counts`."""

    def __init__(
        self, plan: GatewayPlan, style: Style, counters: Counters, counts: list[int], outlets: InletOutlets
    ) -> None:
        name = plan.settings.name
        self._gateway = name
        self._topics = {topic: _Topic(each, style, counters, plan.settings) for topic, each in plan.inbound.items()}
        self._counts = counts
        self._outlets = outlets
        self._freshness = Freshness()
        self._accepted = counters.index("messages_received", name, CLIENTS)
        self._last = counters.index("route_last_message_timestamp_seconds", name)
        self._rejected = {
            reason: counters.index("datagrams_rejected", name, reason) for reason in GATEWAY_REJECT_REASONS
        }

    def reject(self, reason: str, detail: str = "") -> None:
        """Counts something that is not published."""
        self._counts[self._rejected[reason]] += 1
        self._outlets.report(Report("reject", self._gateway, "", reason, None, detail))

    def admit(self, letter: Letter) -> int:
        """Bytes of JSON to be read of a letter, at most. Raises RefusedError, not counted yet, if it need not be."""
        if letter.topic is None:
            return letter.size or 0
        most = self._allowed(letter.topic, letter.type_name).most
        if letter.size is None:
            return most
        if letter.size > most:
            detail = f"{letter.size} bytes are more than the {most} that any message of {letter.topic} has"
            raise RefusedError("too_large", detail, letter.topic)
        return letter.size

    def _allowed(self, name: str, type_name: str | None) -> _Topic:
        topic = self._topics.get(name)
        if topic is None:
            raise RefusedError("not_allowed", f"clients may not publish on '{name[:80]}'", name)
        wanted = topic.plan.type.name
        if type_name not in (None, wanted):
            raise RefusedError("wrong_type", f"{name} has the type {wanted}", name)
        return topic

    def check(self, request: PublishRequest) -> Checked:
        """Raises RefusedError, which is not counted yet. Any thread may call this."""
        topic = self._allowed(request.topic, request.type_name)
        if topic.ttl is not None and request.time is None:
            raise RefusedError("invalid", f"{request.topic} needs the time at which it was sent", request.topic)
        try:
            return Checked(topic, topic.build(request.data), request.time)
        except InvalidMessageError as error:
            raise RefusedError("invalid", str(error), request.topic) from error

    def publish(self, checked: Checked, arrived_ns: int) -> None:
        """Publishes what was checked, and arrived at `arrived_ns` of the wall clock.

        Raises RefusedError, which is counted and reported.
        """
        topic = checked.topic
        self._counts[self._accepted] += 1
        self._counts[self._last] = self._outlets.wall_ns()
        now = self._outlets.clock_ns()
        self._want_fresh(checked, arrived_ns, now)
        if topic.may_pass and not topic.may_pass(now):
            raise self._lost(topic, "rate_limited", f"more often than {topic.max_rate:g} Hz")
        if topic.plan.deadman is not None:
            self._outlets.feed_deadman[topic.plan.deadman.route](now)
        try:
            self._outlets.publish[topic.plan.label](checked.cdr)
        except self._outlets.publish_errors as error:
            raise self._lost(topic, "publish_error", str(error), error) from error
        self._counts[topic.published] += 1

    def _want_fresh(self, checked: Checked, arrived_ns: int, now: int) -> None:
        """Its age counts from when the client says that it was sent, or from its arrival if that is earlier."""
        ttl = checked.topic.ttl
        if ttl is None or checked.time is None:
            return
        stamp = round(min(max(checked.time, 0.0), arrived_ns / 1e9) * 1e9)
        age = now - self._freshness.born(stamp, self._outlets.wall_ns(), now)
        if age > ttl:
            detail = f"{age / 1e9:.3f} s old, and older than {ttl / 1e9:g} s; are both clocks right?"
            raise self._lost(checked.topic, "stale", detail)

    def _lost(self, topic: _Topic, reason: str, detail: str, error: Exception | None = None) -> RefusedError:
        self._counts[topic.dropped[reason]] += 1
        if reason != "rate_limited":  # which is what the table asks for
            self._outlets.report(Report("drop", self._gateway, topic.plan.label, reason, error, detail))
        return RefusedError(reason, detail, topic.plan.label)
