"""Deferrals and pacers on a simulated clock, without threads and sockets: see deferring.c."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import POINTER, byref, c_bool, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from pathlib import Path
from struct import Struct
from typing import NamedTuple

from router import declared as c
from router.carrier.build import NATIVE, compile_c
from router.carrier.owned import OwnedPointer, open_native
from router.compiler.refusals import DROP_REASON_NAMES
from router.image.openings import period
from router.table.model.targets import Priority
from tests.carrier.building import MEMORY, sanitizing

NEVER = (1 << 63) - 1
_NOTED = Struct("@IIqII")
_FATES = ("sent", "bytes", *DROP_REASON_NAMES)

_FUNCTIONS: dict[str, tuple[type | None, tuple[type, ...]]] = {
    "seam_open": (c_void_p, ()),
    "seam_close": (None, (c_void_p,)),
    "seam_target": (c_uint32, (c_void_p, c_void_p, c_int64, c_uint32, c_bool)),
    "seam_offer": (None, (c_void_p, c_uint32, c_char_p, c_size_t, c_int64, c_int64)),
    "seam_offer_written": (None, (c_void_p, c_uint32, c_char_p, c_size_t, c_int64, c_int64)),
    "seam_adopt": (None, (c_void_p, c_void_p, c_uint32)),
    "seam_end": (None, (c_void_p, c_void_p)),
    "seam_end_all": (None, (c_void_p,)),
    "seam_set": (None, (c_void_p, c_int64, c_int)),
    "seam_give_up": (None, (c_void_p,)),
    "seam_is_untouched": (c_bool, (c_void_p,)),
    "seam_serve": (None, (c_void_p, c_int64)),
    "seam_next_due": (c_int64, (c_void_p,)),
    "seam_count": (c_int64, (c_void_p, c_uint32, c_uint32)),
    "seam_taken": (c_size_t, (c_void_p, POINTER(c_void_p))),
}


def deferring(output: Path, library: Path, *, is_sanitized: bool) -> ctypes.CDLL:
    """The functions of deferring.c, compiled to the library `output`, which uses the carrier's library."""
    flags = [*(sanitizing(MEMORY) if is_sanitized else ["-O1"]), "-fPIC", "-shared", f"-I{NATIVE}"]
    files = [str(Path(__file__).parent / "deferring.c"), str(library)]
    compile_c([*flags, *files, "-o", str(output)], "gcc" if is_sanitized else None)
    loaded = ctypes.CDLL(str(output))
    for name, (returned, taken) in _FUNCTIONS.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = returned, taken
    return loaded


class Output(NamedTuple):
    """A message that was sent or published: the time, its target, and its bytes."""

    at: int
    target: int
    data: bytes


class Deferring:
    """A group of timers, with a pacer if `bandwidth` is given. Targets are numbered in the order of `target` calls."""

    def __init__(self, library: ctypes.CDLL, functions: ctypes.CDLL, bandwidth: int | None = None) -> None:
        self.now = 0
        self._library, self._functions = library, functions
        self._address: int = functions.seam_open()
        self._pacer = (
            OwnedPointer(library.pacer_close, open_native(library, "pacer_open", bandwidth)) if bandwidth else None
        )
        self._deferrals: list[OwnedPointer] = []
        self._are_topics: list[bool] = []
        self._error = 0

    def close(self) -> None:
        self._functions.seam_close(self._address)

    def target(self, hertz: float | None, priority: Priority = Priority.COMMAND, *, is_topic: bool = False) -> int:
        """Add a target, with `on_limit: latest` if `hertz` is given, and with the bandwidth if there is one."""
        if self._pacer is not None and not self._deferrals:
            self._functions.seam_adopt(self._address, self._pacer.address, 0)
        pacer = None if is_topic else self._pacer
        address = open_native(self._library, "deferral_open", pacer.address if pacer else None)
        self._deferrals.append(OwnedPointer(self._library.deferral_close, address, pacer))
        return self._add(self._deferrals[-1], hertz, priority, is_topic=is_topic)

    def change(self, target: int, hertz: float | None, priority: Priority = Priority.COMMAND) -> int:
        """Replace a target, as a reload does, and return the number of the new one. The deferral stays."""
        self._deferrals.append(self._deferrals[target])
        return self._add(self._deferrals[target], hertz, priority, is_topic=self._are_topics[target])

    def _add(self, deferral: OwnedPointer, hertz: float | None, priority: Priority, *, is_topic: bool) -> int:
        self._are_topics.append(is_topic)
        between = period(hertz) if hertz else 0
        rank = c.Priority[priority.name]
        return int(self._functions.seam_target(self._address, deferral.address, between, rank, is_topic))

    def offer(self, target: int, data: bytes, expires: int | None = None, *, is_written: bool = False) -> None:
        """Deliver a datagram, or a message written by a machine."""
        offer = self._functions.seam_offer_written if is_written else self._functions.seam_offer
        offer(self._address, target, data, len(data), NEVER if expires is None else expires, self.now)

    def set(self, now: int) -> None:
        """Set the clock without serving timers."""
        self.now = now
        self._functions.seam_set(self._address, now, self._error)

    def refuse(self, error: int) -> None:
        """Make sending fail with this errno from now on; 0 makes it succeed."""
        self._error = error
        self.set(self.now)

    def give_up(self) -> None:
        """Abandon the thread when it publishes next, which frees its deferrals."""
        self._functions.seam_give_up(self._address)

    @property
    def is_untouched(self) -> bool:
        """Whether no freed deferral has been used since. They need no close."""
        for deferral in self._deferrals:
            deferral.address = 0
        return bool(self._functions.seam_is_untouched(self._address))

    def serve(self) -> None:
        self._functions.seam_serve(self._address, self.now)

    def wait(self, until: int) -> None:
        """Advance the clock, and serve each timer when it is due."""
        while (due := self.next_due) is not None and due <= until:
            self.set(max(due, self.now))
            self.serve()
        self.set(until)

    @property
    def next_due(self) -> int | None:
        due = self._functions.seam_next_due(self._address)
        return None if due == NEVER else int(due)

    def end(self, target: int) -> None:
        self._functions.seam_end(self._address, self._deferrals[target].address)

    def end_pacer(self) -> None:
        assert self._pacer is not None
        self._functions.seam_end(self._address, self._pacer.address)

    def end_all(self) -> None:
        self._functions.seam_end_all(self._address)

    def taken(self) -> list[Output]:
        """The messages sent or published since the last call."""
        return list(self._taken())

    def _taken(self) -> Iterator[Output]:
        notes = c_void_p()
        size = self._functions.seam_taken(self._address, byref(notes))
        records, position = ctypes.string_at(notes, size) if size else b"", 0
        while position < size:
            length_of_record, target, at, length, _ = _NOTED.unpack_from(records, position)
            start = position + _NOTED.size
            yield Output(at, target, records[start : start + length])
            position += length_of_record

    def counted(self, target: int) -> dict[str, int]:
        """The nonzero counts: `sent`, `bytes`, and drops by reason."""
        counts = {fate: self._functions.seam_count(self._address, target, which) for which, fate in enumerate(_FATES)}
        return {fate: count for fate, count in counts.items() if count}
