"""A tap on a running router: a stream of received datagrams, the decisions about them, and actions, over HTTP.

The stream is MAGIC, then records, each preceded by its length: `<uint32 length> <uint8 kind> ...`, little-endian.

    SEEN   <uint64 wall clock, ns> <uint16 port> <IP address> <listener> <endpoint> <reason> <datagram>
    LOST   <uint64 count>    the number of datagrams not sent, because the reader of the stream is too slow
    ALIVE                    once a second if there is nothing else to send
    ACTED  <uint64 wall clock, ns> <what> <route> <target> <topic> <reason> <detail> <datagram>

IP address, listener, endpoint and reason, as in MirroredDatagram, are texts preceded by their lengths (uint16), as are
those of ACTED, which are the fields of an Action. A datagram longer than the router accepts is cut to one byte more
than that. A tap that is limited to senders or decisions has no actions; any other has all of them.
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

from router.compiler.compiled_table import CompiledTable
from router.errors import RouterError, TransportError, did_you_mean
from router.hosts import is_address, is_ipv6
from router.recording.mirror import Acted, Action, Mirror, Mirrored, MirroredDatagram
from router.table.addresses import BadAddressError, parse_ipv6

MAGIC = b"router tap 3\n"
CONTENT_TYPE = "application/x-router-tap"

SEEN, LOST, ALIVE, ACTED = 1, 2, 3, 4

MAX_WAITING = 4 << 20
"""Maximum bytes in the queue of a slow reader."""

ALIVE_SECONDS = 1.0

_LENGTH = struct.Struct("<I")
_SEEN = struct.Struct("<IBQ")
_LOST = struct.Struct("<IBQ")
_PORT = struct.Struct("<H")
_TEXT = struct.Struct("<H")
_LONGEST = 1 << 20

Wanted = Callable[[Mirrored], bool]


ACCEPTED, REJECTED = "accepted", "rejected"
DECISIONS = (ACCEPTED, REJECTED)
"""The decisions that a tap can be limited to."""


class TapRequestError(RouterError):
    """A request names a payload case, endpoint or decision that does not exist."""


def wanted(
    program: CompiledTable, cases: Sequence[str], sources: Sequence[str], decisions: Sequence[str] = ()
) -> Wanted | None:
    """Return a filter for datagrams of these payload cases, sources and decisions; None if all are wanted.

    A datagram that does not begin with the field of a payload case always passes: only a decoder can classify it. A
    source is an endpoint or an IP address, in any form. Raises TapRequestError.
    """
    conditions = [
        *([_of_decision(decisions)] if decisions else []),
        *([_from_source(program, sources)] if sources else []),
        *([_of_case(program, cases)] if cases else []),
    ]
    return (lambda datagram: all(is_wanted(datagram) for is_wanted in conditions)) if conditions else None


def _of_decision(decisions: Sequence[str]) -> Wanted:
    if unknown := [name for name in decisions if name not in DECISIONS]:
        raise TapRequestError(f"'only' must be {' or '.join(DECISIONS)}, not '{unknown[0]}'")

    def is_wanted(datagram: Mirrored) -> bool:
        *_, reason, _ = datagram
        return (REJECTED if reason else ACCEPTED) in decisions

    return is_wanted


def _of_case(program: CompiledTable, cases: Sequence[str]) -> Wanted:
    known = program.envelopes.cases
    if unknown := [name for name in cases if name not in known]:
        raise TapRequestError(f"the router has no payload case '{unknown[0]}'; {did_you_mean(unknown[0], known)}")
    envelopes = program.envelopes
    unwanted = envelopes.numbers.keys() - cases

    def is_wanted(datagram: Mirrored) -> bool:
        _, listener, *_, data = datagram
        found = envelopes.at(listener).cases_in(data)
        return not found or not unwanted.issuperset(found)

    return is_wanted


def _from_source(program: CompiledTable, sources: Sequence[str]) -> Wanted:
    endpoints = program.table.endpoints
    if unknown := [name for name in sources if name not in endpoints and not is_address(name)]:
        raise TapRequestError(f"the router has no endpoint '{unknown[0]}'; {did_you_mean(unknown[0], endpoints)}")
    try:
        names = frozenset(parse_ipv6(source) if is_ipv6(source) else source for source in sources)
    except BadAddressError as error:
        raise TapRequestError(f"{error.what}; {error.hint}") from error

    def is_wanted(datagram: Mirrored) -> bool:
        _, _, peer, endpoint, *_ = datagram
        return peer[0] in names or endpoint in names

    return is_wanted


class Tap:
    """A stream of the wanted datagrams, and the actions, until `close`. A slow reader misses some."""

    def __init__(self, mirror: Mirror, is_wanted: Wanted | None, *, with_actions: bool = True) -> None:
        self._mirror = mirror
        self._is_wanted = is_wanted
        self._pieces: deque[bytes] = deque()
        self._waiting = 0
        self._lost = 0
        self._lost_before = mirror.lost
        self._changed = threading.Condition()
        self._is_closed = False
        self._detach = mirror.attach(self._take, self._take_actions if with_actions else None)

    def stream(self) -> Iterator[bytes]:
        """Yield pieces as soon as there are any, at least one per second. Ends after `close`."""
        yield MAGIC
        while not self._is_closed:
            with self._changed:
                self._changed.wait_for(lambda: self._pieces or self._lost or self._is_closed, ALIVE_SECONDS)
                piece, lost = b"".join(self._pieces), self._lost
                self._pieces.clear()
                self._waiting = self._lost = 0
            yield piece + (encode_lost(lost) if lost else b"") or encode_alive()

    def close(self) -> None:
        self._detach()
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def _take(self, batch: Sequence[Mirrored]) -> None:
        """Queue the wanted datagrams. Called by the mirror."""
        chosen = batch if self._is_wanted is None else list(filter(self._is_wanted, batch))
        self._queue(encode(chosen), len(chosen))

    def _take_actions(self, actions: Sequence[Acted]) -> None:
        """Queue the actions. Called by the mirror."""
        self._queue(encode_actions(actions), len(actions))

    def _queue(self, piece: bytes, count: int) -> None:
        unseen, self._lost_before = self._mirror.lost - self._lost_before, self._mirror.lost
        with self._changed:
            if self._waiting + len(piece) > MAX_WAITING:
                self._lost += count
            elif piece:
                self._pieces.append(piece)
                self._waiting += len(piece)
            self._lost += unseen
            if piece or self._lost:
                self._changed.notify()


def encode(batch: Iterable[Mirrored]) -> bytes:
    """Return a SEEN record for each datagram."""
    pieces: list[bytes] = []
    for at, listener, peer, endpoint, reason, data in batch:
        head = _head(listener, peer, endpoint, reason)
        pieces += (_SEEN.pack(9 + len(head) + len(data), SEEN, at), head, data)
    return b"".join(pieces)


def encode_actions(actions: Iterable[Acted]) -> bytes:
    """Return an ACTED record for each action."""
    pieces: list[bytes] = []
    for at, *texts, data in actions:
        head = _texts(*texts)
        pieces += (_SEEN.pack(9 + len(head) + len(data), ACTED, at), head, data)
    return b"".join(pieces)


def encode_lost(count: int) -> bytes:
    return _LOST.pack(9, LOST, count)


def encode_alive() -> bytes:
    return _LENGTH.pack(1) + bytes([ALIVE])


@lru_cache(1024)
def _head(listener: str, peer: tuple[str, int], *texts: str) -> bytes:
    return _PORT.pack(peer[1]) + _texts(peer[0], listener, *texts)


def _texts(*texts: str) -> bytes:
    return b"".join(_TEXT.pack(len(text)) + text for text in map(str.encode, texts))


class Lost(NamedTuple):
    """A number of datagrams that are missing from the stream."""

    number: int


class StreamReader:
    """Reads the stream, in pieces of any size."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._has_begun = False

    def take(self, piece: bytes) -> Iterator[MirroredDatagram | Action | Lost]:
        """Yield the records that this piece completes. Raises TransportError if this is not a tap stream."""
        waiting = self._waiting
        waiting += piece
        if not self._has_begun:
            if len(waiting) < len(MAGIC):
                return
            if not waiting.startswith(MAGIC):
                raise TransportError(f"this is not a tap stream, or one of another version: {bytes(waiting[:20])!r}")
            self._has_begun = True
            del waiting[: len(MAGIC)]
        start = 0
        while len(waiting) - start >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(waiting, start)
            end = start + _LENGTH.size + length
            if not 0 < length <= _LONGEST:
                raise TransportError(f"the tap stream is corrupt: a record of {length} bytes")
            if len(waiting) < end:
                break
            yield from _record(bytes(waiting[start + _LENGTH.size : end]))
            start = end
        del waiting[:start]


def _record(record: bytes) -> Iterator[MirroredDatagram | Action | Lost]:
    """Yield the content of a record. Unknown kinds are skipped: a newer router may have more."""
    if record[0] == LOST:
        yield Lost(int.from_bytes(record[1:9], "little"))
    elif record[0] == SEEN:
        at = int.from_bytes(record[1:9], "little")
        (port,) = _PORT.unpack_from(record, 9)
        (host, listener, endpoint, reason), data = _read_texts(record, 9 + _PORT.size, 4)
        yield MirroredDatagram(at, listener, (host, port), endpoint, reason, data)
    elif record[0] == ACTED:
        (what, route, target, topic, reason, detail), data = _read_texts(record, 9, 6)
        yield Action(int.from_bytes(record[1:9], "little"), what, route, target, topic, reason, detail, data)


def _read_texts(record: bytes, start: int, count: int) -> tuple[list[str], bytes]:
    """Return texts preceded by their lengths, and what follows them."""
    texts: list[str] = []
    for _ in range(count):
        (length,) = _TEXT.unpack_from(record, start)
        start += _TEXT.size + length
        texts.append(record[start - length : start].decode())
    return texts, record[start:]
