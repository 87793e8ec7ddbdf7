"""From datagrams to chunks of a recording, many at a time: what recording costs is spent here.

Knows payload cases and what the table calls senders; knows no file and no thread.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message
from mcap.opcode import Opcode

from router.compiler.network import recognisers
from router.edges.mirror import Shown
from router.edges.recorder_channels import Channels, Peer, varint
from router.edges.recorder_chunk import BEHIND_LENGTH, HEAD, Chunk, ChunkBuilder
from router.edges.recorder_schemas import Datagram
from router.engine import MAX_DATAGRAM
from router.engine.framing import LEN, restored
from router.table.model import Endpoint
from router.types.protobuf import Envelope, PayloadCase

_SEQUENCE = 0xFFFFFFFF
_MOST_SHAPES = 8192
_CLOCK_WAS_SET = 1_000_000
"""ns. What the wall clock has moved by beside the monotonic one; less is a clock that is being slewed."""


class _Shape(NamedTuple):
    """What datagrams have in common that come from one sender with one length and payload case.

    `length` and `size` are those of the message record behind its length field, and as a whole.
    """

    header: bytes
    skip: int
    length: int
    channel: int
    size: int
    note: Callable[[int], object]
    parse: Callable[[bytes], Message]


class Known(NamedTuple):
    """What payloads there are, and who sends them, in one table."""

    envelope: Envelope
    by_host: Mapping[str, str]
    by_address: Mapping[Peer, str]
    tags: Mapping[bytes, PayloadCase]

    @staticmethod
    def of(envelope: Envelope, endpoints: Mapping[str, Endpoint]) -> Known:
        tags = {varint(case.number << 3 | LEN): case for case in envelope.cases.values()}
        return Known(envelope, *recognisers(endpoints), tags)

    def endpoint(self, peer: Peer) -> str:
        """What the table calls a sender; empty for a stranger."""
        return self.by_address.get(peer) or self.by_host.get(peer[0]) or ""


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

    def know(self, known: Known) -> None:
        """To be called first, and again when it is another."""
        self._known = known
        self._shapes.clear()
        self._payload_channels.clear()

    def add(self, batch: Sequence[Shown], wall: int, monotonic: int) -> None:
        """`wall` and `monotonic` are what the two clocks said when the batch was seen (ns)."""
        latest = self._set_clocks(wall, monotonic)
        shift, steady, sequence = self._shift, self._steady, self._sequence
        head, opcode = HEAD.pack, Opcode.MESSAGE.value
        chunk, append, offset = self._chunk, self._chunk.pieces.append, self._chunk.offset
        for (at, listener, peer, data), shape in zip(batch, self._shapes_of(batch), strict=True):
            came = at + shift
            if came > steady:
                steady = came if came < latest else latest  # noqa: FURB136 - `min` takes three times as long
            sequence += 1
            if shape is not None:
                append(head(opcode, shape.length, shape.channel, sequence & _SEQUENCE, at, steady))
                append(data[shape.skip :])
                shape.note(at)
                shape.note(offset)
                offset += shape.size
            else:
                chunk.offset = offset
                self._add_unusual(listener, peer, data, (sequence & _SEQUENCE, at, steady))
                offset = chunk.offset
        chunk.offset = offset
        self._sequence, self._steady = sequence, steady
        self._datagrams += len(batch)
        self._bytes += sum([len(data) for _, _, _, data in batch])

    def take(self) -> Chunk | None:
        """What was added since the last time, None where that is nothing."""
        chunk = self._chunk.take(self._datagrams, self._bytes, self._steady)
        self._datagrams = self._bytes = 0
        return chunk

    def _set_clocks(self, wall: int, monotonic: int) -> int:
        """The latest time, by the clock that nobody sets, at which something in a batch can have come."""
        if self._first_ahead is None:
            self._first_ahead = wall - monotonic
        now = monotonic + self._first_ahead
        if abs(now - wall - self._shift) > _CLOCK_WAS_SET:
            self._shift = now - wall
        return now + _CLOCK_WAS_SET

    def _shapes_of(self, batch: Sequence[Shown]) -> list[_Shape | None]:
        """None for each that is to be recorded raw."""
        known, new = self._shapes.get, self._shape
        found = [
            known((listener, peer, len(data), data[:2])) or new(listener, peer, data)
            for _, listener, peer, data in batch
        ]
        fitting = [
            shape if shape is not None and data.startswith(shape.header) else None
            for shape, (_, _, _, data) in zip(found, batch, strict=True)
        ]
        usual = [data for shape, (_, _, _, data) in zip(fitting, batch, strict=True) if shape is not None]
        if _parses(self._known.envelope.message_class.FromString, b"".join(usual)):
            return fitting
        return [
            shape if shape is not None and _parses(shape.parse, data[shape.skip :]) else None
            for shape, (_, _, _, data) in zip(fitting, batch, strict=True)
        ]

    def _shape(self, listener: str, peer: Peer, data: bytes) -> _Shape | None:
        """None for a datagram that is not one field, encoded as protobuf encodes it, of a known case."""
        tag = next((data[:size] for size in (1, 2, 3) if data[:size] in self._known.tags), None)
        header = _header(tag, data) if tag is not None and len(data) <= MAX_DATAGRAM else None
        if tag is None or header is None:
            return None
        case = self._known.tags[tag]
        channel = self._payload_channel(case, listener, peer)
        if channel is None:
            return None
        size = len(data) - len(header)
        note, parse = self._chunk.index(channel).append, case.message_class.FromString
        shape = _Shape(header, len(header), BEHIND_LENGTH + size, channel, HEAD.size + size, note, parse)
        if len(self._shapes) >= _MOST_SHAPES:
            self._shapes.clear()
        self._shapes[listener, peer, len(data), data[:2]] = shape
        return shape

    def _payload_channel(self, case: PayloadCase, listener: str, peer: Peer) -> int | None:
        sender = (case.name, listener, peer)
        if sender not in self._payload_channels:
            if len(self._payload_channels) >= _MOST_SHAPES:
                self._payload_channels.clear()
            self._payload_channels[sender] = self._channels.payload(case, listener, peer, self._known.endpoint(peer))
        return self._payload_channels[sender]

    def _add_unusual(self, listener: str, peer: Peer, data: bytes, times: tuple[int, int, int]) -> None:
        """The datagram as it is, and its payload where there is one, so that people see that as well."""
        raw = Datagram(listener=listener, peer=f"{peer[0]}:{peer[1]}", data=data, endpoint=self._known.endpoint(peer))
        self._chunk.add(self._channels.datagrams(), raw.SerializeToString(), *times)
        if len(data) > MAX_DATAGRAM:
            return
        known = self._known.envelope
        try:
            envelope = known.message_class.FromString(restored(data, MAX_DATAGRAM))
        except ProtobufError:
            return
        if name := envelope.WhichOneof(known.oneof):
            view = self._channels.view(known.cases[name])
            self._chunk.add(view, getattr(envelope, name).SerializeToString(), *times)


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
