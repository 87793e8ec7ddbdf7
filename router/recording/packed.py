"""Datagrams in memory, many in few pieces: small, soon made, and nothing to do for who looks for garbage.

Knows no file and no payload; `Classifier` is what was to be known of payloads and senders when they came.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

from router.recording.mirror import Classifier, Mirrored

_BESIDE_DATA = 14
"""Bytes that are kept of a datagram beside its data."""
_BESIDE_BATCH = 800
_MOST_SENDERS = 4096

Sender = tuple[str, "tuple[str, int]"]


class Packed(NamedTuple):
    """A batch as the mirror showed it. `wall` and `monotonic` are what the clocks said then (ns); `before`: how many
    datagrams came before it."""

    known: Classifier
    before: int
    wall: int
    monotonic: int
    times: array[int]
    lengths: array[int]
    numbers: array[int]
    senders: Sequence[Sender]
    data: bytes

    @property
    def size(self) -> int:
        """Bytes of memory, about."""
        return len(self.data) + _BESIDE_DATA * len(self.times) + _BESIDE_BATCH

    def unpacked(self) -> list[Mirrored]:
        data, senders = self.data, self.senders
        found: list[Mirrored] = []
        for at, number, length, end in zip(
            self.times, self.numbers, self.lengths, accumulate(self.lengths), strict=True
        ):
            listener, peer = senders[number]
            found.append((at, listener, peer, data[end - length : end]))
        return found


class Packer:
    """Knows senders by numbers. For one thread."""

    def __init__(self) -> None:
        self._senders: list[Sender] = []
        self._numbers: dict[Sender, int] = {}
        self._packed = 0

    def pack(self, batch: Sequence[Mirrored], known: Classifier, wall: int, monotonic: int) -> Packed:
        times, listeners, peers, data = zip(*batch, strict=True)
        try:
            numbers = array("H", map(self._numbers.__getitem__, zip(listeners, peers, strict=True)))
        except KeyError:
            numbers = self._numbered(list(zip(listeners, peers, strict=True)))
        lengths = array("H", map(len, data))
        before = self._packed
        self._packed += len(batch)
        return Packed(
            known, before, wall, monotonic, array("Q", times), lengths, numbers, self._senders, b"".join(data)
        )

    def _numbered(self, senders: list[Sender]) -> array[int]:
        """Where there is a new one. Of one who changes his port each time, lists are begun anew."""
        if len(self._senders) > _MOST_SENDERS:
            self._senders, self._numbers = [], {}
        for sender in senders:
            if sender not in self._numbers:
                self._numbers[sender] = len(self._senders)
                self._senders.append(sender)
        return array("H", map(self._numbers.__getitem__, senders))
