"""What clients of one transport have sent of messages that are not whole yet: bounded for all of them together.

Knows no socket and no framing.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

MOST_UNFINISHED = 64 << 20
"""Bytes, of all clients of a transport. A single message may be longer."""

UNFINISHED_SECONDS = 10.0
"""A client that has begun a message, and sends nothing for so long, does not end it."""

C = TypeVar("C")


class _Begun(NamedTuple):
    size: int
    heard_at: float


class Unfinished(Generic[C]):
    """`most` is in bytes, clocks are monotonic and in seconds."""

    def __init__(self, most: int) -> None:
        self.size = 0
        self._most = most
        self._begun: dict[C, _Begun] = {}

    def holds(self, client: C, size: int, now: float) -> C | None:
        """To be told whenever `client` has sent something; `size` of its bytes are no whole message yet.

        Returns who is to be closed, because all hold too much and it the most; that one is forgotten.
        """
        self.forget(client)
        if size:
            self._begun[client] = _Begun(size, now)
            self.size += size
        if self.size <= self._most:
            return None
        largest = max(self._begun, key=lambda each: self._begun[each].size)
        self.forget(largest)
        return largest

    def forget(self, client: C) -> int:
        """Returns how many bytes it held."""
        begun = self._begun.pop(client, None)
        if begun is None:
            return 0
        self.size -= begun.size
        return begun.size

    def silent(self, now: float) -> list[C]:
        """Those who do not end what they have begun."""
        return [client for client, begun in self._begun.items() if now - begun.heard_at >= UNFINISHED_SECONDS]
