"""Turns mirrored datagrams and actions into messages of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import zstandard
from google.protobuf.message import DecodeError as ProtobufError

from router.datagrams import Peer
from router.declared import MAX_DATAGRAM
from router.recording.beside import Whole
from router.recording.channels import Channels, Event, Holds
from router.recording.mirror import BRAKED, SENT, Acted, Action, Classifier, Format, Mirrored, Taken
from router.table.addresses import Address
from router.types.protobuf import Envelope, PayloadCase
from router.types.wire import varint

T = TypeVar("T")

_SEQUENCE = 0xFFFFFFFF
_MOST_SHAPES = 8192
_LEVEL = 1
"""Of zstd: 128 bytes of a record become 20, for 0.3 us."""
_CLOCK_WAS_SET = 1_000_000
"""ns. If the wall clock steps more than this against the monotonic one, it was set; otherwise it is being slewed."""


class Message(NamedTuple):
    """A message of a recording. `channel` is a number of `Channels`; times in ns."""

    channel: int
    log_time: int
    data: bytes
    publish_time: int
    sequence: int


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Datagrams in the order of arrival, and actions, with what is needed to encode them later.

    `shift` is the sum of all steps of the wall clock until then (ns), `latest` the latest possible publish time,
    `monotonic` when the batch was received (ns).
    """

    datagrams: Iterable[Mirrored]
    actions: Iterable[Acted]
    classifier: Classifier
    monotonic: int
    shift: int
    latest: int
    size: int = 0
    """Bytes of a packed batch in memory; it has about as many in a file."""

    def count(self) -> int:
        """Return the number of datagrams."""
        return sum(1 for _ in self.datagrams)


class Clock:
    """The publish times of batches: those of a clock that is never set."""

    def __init__(self) -> None:
        self._first_ahead: int | None = None
        self._shift = 0

    def times(self, wall: int, monotonic: int) -> tuple[int, int]:
        """Return `shift` and `latest` of a batch; `wall` and `monotonic`: the clocks when it was received (ns)."""
        if self._first_ahead is None:
            self._first_ahead = wall - monotonic
        now = monotonic + self._first_ahead
        if abs(now - wall - self._shift) > _CLOCK_WAS_SET:
            self._shift = now - wall
        return self._shift, now + _CLOCK_WAS_SET


@dataclass(frozen=True, slots=True)
class _Packed(Generic[T]):
    """Compressed records, which are decoded when they are read."""

    data: bytes
    decode: Callable[[bytes], Iterator[T]]

    def __iter__(self) -> Iterator[T]:
        return self.decode(zstandard.decompress(self.data))


class Packer:
    """Makes batches that take a sixth of the memory. For one thread at a time."""

    def __init__(self) -> None:
        self._clock = Clock()
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)

    def pack(
        self, datagrams: Taken[Mirrored], actions: Taken[Acted], classifier: Classifier, wall: int, monotonic: int
    ) -> Batch:
        """Return a batch; the clocks are as in `Clock.times`."""
        both = self._packed(datagrams), self._packed(actions)
        times = self._clock.times(wall, monotonic)
        return Batch(*both, classifier, monotonic, *times, sum(len(packed.data) for packed in both))

    def _packed(self, taken: Taken[T]) -> _Packed[T]:
        return _Packed(self._compressor.compress(taken.records), taken.decode)


class _Shape(NamedTuple):
    """Common values of datagrams with the same sender, decision, length and first bytes.

    The payload follows `header`, the tag and length of the envelope's field. Without a `channel` for it, the datagrams
    are recorded raw.
    """

    channel: int | None
    header: bytes
    parse: Callable[[bytes], object]


class Encoder:
    """Encodes batches, oldest first. `datagrams` and `bytes` count what was received.

    A message's log time is the wall clock. Its publish time is the same until that clock is set; that of datagrams
    never goes back. The sequence counts datagrams; it is 0 for actions.
    """

    def __init__(self, channels: Channels) -> None:
        self.datagrams = self.bytes = 0
        self._channels = channels
        self._steady = 0
        self._classifier: Classifier | None = None
        self._shapes: dict[tuple[str, Peer, str, str, int, bytes], _Shape] = {}
        self._wholes: dict[Envelope, Whole] = {}

    def messages(self, batch: Batch) -> Iterator[Message]:
        """Yield the payload of a datagram if it is the whole datagram; else the datagram, and its payload if there is
        one. Likewise, yield the payload of an action, or else an Event.
        """
        if batch.classifier is not self._classifier:
            self._classifier = batch.classifier
            self._shapes.clear()
            self._wholes.clear()
        for at, listener, peer, endpoint, reason, data in batch.datagrams:
            self.datagrams += 1
            self.bytes += len(data)
            sequence = self.datagrams & _SEQUENCE
            steady = self._steady = max(self._steady, min(at + batch.shift, batch.latest))
            key = listener, peer, endpoint, reason, len(data), data[:2]
            shape = self._shapes.get(key) or self._shape(batch.classifier, key, data)
            if shape.channel and data.startswith(shape.header):
                payload = data[len(shape.header) :]
                try:
                    shape.parse(payload)
                except ProtobufError:
                    pass
                else:
                    yield Message(shape.channel, at, payload, steady, sequence)
                    continue
            for channel, message in self._raw(batch.classifier, listener, peer, endpoint, reason, data):
                yield Message(channel, at, message, steady, sequence)
        for action in map(Action._make, batch.actions):
            for channel, message in self._action(batch.classifier, action):
                yield Message(channel, action.at, message, max(0, action.at + batch.shift), 0)

    def _shape(self, classifier: Classifier, key: tuple[str, Peer, str, str, int, bytes], data: bytes) -> _Shape:
        if len(self._shapes) >= _MOST_SHAPES:
            self._shapes.clear()
        listener, peer, endpoint, reason, length, _ = key
        shape = _Shape(None, b"", bytes)
        if length <= MAX_DATAGRAM and (found := _only_payload(classifier.at(listener), data, length)) is not None:
            case, header = found
            channel = self._channels.payload(case, listener, peer, endpoint, reason)
            shape = _Shape(channel, header, case.message_class.FromString)
        self._shapes[key] = shape
        return shape

    def _raw(
        self, classifier: Classifier, listener: str, peer: Peer, endpoint: str, reason: str, data: bytes
    ) -> Iterator[tuple[int, bytes]]:
        """Yield channel and message of a datagram, and of its payloads."""
        payloads = classifier.encoded_payloads(listener, data)
        whole = self._whole(classifier.at(listener).envelope)
        texts = {"listener": listener, "peer": str(Address(*peer)), "endpoint": endpoint}
        datagram = whole.datagram(data if payloads else b"", data=data, **texts)
        yield self._channels.datagrams(whole.datagram_type, whole.label, reason), datagram
        for case, payload in payloads:
            yield self._channels.view(case, reason), payload

    def _whole(self, envelope: Envelope) -> Whole:
        if envelope not in self._wholes:
            self._wholes[envelope] = Whole(envelope)
        return self._wholes[envelope]

    def _action(self, classifier: Classifier, action: Action) -> Iterator[tuple[int, bytes]]:
        """Yield channel and message: the payload that was sent, an Event, or both if other fields are beside it."""
        _, what, route, target, topic, reason, detail, data = action
        is_sent = what in (SENT, BRAKED) and not reason
        texts = {"what": what, "route": route, "endpoint": target, "ros": topic, "reason": reason, "detail": detail}
        if not is_sent or (sent := classifier.sent_payload(target, data)) is None:
            yield self._channels.events(), Event(data=data, **texts).SerializeToString()
            return
        case, payload = sent
        whole = self._whole(classifier.to(target).envelope)
        if whole.has_beside:
            yield self._channels.sent_datagrams(whole.event_type, whole.label), whole.event(data, data=data, **texts)
        holds = Holds.VIEW if whole.has_beside else Holds.SENT
        yield self._channels.sent(case, what, route, target, topic, holds), payload


def _only_payload(of: Format, data: bytes, length: int) -> tuple[PayloadCase, bytes] | None:
    """Return the payload case of a datagram that can have only a payload, and what precedes it; else None."""
    if of.frame_case is not None:
        return of.frame_case, b""
    if of.envelope.beside.fields:
        return None
    tag = data[: 1 if data[:1] < b"\x80" else 2 if data[1:2] < b"\x80" else 3]
    case, header = of.cases_by_tag.get(tag), _header(tag, length)
    return (case, header) if case is not None and header is not None else None


def _header(tag: bytes, length: int) -> bytes | None:
    """Return tag and length of a field that takes `length` bytes; None if no field takes that many."""
    behind = length - len(tag)
    size = 1 if behind <= 0x80 else 2 if behind <= 0x4001 else 3
    header = tag + varint(max(0, behind - size))
    return header if len(header) == len(tag) + size else None
