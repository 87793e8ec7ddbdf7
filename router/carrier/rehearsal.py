"""The stage (`native/rehearsal.c`): executes programs on a simulated clock, without threads, sockets or ROS."""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple, Union
from weakref import finalize

from router import declared as c
from router.carrier.boards import NativeBoards
from router.carrier.deadmen import DeadmanGroup, NativeDeadman, replaced, successors
from router.carrier.deferrals import Adoption, timer_change
from router.carrier.events import CountedReport, DeadmanEvents, EventReader, Returned
from router.carrier.names import Names
from router.carrier.outlets import Outlets
from router.carrier.program import NativeProgram, change_to, native_program
from router.carrier.reasons import superseded, where_refused, why_rejected
from router.carrier.ros_routes import NativeFromRos, native_from_ros
from router.carrier.state import State
from router.compiler.program import Program
from router.declared import RecordKind
from router.table.model import Endpoint

Peer = tuple[str, int]

_MOST_COUNTERS = 1 << 18


class Time(NamedTuple):
    """The time (boot clock, ns) of the following records."""

    at: int


class Increment(NamedTuple):
    """An increment of a counter."""

    counter: int
    amount: int


class Output(NamedTuple):
    """A datagram for an endpoint, or a message for a topic; the next record counts it."""

    target: str
    data: bytes


Record = Union[Time, Increment, Output, DeadmanEvents, Returned, CountedReport]


class Stage:
    """Rehearses programs. `records` returns the outcome of every input and of timers that were due.

    The wall clock is `ahead` of the boot clock, by 0 ns at first. All times in ns.
    """

    def __init__(self, library: ctypes.CDLL, now: int = 0) -> None:
        """Raises MemoryError."""
        self.now = now
        self._library = library
        self._names = Names()
        self._opened = _Opened(library, now)
        self._reader = EventReader(self._names, self._why_rejected, self._superseded, self._where_refused)
        self._generation = 0
        # Keep open objects out of garbage collection, which would free them in any order.
        finalize(self, self._opened.close)

    def counters(self, count: int) -> list[int]:
        """Return the first `count` counters."""
        return self._opened.counters[:count]

    def adopt(self, program: Program) -> None:
        """Switch to a program, with state passed on by key as at a reload. Raises MemoryError."""
        earlier, state = self._opened.running, State(self._library, self._opened.state)
        self._generation += 1
        running = self._built(program, state)
        self._serve(running, earlier)
        self._opened.state, self._opened.running = state, running
        state.forget_previous()

    def restart(self, now: int) -> None:
        """Restart the current program, like a router that has just started. Raises MemoryError."""
        running, state = self._in_use, State(self._library, self._opened.state)
        fixed = self._fixed(running.program, state, running.fixed.boards)
        state.forget_previous()
        self._opened.reopen(now)
        self.now = now
        running.bind(self._bound(running.program, state, fixed))
        self._serve(running, None)
        self._opened.state, self._opened.running = state, running

    def _serve(self, running: _Running, earlier: _Running | None) -> None:
        before = earlier.deadmen if earlier else {}
        dropped = [each.address for each in before.values() if each not in running.deadmen.values()]
        timers = running.timers(earlier, dropped, of_topics=False)
        routes = successors(running.program.deadmen, earlier.program.deadmen) if earlier else {}
        change = change_to(running.native, timers, replaced(running.deadmen, before, routes))
        of_topics = running.timers(earlier, (), of_topics=True)
        address = self._opened.address
        self._library.rehearsal_adopt(address, ctypes.byref(change), ctypes.byref(of_topics), running.topics)

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_at: int) -> None:
        """Receive a datagram. `arrived_at` is wall-clock time. Raises KeyError for an unknown listener."""
        host, port = peer
        number = self._in_use.listeners[listener]
        self._library.rehearsal_datagram(self._opened.address, number, _number(host), port, data, len(data), arrived_at)

    def message(self, topic: str, data: bytes, sent_at: int) -> None:
        """Take a message from ROS. `sent_at` is wall-clock time. Raises KeyError for a topic without a route."""
        number = self._in_use.topic_numbers[topic]
        self._library.rehearsal_message(self._opened.address, number, data, len(data), sent_at)

    def advance(self, to: int) -> None:
        """Advance the clock to that time, and serve timers that become due. Never goes back."""
        self._library.rehearsal_advance(self._opened.address, to)
        self.now = max(self.now, to)

    def set_clock(self, ahead: int) -> None:
        """Set how far the wall clock is ahead of the boot clock."""
        self._library.rehearsal_set_clock(self._opened.address, ahead)

    def end(self) -> None:
        """Stop as the router does."""
        self._library.rehearsal_end(self._opened.address)

    def records(self) -> Iterator[Record]:
        """Yield the records since the last call. Raises MemoryError."""
        size = ctypes.c_size_t()
        address = self._library.rehearsal_records(self._opened.address, ctypes.byref(size))
        if size.value and not address:
            raise MemoryError("there is no room for the records of the stage")
        records = memoryview(bytearray(ctypes.string_at(address, size.value) if address else b""))
        at = 0
        while at < len(records):
            head = c.EventHead.from_buffer(records, at)
            yield self._record(head.kind, records[at : at + head.size])
            at += head.size

    def _record(self, kind: int, record: memoryview) -> Record:
        if kind == RecordKind.TIME:
            return Time(c.TimeRecord.from_buffer(record).at)
        if kind == RecordKind.INCREMENT:
            increment = c.IncrementRecord.from_buffer(record)
            return Increment(increment.counter, increment.amount)
        if kind in {RecordKind.SENT, RecordKind.BRAKED, RecordKind.PUBLISHED}:
            output, begin = c.OutputRecord.from_buffer(record), ctypes.sizeof(c.OutputRecord)
            return Output(self._names.name(output.target), bytes(record[begin : begin + output.length]))
        return self._reader.read(kind, record)

    @property
    def _in_use(self) -> _Running:
        running = self._opened.running
        assert running is not None  # noqa: S101 - a program was adopted
        return running

    def _why_rejected(self, listener: str, data: bytes, length: int) -> str:
        return why_rejected(self._in_use.program, listener, data, length)

    def _superseded(self, listener: str, data: bytes) -> str:
        return superseded(self._in_use.program, listener, data)

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Return the place in the table; "" for messages held since an earlier program."""
        is_current = generation == self._generation
        return where_refused(self._in_use.program.lowered, route, topic, target, place) if is_current else ""

    # programs

    def _built(self, program: Program, state: State) -> _Running:
        fixed = self._fixed(program, state, NativeBoards(program.boards))
        bound = self._bound(program, state, fixed)
        native = native_program(program, self._generation, bound.outlets)
        return _Running(program, fixed, bound, native, native_from_ros(program, self._generation, bound.outlets))

    def _fixed(self, program: Program, state: State, boards: NativeBoards) -> _Fixed:
        publications = {
            plan.label: state.get_or_make(("topic", plan.topic, plan.type_name, plan.qos), _Publication)
            for plan in program.publishers
        }
        return _Fixed({each.name: self._sender(each, state) for each in program.senders}, publications, boards)

    def _bound(self, program: Program, state: State, fixed: _Fixed) -> _Bound:
        """Open mutable objects, unless `state` has them."""
        group = DeadmanGroup(self._library, self._opened.timers, self._names)
        outlets = Outlets.of(
            program,
            group,
            state,
            listeners={plan.name: _Listener() for plan in program.listeners},  # type: ignore[misc]
            senders=fixed.senders,
            publications=fixed.publications,
            boards=fixed.boards,
        )
        return _Bound(outlets, outlets.pacers())

    def _sender(self, endpoint: Endpoint, state: State) -> _Sender:
        return state.get_or_make(("sender", endpoint.name, endpoint.address.value), partial(_Sender, self._library))


class _Opened:
    """The C stage, and the program that it executes."""

    def __init__(self, library: ctypes.CDLL, now: int) -> None:
        self.library = library
        self.counters = (ctypes.c_int64 * _MOST_COUNTERS)()
        self.running: _Running | None = None
        self.state = State(library)
        self._open(now)

    def _open(self, now: int) -> None:
        self.address: int = self.library.rehearsal_open(self.counters, now) or 0
        if not self.address:
            raise MemoryError("the stage cannot be opened")
        self.timers: int = self.library.rehearsal_timers(self.address)

    def reopen(self, now: int) -> None:
        self.close()
        ctypes.memset(self.counters, 0, ctypes.sizeof(self.counters))
        self._open(now)

    def close(self) -> None:
        """End all timers, and free them before the stage."""
        if not self.address:
            return
        self.library.rehearsal_end(self.address)
        if self.running is not None:
            self.running.release()
        self.running, self.state = None, State(self.library)
        self.library.rehearsal_close(self.address)
        self.address = 0


class _Sender:
    """A sender without a socket."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self.address = int(library.sender_open(-1, -1, 0, 0) or 0)
        if not self.address:
            raise MemoryError("a sender of the stage cannot be opened")

    def __del__(self) -> None:
        if self.address:
            self._library.sender_close(self.address)


class _Listener:
    """A listener without a socket. Stands for `net.udp.Listener`."""

    is_inherited = False
    socket = SimpleNamespace(fileno=lambda: -1)


class _Publication:
    """A topic with a subscriber. Stands for `ros.endpoints.Publication`."""

    def __init__(self) -> None:
        self.address = 0
        self.wanted = (ctypes.c_uint8 * 1)(1)


class _Fixed(NamedTuple):
    """The open objects of a program that messages do not change: `senders` by endpoint, `publications` by topic."""

    senders: Mapping[str, _Sender]
    publications: Mapping[str, _Publication]
    boards: NativeBoards


class _Bound(NamedTuple):
    """The open objects of a program that messages change."""

    outlets: Outlets
    pacers: Sequence[Adoption]


class _Running:
    """A program as the stage executes it. Listeners and topics are numbered by their index in its arrays."""

    def __init__(
        self, program: Program, fixed: _Fixed, bound: _Bound, native: NativeProgram, from_ros: NativeFromRos
    ) -> None:
        self.program, self.fixed, self.native = program, fixed, native
        self.listeners = {plan.name: number for number, plan in enumerate(program.listeners)}
        self.topic_numbers = {topic: number for number, topic in enumerate(from_ros.topics)}
        routes = from_ros.topics.values()
        self.topics = (c.RosTopic * len(routes))(*(c.RosTopic(routes=each, route_count=len(each)) for each in routes))
        self._from_ros = from_ros
        self._bound: _Bound | None = bound

    @property
    def deadmen(self) -> Mapping[str, NativeDeadman]:
        return self._bound.outlets.deadmen if self._bound else {}

    @property
    def adopted(self) -> Sequence[Adoption]:
        pacers = self._bound.pacers if self._bound else ()
        return [*pacers, *self.native.states.adopted, *self._from_ros.states.adopted]

    def bind(self, bound: _Bound) -> None:
        """Point the arrays to other state."""
        self._bound = bound
        for states in (self.native.states, self._from_ros.states):
            states.bind(bound.outlets)

    def release(self) -> None:
        """Release the state, before the stage is closed."""
        self._bound = None
        for states in (self.native.states, self._from_ros.states):
            states.release()

    def timers(self, earlier: _Running | None, ended: Sequence[int], *, of_topics: bool) -> c.TimerChange:
        """Return the changes of timers for topics or for endpoints; timers in `ended` also end."""
        now, before = (
            [each for each in adopted if each.is_topic is of_topics]
            for adopted in (self.adopted, earlier.adopted if earlier else ())
        )
        return timer_change(now, before, ended)


def _number(host: str) -> int:
    return int.from_bytes(socket.inet_aton(host), "big")
