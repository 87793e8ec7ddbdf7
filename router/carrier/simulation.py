"""The simulation (`native/simulation.c`): executes programs on a simulated clock, without threads, sockets or ROS."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from typing import NamedTuple, Union
from weakref import finalize

from router import declared as c
from router.carrier.events import (
    CountedReport,
    DeadmanEvents,
    EventReader,
    Learned,
    LinkChange,
    Reply,
    Returned,
    StateChange,
)
from router.carrier.loading import LoadedImage
from router.carrier.reasons import superseded, where_refused, why_rejected
from router.compiler.compiled_table import CompiledTable
from router.declared import MOST_COUNTERS, RecordKind
from router.image.image import Image
from router.image.names import Names
from router.image.writer import write_image
from router.net.addresses import seen
from router.table.addresses import LEARNED

Peer = tuple[str, int]


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


Record = Union[Time, Increment, Output, DeadmanEvents, StateChange, Learned, Returned, LinkChange, Reply, CountedReport]


class Simulation:
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

    def adopt(self, program: CompiledTable) -> None:
        """Switch to a program, with state passed on by key as at a reload. Raises MemoryError."""
        before = self._opened.running
        self._generation += 1
        running = self._loaded(program, write_image(program, self._names), before.image if before else None)
        self._serve(running, before)
        running.image.forget_before()

    def restart(self, now: int) -> None:
        """Restart the current program, like a router that has just started. Raises MemoryError."""
        program, image = self._in_use.program, self._in_use.image.image
        self._opened.reopen(now)
        self.now = now
        self._serve(self._loaded(program, image, None), None)

    def _loaded(self, program: CompiledTable, image: Image, before: LoadedImage | None) -> _Running:
        opened = self._opened
        senders = {name: opened.sender(name, address) for name, address, *_ in image.senders}
        senders |= {name: opened.sender(name, (place, 0)) for name, place in image.link_ends}
        loaded = LoadedImage(opened.library, image, senders, opened.timers, self._generation, before)
        loaded.bind_topics(dict.fromkeys((topic for topic, _ in image.topics), _TOPIC))
        return _Running(program, loaded)

    def _serve(self, running: _Running, before: _Running | None) -> None:
        image, earlier = running.image, before.image if before else None
        deadmen = earlier.deadmen.values() if earlier else ()
        ended = [each.address for each in deadmen if each not in image.deadmen.values()]
        change, of_topics = image.change(earlier, ended), image.timers(earlier, of_topics=True)
        self._library.simulation_adopt(
            self._opened.address, ctypes.byref(change), ctypes.byref(of_topics), running.topics
        )
        self._opened.running = running

    def datagram(self, listener: str, peer: Peer, data: bytes, arrived_at: int) -> None:
        """Receive a datagram. `arrived_at` is wall-clock time. Raises KeyError for an unknown listener."""
        host, port = peer
        number, sender = self._in_use.listeners[listener], seen(self._library, host)
        self._library.simulation_datagram(self._opened.address, number, sender, port, data, len(data), arrived_at)

    def message(self, topic: str, data: bytes, sent_at: int) -> None:
        """Take a message from ROS. `sent_at` is wall-clock time. Raises KeyError for a topic without a route."""
        number = self._in_use.topic_numbers[topic]
        self._library.simulation_message(self._opened.address, number, data, len(data), sent_at)

    def send_again(self, topic: str, datagram: bytes) -> None:
        """Send the datagram of a request again. `topic` is the label of its service."""
        number = self._in_use.topic_numbers[topic]
        self._library.simulation_send_again(self._opened.address, number, datagram, len(datagram))

    def advance(self, to: int) -> None:
        """Advance the clock to that time, and serve timers that become due. Never goes back."""
        self._library.simulation_advance(self._opened.address, to)
        self.now = max(self.now, to)

    def set_clock(self, ahead: int) -> None:
        """Set how far the wall clock is ahead of the boot clock."""
        self._library.simulation_set_clock(self._opened.address, ahead)

    def end(self) -> None:
        """Stop as the router does."""
        self._library.simulation_end(self._opened.address)

    def records(self) -> Iterator[Record]:
        """Yield the records since the last call. Raises MemoryError."""
        size = ctypes.c_size_t()
        address = self._library.simulation_records(self._opened.address, ctypes.byref(size))
        if size.value and not address:
            raise MemoryError("there is no room for the records of the simulation")
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

    def _why_rejected(self, listener: str, reason: int, data: bytes, length: int) -> str:
        return why_rejected(self._in_use.program, listener, reason, data, length)

    def _superseded(self, listener: str, data: bytes) -> str:
        return superseded(self._in_use.program, listener, data)

    def _where_refused(self, route: str, topic: str | None, target: str, generation: int, place: int) -> str:
        """Return the place in the table; "" for messages held since an earlier program."""
        is_current = generation == self._generation
        return where_refused(self._in_use.program, route, topic, target, place) if is_current else ""


class _Opened:
    """The C simulation, its senders, and the program that it executes."""

    def __init__(self, library: ctypes.CDLL, now: int) -> None:
        self.library = library
        self.counters = (ctypes.c_int64 * MOST_COUNTERS)()
        self.running: _Running | None = None
        self._senders: dict[tuple[str, Peer], _Sender] = {}
        self._open(now)

    def _open(self, now: int) -> None:
        self.address: int = self.library.simulation_open(self.counters, now) or 0
        if not self.address:
            raise MemoryError("the simulation cannot be opened")
        self.timers: int = self.library.simulation_timers(self.address)

    def sender(self, endpoint: str, address: Peer) -> _Sender:
        """Return the sender of an endpoint; one that gets another address gets another sender."""
        if (endpoint, address) not in self._senders:
            self._senders[endpoint, address] = _Sender(self.library, has_address=address != LEARNED)
        return self._senders[endpoint, address]

    def reopen(self, now: int) -> None:
        self.close()
        ctypes.memset(self.counters, 0, ctypes.sizeof(self.counters))
        self._open(now)

    def close(self) -> None:
        """End all timers, and free them before the simulation."""
        if not self.address:
            return
        self.library.simulation_end(self.address)
        if self.running is not None:
            self.running.image.close()
        self.running = None
        self.library.simulation_close(self.address)
        self.address = 0


class _Sender:
    """A sender without a socket. It has no address until that is learned."""

    def __init__(self, library: ctypes.CDLL, *, has_address: bool) -> None:
        self._library = library
        number = int(has_address)  # nothing is sent there
        self.address = int(library.sender_open(-1, -1, number, number) or 0)
        if not self.address:
            raise MemoryError("a sender of the simulation cannot be opened")

    def __del__(self) -> None:
        if self.address:
            self._library.sender_close(self.address)


class _Topic:
    """A topic with a subscriber. Stands for `ros.endpoints.Publication`."""

    address = 0
    demand = c.Demand(wanted=c.Wanted.EVERY_MESSAGE)


_TOPIC = _Topic()


class _Running:
    """A program as the simulation executes it. Listeners and topics are numbered by their index in its arrays."""

    def __init__(self, program: CompiledTable, image: LoadedImage) -> None:
        self.program, self.image = program, image
        plans = [*program.table.sockets, *(listener for listener, _ in program.links)]
        self.listeners: Mapping[str, int] = {plan.name: number for number, plan in enumerate(plans)}
        routes = {topic: each for topic, each, _ in image.ros_routes()} | image.requests()
        self.topic_numbers: Mapping[str, int] = {topic: number for number, topic in enumerate(routes)}
        topics = [c.RosTopic(routes=each, route_count=len(each)) for each in routes.values()]
        self.topics = (c.RosTopic * len(topics))(*topics)
