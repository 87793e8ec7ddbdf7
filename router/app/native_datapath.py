"""The datapath of the carrier: native threads receive, forward, publish and brake; Python serves what only Python can.

What the receive thread does not send itself comes by rings to others: a native one publishes (`publishing`), `topics`
and `destinations` serve what needs Python (`parts`). Each of those two has its own engine with its own state, and
changes to another program when it has served all that the earlier one received. Two native threads take messages from
ROS, one of them urgent ones (`from_ros`); the thread in `ros` takes those that need Python.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count
from socket import inet_ntoa
from struct import Struct
from time import sleep
from typing import TYPE_CHECKING, cast

from router.app.from_ros import FromRos, RosTopics
from router.app.parts import OF_PYTHON, Part, Parts, divided
from router.app.publishing import Publishing
from router.app.sockets import SocketChange
from router.app.wiring import (
    RouterContext,
    Send,
    States,
    Wiring,
    engine_context,
    gateway_deadmen,
    log_start,
)
from router.carrier import structures as c
from router.carrier.boards import NativeBoards
from router.carrier.carrier import Carrier
from router.carrier.collectors import NativeCollector, kept_collector
from router.carrier.deadmen import Deadmen, NativeDeadman
from router.carrier.deferrals import Adoption, Deferrals, NativeDeferral, NativePacer, timer_change
from router.carrier.events import EventReader, EventThread
from router.carrier.from_ros import native_from_ros
from router.carrier.limits import open_limit
from router.carrier.outlets import Names, Outlets, PartTargets
from router.carrier.program import NativeProgram, native_program
from router.carrier.reasons import where_refused, why_rejected
from router.carrier.ring import Ring
from router.carrier.schema import CannotCarry
from router.carrier.sender import NativeSender
from router.carrier.worker import Stage, Worker
from router.clock import boottime_ns
from router.compiler.metrics import REJECT_REASONS
from router.compiler.program import DeadmanPlan, Handler, Program, TargetPlan
from router.engine import OutboundEngine, PartEngine
from router.engine.binding import State
from router.engine.deadman import feeder
from router.engine.freshness import Freshness
from router.errors import StartError
from router.log import logger
from router.net.udp import Listener, Sender
from router.recording.mirror import Mirror, Mirrored
from router.table import model

if TYPE_CHECKING:
    from router.ros.endpoints import RosChange
    from router.ros.router_node import RouterNode

MOST_COUNTERS = 1 << 18
"""Counters of each native thread: their addresses stay the same, so they cannot grow."""

_QUEUE, _MIRRORED, _EVENTS = 1 << 20, 1 << 22, 1 << 18
"""Bytes that may wait for a thread of Python: messages for a part, received datagrams to observe, and events."""

_PATIENCE_S = 1.0
"""How long a reload and a stop wait for a thread of Python that may be stuck in the middleware."""

_TURN_S = 0.002

_MIRROR = Struct("@IIqIIIiiI")
"""`struct mirror_record`."""

_REASONS = (*REJECT_REASONS, "")
"""By `enum reason`; the last one is also ROUTED, -1."""

_ROS, _ENDPOINTS, _GATEWAYS = "ros", "endpoints", "gateways"


@dataclass(frozen=True, slots=True)
class NativeWiring(Wiring):
    """`deadmen` are those of routes; `adopted` what holds back messages for endpoints; `stages` by part."""

    native: NativeProgram
    topics: RosTopics
    deadmen: Mapping[str, NativeDeadman]
    adopted: Sequence[Adoption]
    stages: Mapping[Part, Stage]


class NativeDatapath:
    """See `Datapath`."""

    def __init__(self, library: ctypes.CDLL, context: RouterContext, mirror: Mirror) -> None:
        self._library = library
        self._context = context
        self._names = Names()
        self._generations = count(1)
        context.counts.most = MOST_COUNTERS
        self._wiring: NativeWiring | None = None
        self._is_running = self._is_stopping = self._has_stopped = False
        report, failed = context.reporter.report, context.reporter.failed
        received, braked, published = (Ring(library, _EVENTS) for _ in range(3))
        receive_counts, deadman_counts, publish_counts = (_fixed_counts() for _ in range(3))
        from_ros = [(_fixed_counts(), Ring(library, _EVENTS)) for _ in (True, False)]
        self._deadmen = Deadmen(library, deadman_counts, braked, self._names)
        self._carrier = Carrier(library, self._deadmen.address, receive_counts, received)
        self._from_ros = [
            FromRos(library, self._deadmen.address, counts, events, is_urgent=is_urgent)
            for is_urgent, (counts, events) in zip((True, False), from_ros, strict=True)
        ]
        self._publishing = Publishing(library, Ring(library, _QUEUE), publish_counts, published, self._names)
        self._ros: RouterNode | None = None
        self._workers = {part: Worker(name, Ring(library, _QUEUE), failed) for part, name in OF_PYTHON.items()}
        context.counts.add(_as_list(deadman_counts))
        for worker in self._workers.values():  # first: what they have served was received, so no less than 0 waits
            context.counts.add(worker.counts, worker.copy_counts, worker.forget_copy)
        context.counts.add(_as_list(publish_counts), self._publishing.counters)
        context.counts.add(_as_list(receive_counts), self._carrier.counters)
        for thread, (counts, _) in zip(self._from_ros, from_ros, strict=True):
            context.counts.add(_as_list(counts), thread.counters)
        self._mirrored = MirrorRing(Ring(library, _MIRRORED), self._names)
        mirror.drain_by(self._mirrored.take)
        self._events = EventThread(
            [
                (received, _as_list(receive_counts)),
                *((events, _as_list(counts)) for counts, events in from_ros),
                (braked, _as_list(deadman_counts)),
                (published, _as_list(publish_counts)),
            ],
            EventReader(self._names, self._why_rejected, self._where_refused),
            report,
            context.deadman_changed,
            self._pulse,
        )

    @property
    def turns(self) -> int:
        return self._carrier.turns

    def stalled(self) -> tuple[str, float] | None:
        return self._publishing.stalled()

    def _pulse(self) -> None:
        self._carrier.pulse()
        for thread in self._from_ros:
            thread.report_failures()

    def open_listener(self, settings: model.Listener, has_senders: bool) -> Listener:
        return Listener(settings, is_stamped=True, has_senders=has_senders)

    def open_sender(
        self, endpoint: model.Endpoint, source: Listener | None, listeners: Sequence[Listener]
    ) -> NativeSender:
        return NativeSender(self._library, endpoint, source, listeners)

    def states(self, earlier: Wiring | None) -> States:
        return States([*OF_PYTHON.values(), _ROS, _ENDPOINTS, _GATEWAYS], earlier.states if earlier else None)

    def start_deadmen(self, program: Program, sockets: SocketChange, states: States) -> None:
        for plan in program.deadmen:
            log_start(plan.route, self._deadman(plan, program, sockets, states).start(boottime_ns()))

    # wiring

    def wire(
        self,
        program: Program,
        sockets: SocketChange,
        ros: RouterNode | None,
        topics: RosChange | None,
        states: States,
    ) -> NativeWiring:
        context, timers = self._context, self._context.timers
        senders = {endpoint: self._native(sender) for endpoint, sender in sockets.senders.items()}
        deadmen = {plan.route: self._deadman(plan, program, sockets, states) for plan in program.deadmen}
        behind_gateways = gateway_deadmen(program, context, ros, states[_GATEWAYS])
        send: dict[str, Send] = {endpoint: sender.send for endpoint, sender in senders.items()}

        def feeds(route: str, names: Sequence[str]) -> list[tuple[NativeDeadman, bool]]:
            return [(deadmen[name], name != route) for name in names]

        def command(endpoint: str, route: str, names: Sequence[str]) -> Callable[[bytes, int | None], int]:
            return self._deadmen.command(senders[endpoint], feeds(route, names))

        errors = ros.publish_errors if ros else ()
        shared = engine_context(program, context, topics, errors, send, command, {})
        of_ros = replace(shared, counts=context.counts.ros, state=states[_ROS])
        outbound = OutboundEngine(program, of_ros, ros.freshness if ros else Freshness())
        parts = divided(program, publishes=self._publishing.open(has_topics=bool(program.lowered.topics)))
        engines = {
            part: PartEngine(
                program, replace(shared, counts=self._workers[part].counts, state=states[user]), parts[part]
            )
            for part, user in OF_PYTHON.items()
        }
        functions = {part: engine.functions() for part, engine in engines.items()}
        limit = partial(_limit, states[_ENDPOINTS])
        deferrals = Deferrals(
            self._library,
            states[_ENDPOINTS],
            senders,
            topics.publications if topics else {},
            {endpoint.name: endpoint.bandwidth for endpoint in program.senders if endpoint.bandwidth is not None},
        )
        pacers = [pacer for endpoint in program.senders if (pacer := deferrals.pacer(endpoint.name))]
        publications = topics.publications if topics else {}
        generation = next(self._generations)
        outlets = Outlets(
            listeners=sockets.listeners,
            senders={endpoint: sender.address for endpoint, sender in senders.items()},
            publications=publications,
            feeds=lambda route, names: [(deadman.address, disarms) for deadman, disarms in feeds(route, names)],
            limit=limit,
            deferral=deferrals.deferral,
            collector=partial(kept_collector, self._library, states[_ENDPOINTS]),
            carried=lambda handler: parts[Part.SENT].get(handler.route, ()),
            parts=lambda handler: list(self._parts_of(handler, parts)),
            names=self._names,
        )
        try:
            outlets = replace(outlets, boards=NativeBoards(program.boards))
            native = native_program(program, generation, outlets)
        except CannotCarry as error:
            what = f"the carrier, which runs, cannot take these messages: {error}"
            raise StartError(what, "restart the router, and Python serves them") from error
        native.arrays += [senders, deadmen]
        numbers = {handler.route: number for number, handler in enumerate(native.handlers)}
        now = self._wiring.program if self._wiring else program
        leaves_native = bool(_topics(now, by_carrier=True) & _topics(program, by_carrier=False))
        stages = {
            part: Stage(
                native.generation,
                {numbers[route]: function for route, function in functions[part].items()},
                native.sources,
                partial(self._switch, part, states, after=native.generation if leaves_native else None),
            )
            for part in OF_PYTHON
        }
        messages = native_from_ros(program, generation, outlets)
        messages.arrays += [senders, deadmen]
        for thread in self._from_ros:
            thread.open(messages)
        self._ros = ros
        for part, stage in stages.items():
            self._workers[part].prepare(stage)
        return NativeWiring(
            program=program,
            take={
                plan.label: outbound.taker(plan.label)
                for plan in program.subscriptions
                if plan.label not in messages.topics
            },
            feed=feeder(behind_gateways, timers.inbound_deadman.locked),
            states=states,
            gateway_deadmen=behind_gateways,
            pacers={},
            engines=(outbound, *engines.values()),
            native=native,
            topics=RosTopics(
                messages, {topic: each.raw for topic, each in topics.subscriptions.items()} if topics else {}
            ),
            deadmen=deadmen,
            adopted=[
                *(Adoption(pacer.address) for pacer in pacers),
                *(each for each in (*native.adopted, *messages.adopted) if not each.is_topic),
            ],
            stages=stages,
        )

    def _parts_of(self, handler: Handler, parts: Parts) -> Iterator[PartTargets]:
        """The parts of a route that get their messages by a ring."""
        if targets := parts[Part.PUBLISHED].get(handler.route):
            collects = handler.collect_timeout is not None
            yield PartTargets(self._publishing.ring.address, targets, is_always_wanted=collects, is_native=True)
        for part, worker in self._workers.items():
            if targets := parts[part].get(handler.route):
                is_always_wanted = part is Part.DESTINATIONS or handler.collect_timeout is not None
                yield PartTargets(worker.ring.address, targets, is_always_wanted)

    def _native(self, sender: Sender) -> NativeSender:
        assert isinstance(sender, NativeSender)  # noqa: S101 - made by `open_sender`
        return sender

    def _deadman(self, plan: DeadmanPlan, program: Program, sockets: SocketChange, states: States) -> NativeDeadman:
        senders = {endpoint: self._native(sockets.senders[endpoint]) for endpoint, _ in plan.datagrams}
        key = "deadman", plan, tuple(senders.values())
        return states[_ENDPOINTS].keep(key, lambda: self._deadmen.add(plan, program.counters, senders))

    def _switch(self, part: Part, states: States, after: int | None) -> None:
        """End the timers that only the earlier program had, once its messages are served.

        What waits for an endpoint may have come by any of its timers, which end before the pacer. `after` is the
        generation that the native thread has to reach before, since its messages on a topic come first.
        """
        if part is Part.TOPICS and after is not None:
            self._publishing.wait_for(after, _PATIENCE_S)
        left = list(states[OF_PYTHON[part]].left())
        if part is Part.DESTINATIONS:
            left += states[_ENDPOINTS].left()
        self._context.timers.release(left)

    def abandon(self, wiring: Wiring) -> None:
        assert isinstance(wiring, NativeWiring)  # noqa: S101 - made by `wire`
        for part, stage in wiring.stages.items():
            self._workers[part].abandon(stage)

    # running

    def between(self, wiring: Wiring, swap: Callable[[], None]) -> None:
        assert isinstance(wiring, NativeWiring)  # noqa: S101 - made by `wire`
        assert self._wiring is not None  # noqa: S101 - another program runs
        with ExitStack() as undo:
            for thread in self._from_ros:
                thread.leave(wiring.topics, keeps=wiring.deadmen == self._wiring.deadmen)
                undo.callback(thread.stay)
            swap()
            undo.pop_all()

    def adopt(self, wiring: Wiring, earlier: Wiring | None, left: Sequence[Listener], now: Sequence[Listener]) -> None:
        assert isinstance(wiring, NativeWiring)  # noqa: S101 - made by `wire`
        wiring.succeed_gateways(earlier, self._context.timers)
        self._context.timers.release([*wiring.states[_GATEWAYS].left(), *wiring.states[_ROS].left()])
        if isinstance(earlier, NativeWiring):
            for listener in left:
                listener.end_input()
            self._change(wiring, earlier)
        else:
            self._deadmen.change(timer_change(wiring.adopted, ()))
            self._change_topics(wiring)
        for thread in self._from_ros:
            thread.serve(wiring.topics)
        self._wiring = wiring

    def _change(self, wiring: NativeWiring, earlier: NativeWiring) -> None:
        """Have the carrier execute another program; deadmen with other settings inherit the state of earlier ones."""
        pairs = [(deadman, earlier.deadmen.get(route)) for route, deadman in wiring.deadmen.items()]
        replaced = [(next_one, before) for next_one, before in pairs if before is not None and before is not next_one]
        kept = list(wiring.deadmen.values())
        left = list(wiring.states[_ENDPOINTS].left())
        ended = [
            *(each.address for each in left if isinstance(each, NativeDeferral)),
            *(each.address for each in left if isinstance(each, NativePacer)),
            *(before.address for before in earlier.deadmen.values() if before not in kept),
        ]
        for next_one, before in replaced:
            next_one.succeeds(before)
        generation = wiring.native.generation
        holds = _endpoints(earlier.program, by_carrier=False) & _endpoints(wiring.program, by_carrier=True)
        holds_topics = _topics(earlier.program, by_carrier=False) & _topics(wiring.program, by_carrier=True)
        if holds_topics:
            self._publishing.hold(generation)
        self._change_topics(wiring)
        self._carrier.change(
            wiring.native,
            [(next_one.address, before.address) for next_one, before in replaced],
            timer_change(wiring.adopted, ended),
            holds=bool(holds),
        )
        self._publishing.advance(generation)
        for worker in self._workers.values():
            worker.advance(generation)
        if holds:  # what waits for Python is sent before what the carrier receives from now on
            self._workers[Part.DESTINATIONS].wait_for(generation, _PATIENCE_S)
            self._carrier.resume()
        if holds_topics:
            self._workers[Part.TOPICS].wait_for(generation, _PATIENCE_S)
            self._publishing.hold(0)

    def _change_topics(self, wiring: NativeWiring) -> None:
        """Post what changes in the timers of the publish thread, before it gets a message of this program."""
        adopted = [each for each in wiring.native.adopted if each.is_topic]
        left = [each.address for each in wiring.states[_ENDPOINTS].left() if isinstance(each, NativeCollector)]
        change = c.PublishChange(timers=timer_change(adopted, left), generation=wiring.native.generation)
        wiring.native.arrays.append(change)
        self._publishing.change(change)

    def start(self) -> None:
        assert self._wiring is not None  # noqa: S101 - `adopt` was called
        native = self._wiring.native
        self._carrier.start(native)
        for worker in self._workers.values():
            worker.start(native.generation)
        self._is_running = True

    def has_passed(self, wiring: Wiring) -> bool:
        assert isinstance(wiring, NativeWiring)  # noqa: S101 - made by `wire`
        if not self._is_running:
            return True
        generation = wiring.native.generation
        late = [each.name for each in self._workers.values() if not each.wait_for(generation, _PATIENCE_S)]
        if not self._publishing.wait_for(generation, _PATIENCE_S):
            late.append("publish")
        if late:
            logger.error("a thread is stuck, and what it uses stays open", threads=late)
        return not late and self._has_turned() and all(thread.has_passed for thread in self._from_ros)

    def _has_turned(self) -> bool:
        """Wait until the receive thread is done with what it now handles: it may be dropping an earlier message."""
        turns = self._carrier.turns
        for _ in range(int(_PATIENCE_S / _TURN_S)):
            if self._carrier.turns != turns:
                return True
            sleep(_TURN_S)
        return False

    def observe(self, *, is_observed: bool) -> None:
        lost = self._context.counts.counters.index("mirror_dropped")
        self._carrier.mirror(self._mirrored.ring if is_observed else None, lost)

    def watch(self, notify: int, interval: int) -> bool:
        self._carrier.watchdog(notify, interval)
        return True

    def stop(self, listeners: Sequence[Listener]) -> None:
        self._is_stopping = True
        for listener in listeners:
            listener.end_input()
        self._carrier.stop_receiving()
        self._is_running = False
        stuck = [worker.name for worker in self._workers.values() if not worker.stop(_PATIENCE_S)]
        if stuck:
            logger.error("a thread is stuck, and the router ends without it", threads=stuck)
        self._stop_threads_of_ros()

    def _stop_threads_of_ros(self) -> None:
        have_ended = [self._publishing.stop(), *(thread.stop() for thread in self._from_ros)]
        if not all(have_ended) and self._ros is not None:
            self._ros.leave_open()
        self._has_stopped = True

    def close(self) -> None:
        if not self._is_stopping:  # the start has failed
            self._stop_threads_of_ros()
        self._deadmen.end()
        if not self._has_stopped:  # `stop` is stuck, and its threads use what would be freed
            return
        self._events.close()
        self._carrier.close()

    def _why_rejected(self, listener: str, data: bytes, length: int) -> str:
        return why_rejected(self._wiring.program, listener, data, length) if self._wiring else ""

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Nothing if it is not of the program that runs."""
        wiring = self._wiring
        if wiring is None or wiring.native.generation != generation:
            return ""
        return where_refused(wiring.program.lowered, route, topic, target, place)


def _fixed_counts() -> ctypes.Array[ctypes.c_int64]:
    """Counters that never move."""
    return (ctypes.c_int64 * MOST_COUNTERS)()


def _as_list(counts: ctypes.Array[ctypes.c_int64]) -> list[int]:
    """An array as what it is used like: metrics only index and slice it."""
    return cast("list[int]", counts)


class MirrorRing:
    """What the carrier shows of received datagrams, in the form in which observers get it."""

    def __init__(self, ring: Ring, names: Names) -> None:
        self.ring = ring
        self._name = names.name

    def take(self) -> list[Mirrored]:
        """Return what was received since the last call. For one thread."""
        taken: list[Mirrored] = []
        head = _MIRROR.size
        while records := self.ring.take():
            position = 0
            while position < len(records):
                size, listener, at, address, port, length, why, who, _ = _MIRROR.unpack_from(records, position)
                data = bytes(records[position + head : position + head + length])
                sender = self._name(who) if who >= 0 else ""
                taken.append((at, self._name(listener), (_host(address), port), sender, _REASONS[why], data))
                position += size
        return taken


@cache
def _host(address: int) -> str:
    return inet_ntoa(address.to_bytes(4, "big"))


def _limit(state: State, handler: Handler, target: TargetPlan) -> c.Limit:
    """The limit of a target with `max_rate`, which lives as long as programs have the target."""
    rate = target.max_rate
    assert rate is not None  # noqa: S101 - asked for by the caller
    key = "native limit", handler.route, handler.topic, target
    return state.keep(key, lambda: open_limit(rate))


def _endpoints(program: Program, *, by_carrier: bool) -> set[str | None]:
    """The endpoints to which datagrams are forwarded by the carrier, or by Python."""
    of_udp = {key: executor for key, executor in program.executors.items() if key[1] is None}
    return {endpoint for (_, _, endpoint), executor in of_udp.items() if executor.is_carrier is by_carrier}


def _topics(program: Program, *, by_carrier: bool) -> set[str | None]:
    """The topics on which the carrier publishes, or Python."""
    published = {key: executor for key, executor in program.executors.items() if key[2] is None}
    return {topic for (_, topic, _), executor in published.items() if executor.is_carrier is by_carrier}
