"""The client: takes datagrams with the kernel's time of arrival, and works out afterwards what was in them.

Knows the packets, not who sends them.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from typing import NamedTuple

from benchmarks.gateway.topics import Kind
from router.gateway.packets import decompress

SO_TIMESTAMPNS = 35
BUFFER = 64 << 20
LONGEST = 64 << 20
NS = 1_000_000_000


class Arrival(NamedTuple):
    """One data packet. Times are wall-clock seconds: in the message, in the packet, of the last byte's arrival."""

    topic: str
    published: float
    sent: float
    received: float


class Receiver(AbstractContextManager["Receiver"]):
    """Keeps every datagram that comes to a port, until its context ends."""

    def __init__(self, port: int) -> None:
        self.port = port
        self._datagrams: list[tuple[int, bytes]] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_RCVBUF, 33):  # SO_RCVBUFFORCE, which takes a privilege
            with suppress(PermissionError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, BUFFER)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.settimeout(0.2)
        self._socket.bind(("127.0.0.1", port))
        self._stopping = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._stopping:
            try:
                data, [(_, _, time)], _, _ = self._socket.recvmsg(65535, 64)
            except TimeoutError:
                continue
            seconds, nanoseconds = struct.unpack("qq", time)
            self._datagrams.append((seconds * NS + nanoseconds, data))

    def keep(self, begin: float, end: float) -> None:
        """Only what came between two times, in wall-clock seconds, is of interest."""
        self._datagrams = [(time, data) for time, data in self._datagrams if begin <= time / NS < end]

    def bytes(self) -> int:
        return sum(len(data) for _, data in self._datagrams)

    def arrivals(self, kinds: Mapping[str, Kind]) -> Iterator[Arrival]:
        """Of all data packets, in their order; `kinds` by topic."""
        for time, packet in self._datagrams:
            (sent,) = struct.unpack_from("<d", packet)
            topic, _, payload = packet[9:].split(b"\0", 2)
            text = decompress(payload, LONGEST) if packet[8] else payload
            if not text.startswith(b'{"fields":'):
                yield Arrival(topic.decode(), kinds[topic.decode()].read(text), sent, time / NS)
