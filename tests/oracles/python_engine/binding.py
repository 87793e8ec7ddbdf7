"""Turns a handler's code into a function: its namespace gets counters, senders, publishers, limits and timers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any, Protocol, TypeVar

from router.carrier.state import State
from router.compiler.metrics import Counters, Report
from router.compiler.namespace import MAPPING_FAILURES
from router.compiler.program import Program, RoutePlan, TargetPlan
from router.table.model import OnLimit
from router.types.board_limits import BoardLimits
from tests.oracles.python_engine.collecting import Collector
from tests.oracles.python_engine.deadman import CommandMaker
from tests.oracles.python_engine.delivery import (
    Deliver,
    FrameOutcome,
    Outcome,
    Stale,
    checked,
    immediately,
    only_what_fits,
)
from tests.oracles.python_engine.freshness import Freshness
from tests.oracles.python_engine.handlers import generated, identifiers
from tests.oracles.python_engine.pacing import Latest, Pacer, RateLimit
from tests.oracles.python_engine.timers import Locked

T = TypeVar("T")

Handle = Callable[..., None]
"""A generated function; its arguments are described in compiler.handlers."""


class Flag(Protocol):
    """Has one element, which is true or false."""

    def __getitem__(self, index: int, /) -> object: ...


@dataclass(frozen=True, slots=True)
class TimerGroup:
    """Timers with one lock. `counts` are changed only under it."""

    counts: list[int]
    locked: Locked


@dataclass(frozen=True, slots=True)
class EngineContext:
    """What an engine's handlers use of the running router. Clocks in ns.

    `send` takes a datagram, by endpoint, and may raise OSError; `command(endpoint, route, names)` returns what sends a
    message that has a `ttl` or deadmen (see engine.deadman). `publish` takes CDR bytes, by topic, and may raise
    `publish_errors`. `wanted`, by topic, is a flag that its owner keeps up to date: whether anybody subscribes.
    `report` is called for losses only. `counts` belong to the thread that calls the handlers. `pacers` are those of
    endpoints with a bandwidth, in the group `pacing` like messages that wait for endpoints; `holding` has those that
    wait for topics. `boards` says by endpoint what boards can take. Frames are collected in the group `collecting`.
    """

    counts: list[int]
    send: Mapping[str, Callable[[bytes], int]]
    publish: Mapping[str, Callable[[bytes], None]]
    wanted: Mapping[str, Flag]
    report: Callable[[Report], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]
    pacing: TimerGroup
    holding: TimerGroup
    collecting: TimerGroup
    command: CommandMaker
    publish_errors: tuple[type[Exception], ...] = ()
    pacers: Mapping[str, Pacer] = field(default_factory=dict)
    boards: Mapping[str, BoardLimits] = field(default_factory=dict)
    state: State = field(default_factory=State)


def bind(program: Program, handler: RoutePlan, context: EngineContext, freshness: Freshness) -> FunctionType:
    """Execute the handler's code in a namespace of its own, and return the function that it defines."""
    made, counters = generated(program, handler), program.counters
    namespace: dict[str, Any] = {
        **made.constants,
        "counts": context.counts,
        "FAILURES": (*MAPPING_FAILURES, Stale, OSError, *context.publish_errors),
        "clock_ns": context.clock_ns,
        "stamped": freshness.born,
    }
    if handler.collect_timeout is not None:
        namespace["collect"] = _collect(handler, handler.collect_timeout, counters, context)
    for name, target in zip(identifiers(handler), handler.targets, strict=True):
        namespace |= _target_names(name, target, handler, counters, context)
    exec(made.code, namespace)  # noqa: S102 - code that was made of a checked table
    handle: FunctionType = namespace[made.function]
    return handle


def unbind(handle: FunctionType) -> None:
    """Clear the namespace of a handler that is no longer called: it refers to the handler, a reference cycle."""
    handle.__globals__.clear()


def _target_names(
    name: str, target: TargetPlan, handler: RoutePlan, counters: Counters, context: EngineContext
) -> dict[str, Any]:
    route = handler.route
    place = route, handler.topic, target
    names: dict[str, Any] = {f"lost_{name}": Outcome(counters, context.counts, route, target, context.report).failed}
    if target.is_topic:
        names[f"wanted_{name}"] = context.wanted[target.label]
    if target.is_deferred:
        group = context.holding if target.is_topic else context.pacing
        outcome = Outcome(counters, group.counts, route, target, context.report)
        names[f"deliver_{name}"] = _deliver(place, outcome, context)
    elif target.is_topic:
        names[f"publish_{name}"] = context.publish[target.label]
    else:
        is_command = handler.ttl is not None or target.deadmen
        send = context.command(target.label, route, target.deadmen) if is_command else context.send[target.label]
        names[f"send_{name}"] = checked(send, context.boards.get(target.label))
    if target.max_rate is not None and target.on_limit is OnLimit.FIRST:
        rate = target.max_rate
        names[f"limit_{name}"] = context.state.keep(("limit", *place), lambda: RateLimit(rate)).may_pass
    return names


def _collect(
    handler: RoutePlan, timeout: int, counters: Counters, context: EngineContext
) -> Callable[..., list[object] | None]:
    counts = context.collecting.counts
    targets = tuple(target for target in handler.targets if target.is_topic)

    def collector() -> Collector:
        outcomes = [FrameOutcome(counters, counts, handler.route, target, context.report) for target in targets]
        return Collector(timeout, outcomes)

    parts = handler.case.message_class  # parts of different classes do not make a frame
    kept = context.state.keep(("collect", handler.route, timeout, parts, targets), collector)
    return context.collecting.locked(kept, kept.offer)


def _deliver(place: tuple[str, str | None, TargetPlan], outcome: Outcome, context: EngineContext) -> Deliver:
    """Return the Deliver of a target whose messages may wait. `place` is the route, its topic if any, and the target.

    Deadmen are fed when a message leaves: their lock is taken while that of `pacing` is held, never in reverse order.
    """
    route, _, target = place
    locked = context.holding.locked if target.is_topic else context.pacing.locked
    board = None if target.is_topic else context.boards.get(target.label)
    destination: object
    pacer = None if target.is_topic else context.pacers.get(target.label)
    if pacer is not None:
        command = context.command(target.label, route, target.deadmen)
        destination, deliver = pacer, pacer.queue(target.priority, outcome, command)
    elif target.is_topic:
        destination = publish = context.publish[target.label]
        deliver = immediately(lambda data, _: publish(data), outcome, context.publish_errors)
    else:
        destination = context.send[target.label]
        deliver = immediately(context.command(target.label, route, target.deadmen), outcome)
    if target.on_limit is OnLimit.LATEST and target.max_rate is not None:
        rate = target.max_rate
        latest = context.state.keep(("latest", *place, destination), lambda: Latest(rate, deliver, outcome))
        return locked(latest, only_what_fits(latest.offer, board, outcome))
    assert pacer is not None
    return locked(pacer, only_what_fits(deliver, board, outcome))
