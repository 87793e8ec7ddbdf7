"""Turns mirrored datagrams and actions into messages of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from google.protobuf.message import DecodeError as ProtobufError

from router.datagrams import Peer
from router.declared import MAX_DATAGRAM
from router.recording.channels import Channels, Datagram, Event
from router.recording.mirror import Acted, Action, Classifier, Mirrored
from router.types.wire import varint

_SEQUENCE = 0xFFFFFFFF
_MOST_SHAPES = 8192
_CLOCK_WAS_SET = 1_000_000
"""ns. If the wall clock steps more than this against the monotonic one, it was set; otherwise it is being slewed."""
_OVERHEAD = 256
"""Bytes that a datagram or an action takes in addition to its own, in memory; in a file it takes less."""


class Message(NamedTuple):
    """A message of a recording. `channel` is a number of `Channels`; times in ns."""

    channel: int
    log_time: int
    data: bytes
    publish_time: int
    sequence: int


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Datagrams in the order of arrival, or actions, with what is needed to encode them later.

    `sequence` is that of the first datagram, `shift` the sum of all steps of the wall clock until then (ns), `latest`
    the latest possible publish time, `monotonic` when the batch was received (ns). `received` are the datagrams' bytes.
    """

    classifier: Classifier
    monotonic: int
    shift: int
    latest: int
    datagrams: Sequence[Mirrored] = ()
    actions: Sequence[Acted] = ()
    sequence: int = 0
    received: int = 0
    size: int = 0
    """Maximum bytes in memory, and in a file."""


class Batches:
    """Makes batches, which share a sequence and a clock that is never set."""

    def __init__(self) -> None:
        self._sequence = 1
        self._first_ahead: int | None = None
        self._shift = 0

    def datagrams(self, datagrams: Sequence[Mirrored], classifier: Classifier, wall: int, monotonic: int) -> Batch:
        """Return a batch. `wall` and `monotonic` are the two clocks when it was received (ns)."""
        first, self._sequence = self._sequence, self._sequence + len(datagrams)
        received = sum(len(data) for *_, data in datagrams)
        size = received + _OVERHEAD * len(datagrams)
        times = self._times(wall, monotonic)
        return Batch(classifier, monotonic, *times, datagrams, sequence=first, received=received, size=size)

    def actions(self, actions: Sequence[Acted], classifier: Classifier, wall: int, monotonic: int) -> Batch:
        """Return a batch. The clocks are as in `datagrams`."""
        size = sum(len(data) for *_, data in actions) + _OVERHEAD * len(actions)
        return Batch(classifier, monotonic, *self._times(wall, monotonic), actions=actions, size=size)

    def _times(self, wall: int, monotonic: int) -> tuple[int, int]:
        """Return `shift` and `latest` of a batch."""
        if self._first_ahead is None:
            self._first_ahead = wall - monotonic
        now = monotonic + self._first_ahead
        if abs(now - wall - self._shift) > _CLOCK_WAS_SET:
            self._shift = now - wall
        return self._shift, now + _CLOCK_WAS_SET


class _Shape(NamedTuple):
    """Common values of datagrams with the same sender, decision, length and first bytes.

    The payload follows `header`, the tag and length of the envelope's field. Without a `channel` for it, the datagrams
    are recorded raw.
    """

    channel: int | None
    header: bytes
    parse: Callable[[bytes], object]


class Encoder:
    """Encodes batches, oldest first.

    A message's log time is the wall clock. Its publish time is the same until that clock is set; that of datagrams
    never goes back. The sequence counts datagrams; it is 0 for actions.
    """

    def __init__(self, channels: Channels) -> None:
        self._channels = channels
        self._steady = 0
        self._classifier: Classifier | None = None
        self._shapes: dict[tuple[str, Peer, str, str, int, bytes], _Shape] = {}

    def messages(self, batch: Batch) -> Iterator[Message]:
        """Yield the payload of a datagram if it is the whole datagram; else the datagram, and its payload if there is
        one. Yield the payload of an action if there is one, else an Event.
        """
        if batch.classifier is not self._classifier:
            self._classifier = batch.classifier
            self._shapes.clear()
        for number, (at, listener, peer, endpoint, reason, data) in enumerate(batch.datagrams, batch.sequence):
            sequence = number & _SEQUENCE
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
            channel, message = self._action(batch.classifier, action)
            yield Message(channel, action.at, message, max(0, action.at + batch.shift), 0)

    def _shape(self, classifier: Classifier, key: tuple[str, Peer, str, str, int, bytes], data: bytes) -> _Shape:
        if len(self._shapes) >= _MOST_SHAPES:
            self._shapes.clear()
        listener, peer, endpoint, reason, length, _ = key
        tag = data[: 1 if data[:1] < b"\x80" else 2 if data[1:2] < b"\x80" else 3]
        case = classifier.cases_by_tag.get(tag)
        shape = _Shape(None, b"", bytes)
        if case is not None and length <= MAX_DATAGRAM and (header := _header(tag, length)) is not None:
            channel = self._channels.payload(case, listener, peer, endpoint, reason)
            shape = _Shape(channel, header, case.message_class.FromString)
        self._shapes[key] = shape
        return shape

    def _raw(
        self, classifier: Classifier, listener: str, peer: Peer, endpoint: str, reason: str, data: bytes
    ) -> Iterator[tuple[int, bytes]]:
        """Yield channel and message of a datagram, and of its payload if there is one."""
        datagram = Datagram(listener=listener, peer=f"{peer[0]}:{peer[1]}", data=data, endpoint=endpoint)
        yield self._channels.datagrams(reason), datagram.SerializeToString()
        if (found := classifier.encoded_payload(listener, data)) is not None:
            case, payload = found
            yield self._channels.view(case, reason), payload

    def _action(self, classifier: Classifier, action: Action) -> tuple[int, bytes]:
        """Return channel and message: the payload that was sent, or else an Event."""
        _, what, route, target, topic, reason, detail, data = action
        if data and not reason and (found := classifier.sent_payload(data)) is not None:
            case, payload = found
            return self._channels.sent(case, what, route, target, topic), payload
        event = Event(what=what, route=route, endpoint=target, ros=topic, reason=reason, detail=detail, data=data)
        return self._channels.events(), event.SerializeToString()


def _header(tag: bytes, length: int) -> bytes | None:
    """Return tag and length of a field that takes `length` bytes; None if no field takes that many."""
    behind = length - len(tag)
    size = 1 if behind <= 0x80 else 2 if behind <= 0x4001 else 3
    header = tag + varint(max(0, behind - size))
    return header if len(header) == len(tag) + size else None
