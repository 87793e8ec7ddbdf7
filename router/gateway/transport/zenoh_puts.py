"""Puts frames into a Zenoh network, in threads: a put may wait for a network that is slower. Knows no loop.

Large values go beside the others, with less priority and of each key only the newest: what is small need not wait.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Future
from typing import NamedTuple

import zenoh

from router.errors import TransportError
from router.gateway.transport.base import Frame
from router.threads.daemon_thread import DaemonThread

LARGE = 64 * 1024
"""Bytes from which on a put can take long."""


class Lost(NamedTuple):
    """Frames that were not put, and why."""

    error: Exception
    frames: int


class Putter:
    """Puts under KEY/data/TOPIC and KEY/schema/TYPE. A key that once had a large value is a large one from then on."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session = session
        self._key = key
        self._small = DaemonThread("zenoh puts")
        self._large = DaemonThread("zenoh large puts")
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._large_keys: set[str] = set()
        self._large_waiting: dict[str, bytes] = {}
        self._failed_large: list[Exception] = []
        self._lock = threading.Lock()

    def put(self, frames: Sequence[Frame]) -> Future[list[Lost]]:
        """Done when the small ones are with Zenoh, and the large ones on their way. Gives what was lost until then."""
        return self._small.submit(self._put_all, frames)

    def close(self) -> None:
        """Gives up what waits; a put that is under way ends when Zenoh lets it."""
        for executor in (self._small, self._large):
            executor.shutdown()

    def _put_all(self, frames: Sequence[Frame]) -> list[Lost]:
        lost = []
        for frame in frames:
            key = key_of(self._key, frame)
            if len(frame.data) > LARGE:
                self._large_keys.add(key)
            try:
                if key in self._large_keys:
                    self._put_aside(key, frame.data)
                else:
                    self._put(key, frame.data, is_large=False)
            except (zenoh.ZError, TransportError) as error:
                lost.append(Lost(error, 1))
        with self._lock:
            failed, self._failed_large = self._failed_large, []
        return lost + [Lost(error, 1) for error in failed]

    def _put_aside(self, key: str, data: bytes) -> None:
        """Raises TransportError for the one whose place this one takes."""
        with self._lock:
            is_newer = key in self._large_waiting
            self._large_waiting[key] = data
        if is_newer:
            raise TransportError("a large value was not put before the next one of its topic came")
        self._large.submit(self._put_large)

    def _put_large(self) -> None:
        with self._lock:
            key, data = next(iter(self._large_waiting.items()))
            del self._large_waiting[key]
        try:
            self._put(key, data, is_large=True)
        except Exception as error:  # noqa: BLE001 - told with the next frames
            with self._lock:
                self._failed_large.append(error)

    def _put(self, key: str, data: bytes, *, is_large: bool) -> None:
        """Raises ZError."""
        publisher = self._publishers.get((key, is_large))
        if publisher is None:
            priority = zenoh.Priority.DATA_LOW if is_large else zenoh.Priority.DATA
            drop = zenoh.CongestionControl.DROP
            publisher = self._session.declare_publisher(key, congestion_control=drop, priority=priority)
            self._publishers[key, is_large] = publisher
        publisher.put(data)


def key_of(root: str, frame: Frame) -> str:
    """Where a frame is found below the gateway's own key."""
    return f"{root}/schema/{frame.type_name}" if frame.is_schema else f"{root}/data/{frame.topic.lstrip('/')}"
