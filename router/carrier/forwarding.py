"""The native threads that forward and brake, and their queues. They need neither ROS nor the table."""

from __future__ import annotations

import ctypes
from mmap import MAP_PRIVATE, mmap

from router.carrier.deadmen import Deadmen
from router.carrier.forwarding_threads import ForwardingThreads
from router.carrier.loading import LoadedImage
from router.carrier.owned import open_native
from router.carrier.ring import Ring
from router.declared import MOST_COUNTERS
from router.image.names import Names

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from router.carrier.loading import Addressed
    from router.image.image import Image

FIRST_GENERATION = 1
"""The generation of a stored image; compiled ones have higher generations."""

_PUBLISHED, _MIRRORED, _ACTIONS, _EVENTS = 1 << 20, 1 << 22, 1 << 20, 1 << 18
"""Bytes of the queues: messages for topics, received datagrams and actions for observers, and events of a thread."""


class Forwarding:
    """The threads `receive` and `timers`, which run once they are started.

    `published` gets the messages for topics; while there are observers, `mirrored` gets the received datagrams, and
    `acted` the actions. `names` are the names known already, `counters` is the number of counters of the first program.
    """

    def __init__(self, library: ctypes.CDLL, counters: int, names: Iterable[str] = ()) -> None:
        """Raises MemoryError."""
        self.library = library
        self.names = Names(names)
        self.published, self.mirrored = Ring(library, _PUBLISHED), Ring(library, _MIRRORED)
        self.acted = Ring(library, _ACTIONS)
        self._actions = open_native(library, "actions_open", self.acted.address)
        self.deadmen = Deadmen(library, *counts_and_events(library, counters))
        self.threads = ForwardingThreads(
            library, self.deadmen.address, *counts_and_events(library, counters), self.published
        )

    def load(
        self, image: Image, senders: Mapping[str, Addressed], generation: int, before: LoadedImage | None = None
    ) -> LoadedImage:
        """Load an image for these threads. Raises MemoryError."""
        return LoadedImage(self.library, image, senders, self.deadmen.address, generation, before)

    def mirror(self, lost: int | None, *others: int) -> None:
        """Mirror received datagrams and actions from now on; `lost` counts those that full rings drop. None stops that.

        `others` are the addresses of further groups of timers whose actions are wanted.
        """
        self.library.actions_count_lost(self._actions, lost or 0)
        for group in (self.deadmen.address, *others):
            self.library.timers_observe(group, None if lost is None else self._actions)
        self.threads.mirror(None if lost is None else self.mirrored, lost or 0)


def counts_and_events(library: ctypes.CDLL, counters: int) -> tuple[ctypes.Array[ctypes.c_int64], Ring]:
    """Return counters and an event ring for a native thread. Raises MemoryError."""
    counts = fresh_counts()
    counts[:counters] = [0] * counters  # no page fault in the thread
    return counts, Ring(library, _EVENTS)


def fresh_counts() -> ctypes.Array[ctypes.c_int64]:
    """Return counters that never move, and use memory only where something is counted. Raises MemoryError."""
    pages = mmap(-1, MOST_COUNTERS * ctypes.sizeof(ctypes.c_int64), flags=MAP_PRIVATE)
    return (ctypes.c_int64 * MOST_COUNTERS).from_buffer(pages)
