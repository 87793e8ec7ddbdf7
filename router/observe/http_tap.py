"""One tap on a running router: what somebody wants to see of what it receives, until he goes.

Knows the envelope's field numbers and the endpoints' addresses; its reader decodes. A reader who is too slow misses
datagrams and is told how many; the router never waits for him.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from router.compiler.program import Program
from router.errors import RouterError, did_you_mean
from router.observe.tap_stream import MAGIC, encode, encode_alive, encode_lost
from router.recording.mirror import Classifier, Mirror, Mirrored, first_field

MOST_WAITING = 4 << 20
"""Bytes that wait for a slow reader."""

ALIVE_SECONDS = 1.0

Wanted = Callable[[Mirrored], bool]


class TapRequestError(RouterError):
    """Somebody asked for a payload case or an endpoint that there is not."""


def wanted(program: Program, cases: Sequence[str], sources: Sequence[str]) -> Wanted | None:
    """What tells whether a datagram is of these payload cases and from these endpoints; None: all are wanted.

    What does not begin with the field of a payload case is wanted in any case: only a decoder can say what it is.
    A source may be an IPv4 address as well. Raises TapRequestError.
    """
    of_case = _of_case(program, cases) if cases else None
    from_source = _from_source(program, sources) if sources else None
    if of_case is None or from_source is None:
        return of_case or from_source
    return lambda shown: from_source(shown) and of_case(shown)


def _of_case(program: Program, cases: Sequence[str]) -> Wanted:
    known = program.envelope.cases
    if unknown := [name for name in cases if name not in known]:
        raise TapRequestError(f"the router has no payload case '{unknown[0]}'; {did_you_mean(unknown[0], known)}")
    unwanted = frozenset(case.number for name, case in known.items() if name not in cases)

    def is_wanted(shown: Mirrored) -> bool:
        _, _, _, data = shown
        return first_field(data) not in unwanted

    return is_wanted


def _from_source(program: Program, sources: Sequence[str]) -> Wanted:
    endpoints = program.table.endpoints
    if unknown := [name for name in sources if name not in endpoints and not name[:1].isdigit()]:
        raise TapRequestError(f"the router has no endpoint '{unknown[0]}'; {did_you_mean(unknown[0], endpoints)}")
    sender, names = Classifier(program.envelope, program.table).sender, frozenset(sources)

    def is_wanted(shown: Mirrored) -> bool:
        _, listener, peer, _ = shown
        return peer[0] in names or sender(listener, peer) in names

    return is_wanted


class Tap:
    """What is seen from now until `close`, as a stream of bytes."""

    def __init__(self, mirror: Mirror, wants: Wanted | None) -> None:
        self._mirror = mirror
        self._wants = wants
        self._pieces: deque[bytes] = deque()
        self._waiting = 0
        self._lost = 0
        self._lost_before = mirror.lost
        self._changed = threading.Condition()
        self._is_closed = False
        self._detach = mirror.attach(self._take)

    def stream(self) -> Iterator[bytes]:
        """Piece by piece, each as soon as there is one; at least one a second. Ends after `close`."""
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
        """Called by the mirror's thread."""
        shown = batch if self._wants is None else list(filter(self._wants, batch))
        piece = encode(shown)
        unseen, self._lost_before = self._mirror.lost - self._lost_before, self._mirror.lost
        with self._changed:
            if self._waiting + len(piece) > MOST_WAITING:
                self._lost += len(shown)
            elif piece:
                self._pieces.append(piece)
                self._waiting += len(piece)
            self._lost += unseen
            if piece or self._lost:
                self._changed.notify()
