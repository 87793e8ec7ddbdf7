"""The thread that publishes on topics, from one program to the next."""

from __future__ import annotations

import ctypes

from router import declared as c
from router.carrier.outlets import Names
from router.carrier.publishing import PublishThread
from router.carrier.ring import Ring
from router.errors import StartError
from router.log import logger


class Publishing:
    """The thread, which starts with the first program that has topics.

    `counts` is the array that the thread counts in, `ring` has the messages for it.
    """

    def __init__(
        self, library: ctypes.CDLL, ring: Ring, counts: ctypes.Array[ctypes.c_int64], events: Ring, names: Names
    ) -> None:
        self.ring = ring
        self._library = library
        self._counts, self._events, self._names = counts, events, names
        self._thread: PublishThread | None = None

    def open(self) -> None:
        """Start the thread, for a program that has topics. Raises StartError."""
        if self._thread is not None:
            return
        functions = functions_of_rcl(self._library)
        try:
            self._thread = PublishThread(self._library, self.ring, self._counts, self._events, functions)
        except MemoryError as error:
            raise StartError(str(error)) from error

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        return self._thread.counters(count) if self._thread else list(self._counts[:count])

    def change(self, change: c.PublishChange) -> None:
        """Make a change of timers when its generation is reached. It stays the caller's until then."""
        if self._thread is not None:
            self._thread.change(change)

    def advance(self, generation: int) -> None:
        """Go on to that generation once all earlier messages are published: none of them can come any more."""
        if self._thread is not None:
            self._thread.advance(generation)

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until nothing of earlier generations is in use. Return False after `timeout` s."""
        return self._thread is None or self._thread.wait_for(generation, timeout)

    def stalled(self) -> tuple[str, float] | None:
        """The topic in whose publisher the thread is now, and for how many seconds."""
        stalled = self._thread.stalled() if self._thread else None
        return (self._names.name(stalled[0]), stalled[1]) if stalled else None

    def stop(self) -> bool:
        """Publish what waits, and end. Return False if the thread is stuck: publishers must stay open then.

        Idempotent.
        """
        has_ended = self._thread is None or self._thread.stop()
        if not has_ended:
            logger.error("a thread is stuck, and the router ends without it", threads=["publish"])
        return has_ended


def functions_of_rcl(library: ctypes.CDLL) -> tuple[int, int, int]:
    """Addresses of what publishes, and of what says and forgets why it could not. Raises StartError."""
    from router.ros.rcl import publish_functions  # rclpy is there: the topics are open

    functions = None if library.rcl_types_differ() else publish_functions()
    if functions is None:
        raise StartError(
            "rcl, by which ROS publishes, has other structures than the carrier expects",
            "run the router with ROS 2 Jazzy, and 'make setup' after each upgrade of ROS",
        )
    return functions
