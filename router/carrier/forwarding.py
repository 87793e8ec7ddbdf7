"""The native threads that forward and brake, and what they write to. They need neither ROS nor the table."""

from __future__ import annotations

import ctypes
from mmap import MAP_PRIVATE, mmap

from router.carrier.carrier import Carrier
from router.carrier.deadmen import Deadmen
from router.carrier.names import Names
from router.carrier.ring import Ring

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_COUNTERS = 1 << 18
"""Counters of each native thread: their addresses stay the same, so they cannot grow."""

_PUBLISHED, _MIRRORED, _EVENTS = 1 << 20, 1 << 22, 1 << 18
"""Bytes that may wait: messages for topics, received datagrams for observers, and events of a thread."""


class Forwarding:
    """The threads `receive` and `timers`, which run once `carrier` was started.

    `published` gets the messages for topics, `mirrored` what is received while it is observed. `names` are those that
    are known already, `counters` are how many the first program has.
    """

    def __init__(self, library: ctypes.CDLL, counters: int, names: Iterable[str] = ()) -> None:
        """Raises MemoryError."""
        self.library = library
        self.names = Names(names)
        self.published, self.mirrored = Ring(library, _PUBLISHED), Ring(library, _MIRRORED)
        self.deadmen = Deadmen(library, *counts_and_events(library, counters), self.names)
        self.carrier = Carrier(library, self.deadmen.address, *counts_and_events(library, counters), self.published)

    def mirror(self, lost: int | None) -> None:
        """Have what is received be mirrored, or no longer. `lost` is the counter of what had no room."""
        self.carrier.mirror(None if lost is None else self.mirrored, lost or 0)


def counts_and_events(library: ctypes.CDLL, counters: int) -> tuple[ctypes.Array[ctypes.c_int64], Ring]:
    """What a native thread counts in, and writes its events to. Raises MemoryError.

    The counts never move, and take memory only where something was counted, or will soon be.
    """
    pages = mmap(-1, MOST_COUNTERS * ctypes.sizeof(ctypes.c_int64), flags=MAP_PRIVATE)
    counts = (ctypes.c_int64 * MOST_COUNTERS).from_buffer(pages)
    counts[:counters] = [0] * counters  # no page fault in the thread
    return counts, Ring(library, _EVENTS)
