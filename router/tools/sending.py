"""One datagram sent once or at a rate."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass

from router.errors import TransportError
from router.table.addresses import Address


def paced(count: int | None, rate: float | None) -> Iterator[float]:
    """Yield `count` times (None: for ever) at `rate` Hz (None: at once) the seconds since the first time."""
    start = time.monotonic()
    for index in itertools.count() if count is None else range(count):
        now = time.monotonic()
        if rate is not None and (wait := start + index / rate - now) > 0:
            time.sleep(wait)
            now = time.monotonic()
        yield now - start


@dataclass(slots=True)
class Sent:
    """Datagrams handed to the kernel, the seconds from the first to the last, and those that nobody took.

    `refused` counts answers of the other machine that no socket is bound there; they may arrive late.
    """

    count: int = 0
    seconds: float = 0.0
    refused: int = 0

    @property
    def rate(self) -> float:
        """Datagrams per second, 0 when one alone leaves no time to measure."""
        return (self.count - 1) / self.seconds if self.seconds > 0 else 0.0


def send(sender: socket.socket, to: Address, data: bytes, count: int | None, rate: float | None, sent: Sent) -> None:
    """Send `count` times (None: until interrupted) at `rate` Hz (None: at once), counting in `sent`.

    `sent` is the caller's, so that an interrupt loses no count. Raises TransportError.
    """
    try:
        sender.setblocking(True)
        sender.connect(to)
        for elapsed in paced(count, rate):
            _send_one(sender, data, sent)
            sent.count += 1
            sent.seconds = elapsed
    except OSError as error:
        raise TransportError(f"cannot send to {to}: {error.strerror}") from error
    if sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
        sent.refused += 1


def _send_one(sender: socket.socket, data: bytes, sent: Sent) -> None:
    """A connected socket reports the refusal of an earlier datagram in place of sending this one."""
    try:
        sender.send(data)
    except ConnectionRefusedError:
        sent.refused += 1
        sender.send(data)
