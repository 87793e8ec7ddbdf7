"""Handing messages over to a target: counting and reporting what becomes of each."""

from __future__ import annotations

import errno
from collections.abc import Callable

from router.compiler.metrics import DROP_REASONS, Counters, Report
from router.compiler.namespace import MAPPING_FAILURES
from router.compiler.program import TargetPlan
from router.errors import NonFiniteError
from router.types.board_limits import BoardLimits, Refusal
from router.types.framing import restored

_BUFFER_FULL = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})

Place = tuple[str, str]
"""A route and the name of one of its targets."""

Deliver = Callable[[int, bytes, int | None], None]
"""Called with the time, the datagram or CDR bytes, and the time after which they are stale (None: never).

Times of the boot clock in ns. The message is counted before or after the return; losses raise nothing.
"""

Feed = Callable[[int], None]
"""Called when a command was sent, with the time of that (boot clock, ns): restarts the timeouts of its deadmen."""

Command = Callable[[bytes, int | None], int]
"""Sends a datagram and returns its size; called with the datagram and the time (boot clock, ns) after which it
is stale (None: never).

Checks that, sends the command and, if that succeeded, feeds or disarms its deadmen, all under their lock: so no command
leaves behind the datagram of a deadman that replaces it. Raises Stale or OSError; with EarlierRefused the deadman of
the route is armed.
"""


class Stale(Exception):
    """A message is older than `ttl`, and was not sent."""


class EarlierRefused(ConnectionRefusedError):
    """A datagram was sent, and its receiver is said to have refused an earlier one, which was counted as sent."""


class BoardRefuses(OSError):
    """A board cannot take a datagram, which was not sent."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.text)
        self.reason = refusal.reason


class Outcome:
    """The counters of one target of one route, in `counts`.

    Every loss is reported except `rate_limited`, which the table asks for.
    """

    def __init__(
        self, counters: Counters, counts: list[int], route: str, target: TargetPlan, report: Callable[[Report], None]
    ) -> None:
        self.place: Place = route, target.label
        self._counts = counts
        self._is_topic = target.is_topic
        self._report = report
        self._dropped = {
            reason: counters.index("messages_dropped", route, target.label, reason) for reason in DROP_REASONS
        }
        self._filtered = counters.index("messages_filtered", route, target.label)
        self._delivered = counters.index(
            "messages_published" if target.is_topic else "datagrams_sent", route, target.label
        )
        self._sent_bytes = None if target.is_topic else counters.index("sent_bytes", route, target.label)

    def delivered(self, size: int) -> None:
        """Count a message as published, or as sent with `size` bytes."""
        self._counts[self._delivered] += 1
        if self._sent_bytes is not None:
            self._counts[self._sent_bytes] += size

    def dropped(self, reason: str, error: Exception | None = None, detail: str = "") -> None:
        """Count a message as lost for one of DROP_REASONS."""
        self._counts[self._dropped[reason]] += 1
        if reason != "rate_limited":
            self._report(Report("drop", *self.place, reason, error, detail))

    def failed(self, error: Exception) -> None:
        """Count a message as lost because mapping it or handing it over raised `error`."""
        if isinstance(error, Stale):
            self.dropped("stale")
        elif isinstance(error, BoardRefuses):
            self.dropped(error.reason, detail=str(error))
        else:
            self.dropped(_reason(error, self._is_topic), error)

    def filtered(self) -> None:
        self._counts[self._filtered] += 1


class FrameOutcome(Outcome):
    """The counters of a target that gets frames; only those have a series for collected parts."""

    def __init__(
        self, counters: Counters, counts: list[int], route: str, target: TargetPlan, report: Callable[[Report], None]
    ) -> None:
        super().__init__(counters, counts, route, target, report)
        self._collected = counters.index("messages_collected", route, target.label)

    def collected(self) -> None:
        """Count a message as part of a frame."""
        self._counts[self._collected] += 1


def _reason(error: Exception, is_topic: bool) -> str:
    if isinstance(error, NonFiniteError):
        return "non_finite"
    if isinstance(error, MAPPING_FAILURES):
        return "mapping_error"
    if is_topic:
        return "publish_error"
    return "send_buffer_full" if isinstance(error, OSError) and error.errno in _BUFFER_FULL else "send_error"


def immediately(
    hand_over: Callable[[bytes, int | None], object],
    outcome: Outcome,
    failures: tuple[type[Exception], ...] = (Stale, OSError),
) -> Deliver:
    """Return a Deliver that calls `hand_over`, a Command or a function like it that may raise `failures`."""

    def deliver(now: int, data: bytes, expires: int | None) -> None:
        try:
            hand_over(data, expires)
        except failures as error:
            outcome.failed(error)
        else:
            outcome.delivered(len(data))

    return deliver


def checked(send: Callable[..., int], board: BoardLimits | None) -> Callable[..., int]:
    """Return a function that sends only what the board can take, and else raises BoardRefuses.

    `send` takes a datagram, and may take more.
    """
    if board is None:
        return send

    def send_checked(data: bytes, *more: int | None) -> int:
        if refusal := board.refusal(restored(data)):
            raise BoardRefuses(refusal)
        return send(data, *more)

    return send_checked


def only_what_fits(deliver: Deliver, board: BoardLimits | None, outcome: Outcome) -> Deliver:
    """Return a Deliver that does not let a message wait which the board cannot take."""
    if board is None:
        return deliver

    def deliver_what_fits(now: int, data: bytes, expires: int | None) -> None:
        if refusal := board.refusal(restored(data)):
            outcome.failed(BoardRefuses(refusal))
        else:
            deliver(now, data, expires)

    return deliver_what_fits


def is_stale(now: int, expires: int | None) -> bool:
    return expires is not None and now > expires
