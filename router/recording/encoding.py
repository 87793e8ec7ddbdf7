"""From datagrams to chunks of a recording, many at a time: what recording costs is spent here.

Knows how datagrams are encoded, and no file and no thread; payloads and senders are as `Classifier` says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, chain, count, repeat
from operator import getitem, itemgetter, le
from typing import NamedTuple, cast

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from mcap.opcode import Opcode

from router.engine import MAX_DATAGRAM
from router.engine.slow_path import LEN
from router.recording.channels import Channels, Peer, varint
from router.recording.chunk import BEHIND_LENGTH, HEAD, Chunk, ChunkBuilder
from router.recording.mirror import Classifier, Mirrored
from router.recording.schemas import Datagram
from router.types.protobuf import PayloadCase

_SEQUENCE = 0xFFFFFFFF
_TAG = itemgetter(slice(2))
_MOST_SHAPES = 8192
_CLOCK_WAS_SET = 1_000_000
"""ns. What the wall clock has moved by beside the monotonic one; less is a clock that is being slewed."""


class _Shape(NamedTuple):
    """What datagrams have in common that come from one sender with one length and payload case.

    `length` and `size` are those of the message record behind its length field, and as a whole.
    """

    header: bytes
    skip: slice
    length: int
    channel: int
    size: int
    notes: list[int]
    parse: Callable[[bytes], Message]


class Encoder:
    """Datagrams go in with `add` in the order in which they came, chunks come out of `take`.

    Messages have the wall clock for log time. Their publish time is the same as long as nobody sets the clock, and
    never goes back: it is what replaying goes by. `sequence` is how many datagrams came before the first.
    """

    def __init__(self, channels: Channels, sequence: int = 0) -> None:
        self._channels = channels
        self._chunk = ChunkBuilder()
        self._datagrams = self._bytes = 0
        self._sequence = sequence
        self._first_ahead: int | None = None
        self._shift = self._steady = 0
        self._shapes: dict[tuple[str, Peer, int, bytes], _Shape] = {}
        self._payload_channels: dict[tuple[str, str, Peer], int | None] = {}

    @property
    def offset(self) -> int:
        """Bytes that the next chunk has so far, not compressed."""
        return self._chunk.offset

    def know(self, known: Classifier) -> None:
        """To be called first, and again when it is another."""
        self._known = known
        self._tags = {varint(case.number << 3 | LEN): case for case in known.envelope.cases.values()}
        self._shapes.clear()
        self._payload_channels.clear()

    def add(self, batch: Sequence[Mirrored], wall: int, monotonic: int) -> None:
        """`wall` and `monotonic` are what the two clocks said when the batch was seen (ns)."""
        if not batch:
            return
        self._datagrams += len(batch)
        times, listeners, peers, data = zip(*batch, strict=True)
        steady = self._steady_times(times, wall, monotonic)
        shapes = self._shapes_of(listeners, peers, data)
        if None in shapes:
            for each, came, shape in zip(batch, steady, shapes, strict=True):
                at, _, _, datagram = each
                if shape is not None:
                    self._add_usual((at,), (came,), (shape,), (datagram,))
                else:
                    self._add_unusual(each, came)
        else:
            self._add_usual(times, steady, cast("Sequence[_Shape]", shapes), data)
        self._bytes += sum(map(len, data))

    def take(self) -> Chunk | None:
        """What was added since the last time, None where that is nothing."""
        chunk = self._chunk.take(self._datagrams, self._bytes, self._steady)
        self._datagrams = self._bytes = 0
        return chunk

    def drop(self) -> int:
        """Forgets what was added since the last time, which a fault may have left half done. How many that were."""
        dropped, self._datagrams, self._bytes = self._datagrams, 0, 0
        self._chunk = ChunkBuilder()
        self._shapes.clear()  # they know the old chunk
        return dropped

    def _steady_times(self, times: Sequence[int], wall: int, monotonic: int) -> Sequence[int]:
        """What the clock that nobody sets said when each datagram came; as `times` while nobody sets the other."""
        if self._first_ahead is None:
            self._first_ahead = wall - monotonic
        now = monotonic + self._first_ahead
        if abs(now - wall - self._shift) > _CLOCK_WAS_SET:
            self._shift = now - wall
        latest, shift, steady = now + _CLOCK_WAS_SET, self._shift, self._steady
        if not shift and steady <= times[0] and times[-1] <= latest and all(map(le, times, times[1:])):
            self._steady = times[-1]
            return times
        found = [steady := max(steady, min(at + shift, latest)) for at in times]
        self._steady = steady
        return found

    def _add_usual(
        self, times: Sequence[int], steady: Sequence[int], shapes: Sequence[_Shape], data: Sequence[bytes]
    ) -> None:
        """Each is as its shape says. Nothing here is a loop of Python's own: that would take twice as long."""
        skips, lengths, channels, sizes, notes = tuple(zip(*shapes, strict=True))[1:6]
        sequences = map(_SEQUENCE.__and__, count(self._sequence + 1))
        self._sequence += len(data)
        heads = map(HEAD.pack, repeat(Opcode.MESSAGE.value), lengths, channels, sequences, times, steady)
        chunk = self._chunk
        payloads: Iterator[bytes] = map(getitem, data, skips)  # type: ignore[arg-type]  # mypy takes another overload
        chunk.pieces += chain.from_iterable(zip(heads, payloads, strict=True))
        *offsets, chunk.offset = accumulate(sizes, initial=chunk.offset)
        deque(map(list.extend, notes, zip(times, offsets, strict=True)), maxlen=0)

    def _shapes_of(
        self, listeners: Sequence[str], peers: Sequence[Peer], data: Sequence[bytes]
    ) -> Sequence[_Shape | None]:
        """None for each that is to be recorded raw."""
        keys = zip(listeners, peers, map(len, data), map(_TAG, data), strict=True)
        shapes = list(map(self._shapes.get, keys))
        if None in shapes:
            shapes = list(map(self._shape, listeners, peers, data))
        shapes = [
            shape if shape is not None and each.startswith(shape.header) else None
            for shape, each in zip(shapes, data, strict=True)
        ]
        usual = (
            [each for shape, each in zip(shapes, data, strict=True) if shape is not None] if None in shapes else data
        )
        if _parses(self._known.envelope.message_class.FromString, b"".join(usual)):
            return shapes
        return [
            shape if shape is not None and _parses(shape.parse, each[shape.skip]) else None
            for shape, each in zip(shapes, data, strict=True)
        ]

    def _shape(self, listener: str, peer: Peer, data: bytes) -> _Shape | None:
        """None for a datagram that is not one field, encoded as protobuf encodes it, of a known case."""
        if (known := self._shapes.get((listener, peer, len(data), data[:2]))) is not None:
            return known
        tag = next((data[:size] for size in (1, 2, 3) if data[:size] in self._tags), None)
        header = _header(tag, data) if tag is not None and len(data) <= MAX_DATAGRAM else None
        if tag is None or header is None:
            return None
        case = self._tags[tag]
        channel = self._payload_channel(case, listener, peer)
        if channel is None:
            return None
        size = len(data) - len(header)
        notes, parse = self._chunk.index(channel), case.message_class.FromString
        skip = slice(len(header), None)
        shape = _Shape(header, skip, BEHIND_LENGTH + size, channel, HEAD.size + size, notes, parse)
        if len(self._shapes) >= _MOST_SHAPES:
            self._shapes.clear()
        self._shapes[listener, peer, len(data), data[:2]] = shape
        return shape

    def _payload_channel(self, case: PayloadCase, listener: str, peer: Peer) -> int | None:
        sender = (case.name, listener, peer)
        if sender not in self._payload_channels:
            if len(self._payload_channels) >= _MOST_SHAPES:
                self._payload_channels.clear()
            endpoint = self._known.sender(listener, peer)
            self._payload_channels[sender] = self._channels.payload(case, listener, peer, endpoint)
        return self._payload_channels[sender]

    def _add_unusual(self, shown: Mirrored, steady: int) -> None:
        """The datagram as it is, and its payload where there is one, so that people see that as well."""
        at, listener, peer, data = shown
        self._sequence += 1
        times = (self._sequence & _SEQUENCE, at, steady)
        endpoint = self._known.sender(listener, peer)
        raw = Datagram(listener=listener, peer=f"{peer[0]}:{peer[1]}", data=data, endpoint=endpoint)
        self._chunk.add(self._channels.datagrams(), raw.SerializeToString(), *times)
        if (found := self._known.payload(listener, data)) is not None:
            case, payload = found
            self._chunk.add(self._channels.view(case), payload.SerializeToString(), *times)


def _parses(parse: Callable[[bytes], Message], data: bytes) -> bool:
    """Envelopes one behind the other are one envelope, and each of their fields is parsed: so much faster than each."""
    try:
        parse(data)
    except ProtobufError:
        return False
    return True


def _header(tag: bytes, data: bytes) -> bytes | None:
    """Tag and length, where the length is as short as it can be and that of all that follows."""
    for size in (1, 2, 3):
        header = tag + varint(max(0, len(data) - len(tag) - size))
        if len(header) == len(tag) + size and data.startswith(header):
            return header
    return None
