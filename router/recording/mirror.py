"""The mirror: received datagrams, what routing decided about them, and actions, for recordings, taps and pages.

While no consumer is attached, the native threads do nothing for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message

from router.compiler.network import recognisers
from router.datagrams import Peer
from router.declared import MAX_DATAGRAM
from router.table.model import RouteTable
from router.table.model.endpoints import Framing
from router.threads import Thread, WakeEvent, join_or_abandon
from router.types.framing import restored
from router.types.protobuf import Envelope, PayloadCase
from router.types.table_envelopes import Envelopes
from router.types.wire import varint

PERIOD = 50_000_000
"""ns between two batches: waking consumers for each datagram would cost more than routing it."""

KEEPING_PERIOD = 250_000_000
"""Likewise, while there are only keepers."""


class MirroredDatagram(NamedTuple):
    """A datagram. `at`: when the router received it (wall clock, ns). `data`: the bytes as received.

    `endpoint` is the sender's name in the table, "" for a stranger. `reason` says why no route accepted the datagram
    (one of REJECT_REASONS), "" for an accepted one. A datagram longer than MAX_DATAGRAM is cut to one byte more than
    that.
    """

    at: int
    listener: str
    peer: Peer
    endpoint: str
    reason: str
    data: bytes


Mirrored = tuple[int, str, Peer, str, str, bytes]
"""The fields of a MirroredDatagram as a plain tuple, which takes a third of the time to build."""


class Action(NamedTuple):
    """What the router did by itself. `at`: when it did that (wall clock, ns).

    `what` is one of ACTIONS: a command was `sent`; a deadman has `braked`, `tripped`, or was `released` or `fed` by a
    message of a gateway's client; a message for an endpoint was `lost`; an endpoint that was silent has `returned`.
    `target` is the endpoint, `topic` the ROS topic of the message or "". `reason` and `detail` say why something was
    not sent, or how long the silence was. `data` is the datagram, if there is one.
    """

    at: int
    what: str
    route: str
    target: str = ""
    topic: str = ""
    reason: str = ""
    detail: str = ""
    data: bytes = b""


ACTIONS = SENT, BRAKED, LOST, TRIPPED, RELEASED, FED, RETURNED = (
    "sent",
    "braked",
    "lost",
    "tripped",
    "released",
    "fed",
    "returned",
)

Acted = tuple[int, str, str, str, str, str, str, bytes]
"""The fields of an Action as a plain tuple."""

Consumer = Callable[[Sequence[Mirrored]], None]
ActionConsumer = Callable[[Sequence[Acted]], None]


T_co = TypeVar("T_co", covariant=True)


class Taken(Protocol[T_co]):
    """Datagrams or actions as `records`, which `decode` decodes whenever they are read."""

    @property
    def records(self) -> bytes: ...

    @property
    def decode(self) -> Callable[[bytes], Iterator[T_co]]: ...

    def __len__(self) -> int:
        """Return their number, which takes time."""

    def __iter__(self) -> Iterator[T_co]: ...


Keeper = Callable[[Taken[Mirrored], Taken[Acted]], None]


class Source(Protocol):
    """A source of mirrored datagrams."""

    def observe(self, *, is_observed: bool) -> None:
        """Called when the first consumer has attached, and when the last one has detached."""

    def take(self) -> Taken[Mirrored]:
        """Return the datagrams since the last call."""

    def take_actions(self) -> Taken[Acted]:
        """Return the actions since the last call."""

    @property
    def lost(self) -> int:
        """Datagrams and actions that were not mirrored."""


@dataclass(frozen=True, eq=False)
class _Observer:
    """Has a consumer, and perhaps one of actions, or a keeper."""

    consumer: Consumer | None = None
    acted: ActionConsumer | None = None
    keeper: Keeper | None = None


class Mirror:
    """Calls the observers, one call at a time, soon after a datagram or an action; they must return quickly.

    Exceptions of observers go to `failed`.
    """

    def __init__(self, source: Source, failed: Callable[[Exception], None]) -> None:
        self._source = source
        self._failed = failed
        self._observers: tuple[_Observer, ...] = ()
        self._attaching = threading.Lock()
        self._delivering = threading.Lock()
        self._thread: _Delivery | None = None

    @property
    def lost(self) -> int:
        """Datagrams and actions that were not mirrored."""
        return self._source.lost

    @property
    def is_observed(self) -> bool:
        """Whether an observer is attached."""
        return bool(self._observers)

    def attach(self, consumer: Consumer, acted: ActionConsumer | None = None) -> Callable[[], None]:
        """Call `consumer` with all datagrams from now on, and `acted` with all actions. Returns a function to detach.

        A consumer must not detach itself. A call in progress when it is detached still finishes.
        """
        return self._attach(_Observer(consumer, acted))

    def keep(self, keeper: Keeper) -> Callable[[], None]:
        """Like `attach`, but call `keeper` with datagrams and actions that are not decoded, at a lower cost."""
        return self._attach(_Observer(keeper=keeper))

    def _attach(self, attached: _Observer) -> Callable[[], None]:
        with self._attaching:
            if not self._observers:
                self._thread = _Delivery(self)
            self._observers = (*self._observers, attached)
            if len(self._observers) == 1:
                self._source.observe(is_observed=True)

        def detach() -> None:
            with self._attaching:
                if not any(observer is attached for observer in self._observers):
                    return
                if len(self._observers) == 1:
                    self._end()
                self._observers = tuple(observer for observer in self._observers if observer is not attached)
                if not self._observers:
                    self._source.observe(is_observed=False)
                    self._source.take()
                    self._source.take_actions()

        return detach

    def close(self) -> None:
        """Deliver waiting datagrams, and end the thread. Call this when nothing is received any more."""
        with self._attaching:
            if self._observers:
                self._end()

    def _end(self) -> None:
        assert self._thread is not None  # noqa: S101 - there is one while there are observers
        if self._thread.end():
            self.deliver()

    @property
    def period(self) -> int:
        """Time between two batches, ns."""
        return PERIOD if self._has_consumers() else KEEPING_PERIOD

    def _has_consumers(self) -> bool:
        return any(observer.consumer is not None for observer in self._observers)

    def deliver(self, patience: float = -1) -> bool:
        """Call the observers with what was mirrored until now. Thread-safe.

        Return False if another delivery takes longer than `patience` (s, or -1 for any time).
        """
        if not self._delivering.acquire(timeout=patience):
            return False
        try:
            actions, datagrams = self._source.take_actions(), self._source.take()
            is_read = self._has_consumers()
            acted, batch = ([*actions], [*datagrams]) if is_read else ([], [])
            for observer in self._observers:
                try:
                    if observer.keeper is not None:
                        observer.keeper(datagrams, actions)
                    if batch and observer.consumer is not None:
                        observer.consumer(batch)
                    if acted and observer.acted is not None:
                        observer.acted(acted)
                except Exception as error:  # noqa: BLE001 a fault of the router, reported; other observers continue
                    self._failed(error)
        finally:
            self._delivering.release()
        return True


class _Delivery:
    """The thread of a mirror, which runs until `end`."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._is_ending = False
        self._wake_up = WakeEvent()
        self._thread = Thread(self._run, "mirror")
        self._thread.start()

    def end(self) -> bool:
        """Return whether the thread has ended; else an observer hangs. Idempotent."""
        self._is_ending = True
        with suppress(ValueError):  # it has ended
            self._wake_up.set()
        return join_or_abandon(self._thread)

    def _run(self) -> None:
        while True:
            self._wake_up.wait(self._mirror.period)
            if self._is_ending:
                self._wake_up.close()
                return
            self._mirror.deliver()


class Format:
    """An envelope, and its payload cases by the bytes before the payload."""

    def __init__(self, envelope: Envelope) -> None:
        self.envelope = envelope
        alone = [case for case in envelope.cases.values() if case.wrapping.is_alone]
        self.cases_by_tag = {varint(case.wrapping.tag): case for case in alone}
        self.frame_case = next((case for case in envelope.cases.values() if not case.wrapping.tag), None)
        """The case of an envelope that is itself the payload."""

    def single_field(self, data: bytes) -> tuple[PayloadCase, bytes] | None:
        """Return payload case and payload; None if more than zeros follow the first field, or its length takes over two
        bytes.
        """
        try:
            tag_size = 1 if data[0] < 0x80 else 2
            case, size, start = self.cases_by_tag[data[:tag_size]], data[tag_size], tag_size + 1
            if size >= 0x80:
                high = data[start]
                size, start = size & 0x7F | high << 7, start + 1
                if high >= 0x80:
                    return None
        except LookupError:
            return None
        end = start + size
        if end > MAX_DATAGRAM or len(data) > MAX_DATAGRAM or data.count(0, end) < len(data) - end:
            return None
        payload = data[start:end].ljust(size, b"\0")
        try:
            case.message_class.FromString(payload)
        except ProtobufError:
            return None
        return case, payload


class Classifier:
    """Finds payload and sender of a datagram as routing does. Any thread may use it."""

    def __init__(self, envelopes: Envelopes, table: RouteTable) -> None:
        self._envelopes = envelopes
        self._formats = {envelope: Format(envelope) for envelope in envelopes.by_name.values()}
        self._trimming = frozenset(
            listener.name for listener in table.listeners.values() if listener.framing is Framing.ZERO_TRIMMED
        )
        self._recognisers = {name: recognisers(table, name) for name in table.listeners}

    def at(self, listener: str) -> Format:
        """Return the format of what a listener receives."""
        return self._formats[self._envelopes.at(listener)]

    def to(self, endpoint: str) -> Format:
        """Return the format of what an endpoint gets."""
        return self._formats[self._envelopes.to(endpoint)]

    def payloads(self, listener: str, data: bytes) -> list[tuple[PayloadCase, Message]]:
        """Return the payloads with their cases; none for a datagram that the listener rejects."""
        envelope = self._envelopes.at(listener)
        if len(data) > MAX_DATAGRAM or not envelope.cases:
            return []
        if listener in self._trimming:
            data = restored(data)
        try:
            return envelope.payloads_of(envelope.message_class.FromString(data))
        except ProtobufError:
            return []

    def encoded_payloads(self, listener: str, data: bytes) -> list[tuple[PayloadCase, bytes]]:
        """Like `payloads`, but return their bytes; much faster for a frame with zeros removed or added."""
        if listener in self._trimming and (field := self.at(listener).single_field(data)) is not None:
            return [field]
        return [(case, payload.SerializePartialToString()) for case, payload in self.payloads(listener, data)]

    def sent_payload(self, endpoint: str, data: bytes) -> tuple[PayloadCase, bytes] | None:
        """Return case and payload of a datagram that the router has sent there, perhaps without trailing zeros."""
        of = self.to(endpoint)
        if (field := of.single_field(data)) is not None:
            return field
        envelope = of.envelope
        try:
            payloads = envelope.payloads_of(envelope.message_class.FromString(restored(data)))
        except ProtobufError:
            return None
        return next(((case, payload.SerializePartialToString()) for case, payload in payloads), None)

    def sender(self, listener: str, peer: Peer) -> str:
        """Return the sender's name in the table; "" for a stranger."""
        by_host, by_address = self._recognisers.get(listener, _NOBODY)
        return by_address.get(peer) or by_host.get(peer[0]) or ""


_NOBODY: tuple[dict[str, str], dict[Peer, str]] = {}, {}
