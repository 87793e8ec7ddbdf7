"""The native threads that forward and brake, and what they write to. They need neither ROS nor the table."""

from __future__ import annotations

import ctypes

from router.carrier.carrier import Carrier
from router.carrier.deadmen import Deadmen
from router.carrier.names import Names
from router.carrier.ring import Ring

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_COUNTERS = 1 << 18
"""Counters of each native thread: their addresses stay the same, so they cannot grow."""

_PUBLISHED, _EVENTS = 1 << 20, 1 << 18
"""Bytes that may wait: messages for topics, and events of a thread."""


class Forwarding:
    """The threads `receive` and `timers`, which run once `carrier` was started.

    `published` gets the messages for topics. `names` are those that are known already.
    """

    def __init__(self, library: ctypes.CDLL, names: Iterable[str] = ()) -> None:
        """Raises MemoryError."""
        self.library = library
        self.names = Names(names)
        self.published = Ring(library, _PUBLISHED)
        self.deadmen = Deadmen(library, *counts_and_events(library), self.names)
        self.carrier = Carrier(library, self.deadmen.address, *counts_and_events(library), self.published)


def counts_and_events(library: ctypes.CDLL) -> tuple[ctypes.Array[ctypes.c_int64], Ring]:
    """What a native thread counts in, and writes its events to. Raises MemoryError."""
    return (ctypes.c_int64 * MOST_COUNTERS)(), Ring(library, _EVENTS)
