"""Delivering messages without threads, sockets, clocks and middleware: see delivering.c."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from ctypes import POINTER, byref, c_bool, c_char_p, c_int64, c_size_t, c_uint32, c_void_p
from pathlib import Path
from struct import Struct
from typing import NamedTuple, Union

from router import declared as c
from router.carrier.build import NATIVE, compile_c
from router.carrier.owned import OwnedPointer, open_native
from router.compiler.lowering import LoweredFeed, LoweredRoute
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.routines import Routines, native_values
from router.compiler.refusals import DROP_REASON_NAMES
from router.declared import NONE
from router.image.targets import write_collect, write_for_each
from tests.carrier.building import MEMORY, sanitizing

FILTERED = "filtered"
_NOTED = Struct("@IIiIII")
_OF_ROUTE, _DELIVERED, _FILTERED, _COLLECTED, _SPLIT, _BYTES, _FIRST_DROP = range(7)
_OF_TARGET = _FIRST_DROP + c.DROP_REASONS
_LOSS = Struct("@6Ii3I2I3q")
"""`struct lost_event`."""


def delivering(output: Path, library: Path, *, is_sanitized: bool) -> ctypes.CDLL:
    """The functions of delivering.c, compiled to the library `output`, which uses the carrier's library."""
    flags = [*(sanitizing(MEMORY) if is_sanitized else ["-O1"]), "-fPIC", "-shared", f"-I{NATIVE}"]
    files = [str(Path(__file__).parent / "delivering.c"), str(library)]
    compile_c([*flags, *files, "-o", str(output)], "gcc" if is_sanitized else None)
    loaded = ctypes.CDLL(str(output))
    loaded.seam_open.restype, loaded.seam_open.argtypes = c_void_p, (c_void_p,)
    loaded.seam_close.restype, loaded.seam_close.argtypes = None, (c_void_p,)
    loaded.seam_datagram.restype, loaded.seam_datagram.argtypes = (
        c_size_t,
        (c_void_p, c_void_p, c_char_p, c_uint32, c_uint32, c_uint32, c_bool, c_uint32, c_int64, POINTER(c_void_p)),
    )
    loaded.seam_part.restype = c_size_t
    loaded.seam_part.argtypes = (
        c_void_p, c_void_p, c_char_p, c_uint32, c_uint32, c_uint32, c_bool, c_uint32, c_int64, c_int64,
        POINTER(c_void_p),
    )  # fmt: skip
    loaded.seam_adopt.restype, loaded.seam_adopt.argtypes = None, (c_void_p, c_void_p)
    loaded.seam_serve.restype, loaded.seam_serve.argtypes = c_int64, (c_void_p, c_int64)
    loaded.seam_losses.restype, loaded.seam_losses.argtypes = c_size_t, (c_void_p, POINTER(c_void_p))
    loaded.collector_open.restype, loaded.collector_open.argtypes = c_void_p, (c_int64,)
    loaded.collector_close.restype, loaded.collector_close.argtypes = None, (c_void_p,)
    loaded.seam_from_ros.restype, loaded.seam_from_ros.argtypes = (
        c_size_t,
        (c_void_p, c_void_p, c_char_p, c_size_t, c_int64, POINTER(c_void_p)),
    )
    return loaded


class Outcome(NamedTuple):
    """The result for a target: bytes, FILTERED, or the reason of the drop with its place in the table."""

    label: str
    got: Union[bytes, str]
    place: str = ""


class Payload(NamedTuple):
    """The position of a payload in its envelope: the payload if it `is_single`, else its pieces with their tags."""

    start: int
    length: int
    is_single: bool

    def of(self, envelope: bytes) -> bytes:
        return envelope[self.start : self.start + self.length]


class Delivering:
    """Delivers to all lowered targets of a route. The targets of messages from ROS are destinations.

    A target without a mapping gets the datagram. `source` is the name of a sender; with `collect` there may be
    more. Frames end after `timeout` ns.
    """

    def __init__(
        self,
        functions: ctypes.CDLL,
        lowered: LoweredRoute | LoweredFeed,
        received_at: int = 0,
        source: str = "",
        others: Sequence[str] = (),
        timeout: int = 1,
    ) -> None:
        self._functions, self._received_at = functions, received_at
        self._lowered = [*lowered.targets.values()]
        self._arrays = Arrays()
        self._counters = (c_int64 * (1 + (1 + len(self._lowered)) * _OF_TARGET))()
        routines = Routines(lowered.layout, self._arrays)
        demand, is_from_ros = c.Demand(wanted=c.Wanted.EVERY_MESSAGE), isinstance(lowered, LoweredFeed)
        topic = c.Topic(demand=ctypes.pointer(demand))
        self._held: list[object] = [demand, topic]
        targets = []
        for number, target in enumerate(self._lowered):
            first = 1 + number * _OF_TARGET
            made = c.Target(condition=routines.routine(target.condition), message=routines.routine(target.message))
            made.id, made.delivered, made.filtered = number, first + _DELIVERED, first + _FILTERED
            made.collected, made.delivered_bytes = first + _COLLECTED, first + _BYTES
            made.dropped[:] = [first + _FIRST_DROP + reason for reason in range(c.DROP_REASONS)]
            if target.message and not is_from_ros:
                made.topic = ctypes.pointer(topic)
            if target.elements is not None:
                made.for_each = ctypes.pointer(self._arrays.add(write_for_each(target.elements, routines)))
                made.split = first + _SPLIT
            targets.append(made)
        self._targets = c.Targets(
            targets=(c.Target * len(targets))(*targets),
            count=len(targets),
            sources=native_values([each.encode() for each in (source, *others)], self._arrays),
            topic=c.NO_NAME,
        )
        self._route: c.RosRoute | None = None
        if isinstance(lowered, LoweredFeed):
            self._route = c.RosRoute(
                for_each=write_for_each(lowered.for_each, routines), seconds=NONE, nanoseconds=NONE
            )
        self._adopted = (c.Adoption * 1)(c.Adoption(to=ctypes.pointer(self._targets)))
        if isinstance(lowered, LoweredRoute) and lowered.collect is not None:
            address = open_native(functions, "collector_open", timeout)
            collector = OwnedPointer(functions.collector_close, address)
            self._adopted[0].timer = ctypes.cast(collector.address, ctypes.POINTER(c.Timer))
            collect = write_collect(lowered.collect, routines, range(1 + len(others)))
            collect.collector = collector.address
            self._targets.collect = ctypes.pointer(collect)
            self._held.append(collector)
        self._targets.layout = routines.layout()
        if self._route is not None:
            self._route.targets = self._targets
        self._address = functions.seam_open(self._counters)
        if self._targets.collect:
            functions.seam_adopt(self._address, byref(c.TimerChange(adopted=self._adopted, adopted_count=1)))

    def __del__(self) -> None:
        self._functions.seam_close(self._address)

    @property
    def received(self) -> int:
        """The number of counted messages from ROS."""
        return self._counters[0]

    def datagram(self, data: bytes, payload: Payload | None = None) -> list[Outcome]:
        """Deliver an envelope with this payload, or a bare payload. Return one outcome per target."""
        notes, to = c_void_p(), byref(self._targets)
        about = *(payload or Payload(0, len(data), True)), 0, self._received_at
        size = self._functions.seam_datagram(self._address, to, data, len(data), *about, byref(notes))
        return [*self._outcomes(ctypes.string_at(notes.value or 0, size))]

    def part(self, data: bytes, now: int = 0, column: int = 0, payload: Payload | None = None) -> list[Outcome] | None:
        """Deliver an envelope to targets with `collect`. Without `payload`, it consists of the payload's pieces.

        Return one outcome per target if the datagram completes a frame, else None.
        """
        notes, to = c_void_p(), byref(self._targets)
        about = *(payload or Payload(0, len(data), False)), column, self._received_at, now
        size = self._functions.seam_part(self._address, to, data, len(data), *about, byref(notes))
        return [*self._outcomes(ctypes.string_at(notes.value or 0, size))] or None

    def serve(self, now: int) -> int:
        """Serve the timers that are due, and return when the next one is."""
        return int(self._functions.seam_serve(self._address, now))

    def end_frames(self) -> None:
        """End all frames and the collector."""
        ended = (c_void_p * 1)(ctypes.cast(self._adopted[0].timer, c_void_p))
        self._functions.seam_adopt(self._address, byref(c.TimerChange(ended=ended, ended_count=1)))

    def losses(self) -> list[tuple[str, str]]:
        """The losses before delivery since the last call: label and details."""
        events = c_void_p()
        length = self._functions.seam_losses(self._address, byref(events))
        records = ctypes.string_at(events.value or 0, length)
        made, at = [], 0
        while at < len(records):
            size, _, _, _, target, *_ = _LOSS.unpack_from(records, at)
            text = records[at + _LOSS.size : at + size].partition(b"\0")[0].decode()
            made.append((self._lowered[target].label, text))
            at += size
        return made

    def counted(self, label: str) -> dict[str, int]:
        """The nonzero counts of a target."""
        number = [each.label for each in self._lowered].index(label)
        of_target = self._counters[1 + number * _OF_TARGET :][:_OF_TARGET]
        names = (None, "delivered", "filtered", "collected", "split", None, *DROP_REASON_NAMES)
        return {name: count for name, count in zip(names, of_target, strict=True) if name and count}

    def from_ros(self, data: bytes) -> list[Outcome]:
        """Serve a message from ROS. Return one outcome per target, and per element with `for_each`."""
        notes = c_void_p()
        assert self._route is not None
        size = self._functions.seam_from_ros(
            self._address, byref(self._route), data, len(data), self._received_at, byref(notes)
        )
        return [*self._outcomes(ctypes.string_at(notes.value or 0, size))]

    def _outcomes(self, notes: bytes) -> Iterator[Outcome]:
        at = 0
        while at < len(notes):
            size, target, outcome, place, length, _ = _NOTED.unpack_from(notes, at)
            lowered = self._lowered[target]
            if outcome == -1:
                start = at + _NOTED.size
                yield Outcome(lowered.label, notes[start : start + length])
            else:
                yield Outcome(
                    lowered.label, FILTERED if outcome == -2 else DROP_REASON_NAMES[outcome], lowered.places[place]
                )
            at += size
