"""Turns a handler's code into a function: its namespace gets counters, senders, publishers, limits and machines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any

from router.compiler.metrics import Counters
from router.compiler.program import Handler, TargetPlan
from router.engine.collecting import Collector
from router.engine.delivery import Deliver, Feed, immediately
from router.engine.freshness import Freshness
from router.engine.latest import Latest
from router.engine.limiter import RateLimit
from router.engine.machine import Guard
from router.engine.outcome import MAPPING_FAILURES, FrameOutcome, Outcome, Report
from router.engine.pacing import Pacer
from router.engine.state import State
from router.table.model import Keep

Handle = Callable[..., None]
"""A generated function; compiler.handlers says what it takes."""


@dataclass(frozen=True, slots=True)
class Guarded:
    """What serves machines: `guard` makes their calls safe, and `counts` are touched under it only."""

    counts: list[int]
    guard: Guard


@dataclass(frozen=True, slots=True)
class Outlets:
    """What an engine hands to its handlers.

    `send` takes a datagram, by endpoint name, and may raise OSError. `publish` takes CDR bytes, by topic,
    and may raise `publish_errors`. `wanted` says by topic whether anybody listens, in a list of one that
    its owner keeps up to date. `report` hears of every loss; it is called only for those. `counts` belong to the
    thread that calls the handlers. `feed` makes what tells deadmen of a route's commands (see engine.deadman).
    `pacers` are those of the endpoints with a budget, served by `pacing`; `collecting` serves frames. `state` has what
    handlers remember. Clocks in ns.
    """

    counts: list[int]
    send: Mapping[str, Callable[[bytes], int]]
    publish: Mapping[str, Callable[[bytes], None]]
    wanted: Mapping[str, list[bool]]
    report: Callable[[Report], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]
    pacing: Guarded
    collecting: Guarded
    feed: Callable[[str, Sequence[str]], Feed]
    publish_errors: tuple[type[Exception], ...] = ()
    pacers: Mapping[str, Pacer] = field(default_factory=dict)
    state: State = field(default_factory=State)


def bind(handler: Handler, counters: Counters, outlets: Outlets, freshness: Freshness) -> FunctionType:
    namespace: dict[str, Any] = {
        **handler.constants,
        "counts": outlets.counts,
        "FAILURES": (*MAPPING_FAILURES, OSError, *outlets.publish_errors),
        "clock_ns": outlets.clock_ns,
        "monotonic": freshness.born,
    }
    if handler.collect_timeout is not None:
        namespace["collect"] = _collect(handler, handler.collect_timeout, counters, outlets)
    for target in handler.targets:
        namespace |= _bound(target, handler, counters, outlets)
    exec(handler.code, namespace)  # noqa: S102 - code that our compiler made of a checked table
    handle: FunctionType = namespace[handler.function]
    return handle


def unbind(handle: FunctionType) -> None:
    """Nobody calls it any more. It is in a ring with its globals, which keeps both until this cuts it."""
    handle.__globals__.clear()


def _bound(target: TargetPlan, handler: Handler, counters: Counters, outlets: Outlets) -> dict[str, Any]:
    name, route = target.name, handler.route
    place = route, handler.topic, target
    bound: dict[str, Any] = {f"lost_{name}": Outcome(counters, outlets.counts, route, target, outlets.report).failed}
    if target.is_topic:
        bound[f"wanted_{name}"] = outlets.wanted[target.target]
    if target.is_deferred:
        outcome = Outcome(counters, outlets.pacing.counts, route, target, outlets.report)
        bound[f"deliver_{name}"] = _deliver(place, outcome, outlets)
    elif target.is_topic:
        bound[f"publish_{name}"] = outlets.publish[target.target]
    else:
        bound[f"send_{name}"] = outlets.send[target.target]
        if target.deadmen:
            bound[f"feed_{name}"] = outlets.feed(route, target.deadmen)
    if target.max_rate is not None and target.keep is Keep.FIRST:
        rate = target.max_rate
        bound[f"limit_{name}"] = outlets.state.keep(("limit", *place), lambda: RateLimit(rate)).may_pass
    return bound


def _collect(
    handler: Handler, timeout: int, counters: Counters, outlets: Outlets
) -> Callable[..., list[object] | None]:
    counts = outlets.collecting.counts
    targets = tuple(target for target in handler.targets if target.is_topic)

    def collector() -> Collector:
        outcomes = [FrameOutcome(counters, counts, handler.route, target, outlets.report) for target in targets]
        return Collector(timeout, outcomes)

    parts = handler.case.message_class  # those of another one would not make a frame with them
    kept = outlets.state.keep(("collect", handler.route, timeout, parts, targets), collector)
    return outlets.collecting.guard(kept, kept.offer)


Place = tuple[str, "str | None", TargetPlan]
"""A target of a route, for one of the topics that it comes from."""


def _deliver(place: Place, outcome: Outcome, outlets: Outlets) -> Deliver:
    """Through what holds the target's messages back, to where they go and are counted.

    Deadmen are told there as well: their lock is taken while that of pacing is held, never the other way round.
    """
    (route, _, target), guard = place, outlets.pacing.guard
    feed = outlets.feed(route, target.deadmen) if target.deadmen else None
    end: object  # where they go, whatever is between
    pacer = None if target.is_topic else outlets.pacers.get(target.target)
    if pacer is not None:
        end, deliver = pacer, pacer.queue(target.priority, outcome, feed)
    elif target.is_topic:
        end = publish = outlets.publish[target.target]
        deliver = immediately(publish, outcome, outlets.publish_errors)
    else:
        end = send = outlets.send[target.target]
        deliver = immediately(send, outcome, feed=feed)
    if target.keep is Keep.LATEST and target.max_rate is not None:
        rate = target.max_rate
        latest = outlets.state.keep(("latest", *place, end), lambda: Latest(rate, deliver, outcome))
        return guard(latest, latest.offer)
    assert pacer is not None  # noqa: S101 - the other reason to defer
    return guard(pacer, deliver)
