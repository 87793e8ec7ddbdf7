"""Packets in datagrams (`gateway_v2`) and back: small ones share one, a large one is spread over several.

Like a packet, a datagram begins with time and kind (`packets.HEAD`). After that:

    2, a batch       uint16 LE length and packet, again and again
    3, a fragment    uint32 LE id, uint16 LE index, uint16 LE count, then a part of one packet

All fragments of a packet have the same time, id and count. Knows no sockets, no clock.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field

from router.gateway.packets import HEAD, PacketError

BATCH = 2
FRAGMENT = 3

LENGTH = struct.Struct("<H")
PLACE = struct.Struct("<IHH")
"""A fragment's id, index and count, after the head."""

_MOST_PARTS = 0xFFFF

_PART_COST = 150
"""Bytes that Python needs for a part beside its content, about."""

_MOST_REMEMBERED = 1024
"""Packets that are finished, whose fragments may still come twice."""


def capacity(most: int) -> int:
    """The longest packet in bytes that fits into as many fragments of `most` bytes as there can be."""
    return _MOST_PARTS * (most - HEAD.size - PLACE.size)


def datagrams(packets: Iterable[bytes], most: int, time: float, ids: Iterator[int]) -> Iterator[bytes]:
    """The packets in their order, in datagrams of at most `most` bytes; one that is alone in its datagram goes bare.

    `time` is wall-clock seconds; `ids` gives each large packet another number below 2**32.
    Raises PacketError for a packet beyond `capacity`, when those before it have been given.
    """
    waiting: list[bytes] = []
    room = most - HEAD.size
    for packet in packets:
        needed = LENGTH.size + len(packet)
        if needed > room:
            yield from _batch(waiting, time)
            waiting, room = [], most - HEAD.size
        if len(packet) > most:
            yield from _fragments(packet, most, time, next(ids))
        elif needed > room:  # only head and length of a batch keep it from sharing
            yield packet
        else:
            waiting.append(packet)
            room -= needed
    yield from _batch(waiting, time)


def _batch(packets: list[bytes], time: float) -> Iterator[bytes]:
    if len(packets) > 1:
        parts = (part for packet in packets for part in (LENGTH.pack(len(packet)), packet))
        yield HEAD.pack(time, BATCH) + b"".join(parts)
    else:
        yield from packets


def _fragments(packet: bytes, most: int, time: float, number: int) -> Iterator[bytes]:
    size = most - HEAD.size - PLACE.size
    count = -(-len(packet) // size)
    if count > _MOST_PARTS:
        raise PacketError(f"a packet of {len(packet)} bytes does not fit into {_MOST_PARTS} datagrams of {most}")
    head = HEAD.pack(time, FRAGMENT)
    for index in range(count):
        yield head + PLACE.pack(number, index, count) + packet[index * size : (index + 1) * size]


@dataclass(slots=True)
class _Open:
    """A packet of which parts are missing. `size` in bytes as they count; `seen`, monotonic ns, of the newest part."""

    count: int
    seen: int
    size: int = 0
    parts: dict[int, bytes] = field(default_factory=dict)


class Reassembler:
    """Whole packets from datagrams, in whatever order and however often those arrive.

    Senders may lie: what waits is bounded in number, bytes and time. `lost` counts the packets that were given up:
    a part did not come in time, or too much was open at once. A packet is known by its sender, the time that the
    sender wrote, and its id; one that starts anew may use ids again.
    """

    def __init__(self, most_bytes: int = 64 << 20, most_open: int = 16, timeout_ns: int = 2_000_000_000) -> None:
        self.lost = 0
        self._most_bytes = most_bytes
        self._most_open = most_open
        self._timeout = timeout_ns
        self._bytes = 0
        self._open: OrderedDict[Hashable, _Open] = OrderedDict()  # by when a part last came
        self._done: OrderedDict[Hashable, int] = OrderedDict()  # finished or given up, and when

    def feed(self, datagram: bytes, sender: Hashable, now: int) -> list[bytes]:
        """The packets that are whole now; `now` in monotonic ns. Raises PacketError for what is no such datagram."""
        self.look(now)
        if len(datagram) < HEAD.size:
            raise PacketError(f"{len(datagram)} bytes are no packet")
        kind = datagram[HEAD.size - 1]
        if kind == BATCH:
            return list(_batched(datagram))
        if kind == FRAGMENT:
            return self._fragment(datagram, sender, now)
        return [datagram]

    def look(self, now: int) -> None:
        """Time has passed: give up what has waited too long for its next part."""
        while self._open and now - next(iter(self._open.values())).seen > self._timeout:
            self._give_up(now)
        while self._done and now - next(iter(self._done.values())) > self._timeout:
            self._done.popitem(last=False)

    def _fragment(self, datagram: bytes, sender: Hashable, now: int) -> list[bytes]:
        start = HEAD.size + PLACE.size
        if len(datagram) <= start:
            raise PacketError(f"{len(datagram)} bytes are no fragment")
        number, index, count = PLACE.unpack_from(datagram, HEAD.size)
        if index >= count:
            raise PacketError(f"fragment {index} of {count}")
        key = (sender, number, datagram[: HEAD.size])
        if key in self._done:
            return []
        packet = self._open.get(key) or _Open(count, now)
        part = datagram[start:]
        if packet.count != count:
            raise PacketError(f"fragments of one packet say that there are {packet.count} and {count}")
        if packet.parts.get(index, part) != part:
            raise PacketError(f"fragment {index} came twice with different content")
        if index not in packet.parts:
            self._open[key] = packet
            self._keep(packet, index, part, now)
            self._open.move_to_end(key)
        if len(packet.parts) == count:
            self._finish(key, now)
            return [_whole(packet)]
        while self._bytes > self._most_bytes or len(self._open) > self._most_open:
            self._give_up(now)
        return []

    def _keep(self, packet: _Open, index: int, part: bytes, now: int) -> None:
        packet.parts[index] = part
        packet.seen = now
        packet.size += len(part) + _PART_COST
        self._bytes += len(part) + _PART_COST

    def _give_up(self, now: int) -> None:
        """Lose the packet that has waited longest."""
        self.lost += 1
        self._finish(next(iter(self._open)), now)

    def _finish(self, key: Hashable, now: int) -> None:
        self._bytes -= self._open.pop(key).size
        self._done[key] = now
        if len(self._done) > _MOST_REMEMBERED:
            self._done.popitem(last=False)


def _whole(packet: _Open) -> bytes:
    return _bare(b"".join(packet.parts[index] for index in range(packet.count)))


def _batched(datagram: bytes) -> Iterator[bytes]:
    start = HEAD.size
    while start < len(datagram):
        if len(datagram) < start + LENGTH.size:
            raise PacketError("the batch ends within a length")
        [length] = LENGTH.unpack_from(datagram, start)
        start += LENGTH.size
        if len(datagram) < start + length:
            raise PacketError(f"the batch ends within a packet of {length} bytes")
        yield _bare(datagram[start : start + length])
        start += length


def _bare(packet: bytes) -> bytes:
    """Batches and fragments hold packets, not each other."""
    if len(packet) < HEAD.size or packet[HEAD.size - 1] in {BATCH, FRAGMENT}:
        raise PacketError("a batch or a fragment within another, or what is no packet")
    return packet
