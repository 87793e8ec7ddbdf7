"""What becomes of a message at one target, counted and reported: for whatever serves targets beside generated code."""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable
from dataclasses import dataclass

from router.compiler.metrics import DROP_REASONS, Counters
from router.compiler.program import TargetPlan
from router.errors import MappingError, NonFiniteError

MAPPING_FAILURES = (ArithmeticError, ValueError, LookupError, struct.error, MappingError)
"""What a value can make of a mapping. Everything else is a fault of ours and goes up, loudly."""

_FULL = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})


Place = tuple[str, str]
"""A route, and which of its targets."""


@dataclass(frozen=True, slots=True)
class Report:
    """Something was lost. `kind` is `drop` (one target), `reject` (a whole datagram) or `deadman` (what one sent).

    `place` is the listener for a reject, else the route; `target` is empty for a reject.
    """

    kind: str
    place: str
    target: str
    reason: str
    error: BaseException | None = None
    detail: str = ""


class Outcome:
    """The counters of one target of one route, in a list of counts that its user owns.

    Every loss is reported but `rate_limited`, which is what the table asks for.
    """

    def __init__(
        self, counters: Counters, counts: list[int], route: str, target: TargetPlan, report: Callable[[Report], None]
    ) -> None:
        self.place: Place = route, target.target
        self._counts = counts
        self._route = route
        self._target = target.target
        self._is_topic = target.is_topic
        self._report = report
        self._dropped = {
            reason: counters.index("messages_dropped", route, target.target, reason) for reason in DROP_REASONS
        }
        self._filtered = counters.index("messages_filtered", route, target.target)
        self._delivered = counters.index(
            "messages_published" if target.is_topic else "datagrams_sent", route, target.target
        )
        self._sent_bytes = None if target.is_topic else counters.index("sent_bytes", route, target.target)

    def delivered(self, size: int) -> None:
        """Handed over: published, or sent with `size` bytes."""
        self._counts[self._delivered] += 1
        if self._sent_bytes is not None:
            self._counts[self._sent_bytes] += size

    def dropped(self, reason: str, error: Exception | None = None, detail: str = "") -> None:
        """Lost for one of DROP_REASONS."""
        self._counts[self._dropped[reason]] += 1
        if reason != "rate_limited":
            self._report(Report("drop", self._route, self._target, reason, error, detail))

    def failed(self, error: Exception) -> None:
        """Lost because mapping it or handing it over raised `error`."""
        self.dropped(_reason(error, self._is_topic), error)

    def filtered(self) -> None:
        self._counts[self._filtered] += 1


class FrameOutcome(Outcome):
    """Of a target that gets frames: it counts parts, which no other target has a series for."""

    def __init__(
        self, counters: Counters, counts: list[int], route: str, target: TargetPlan, report: Callable[[Report], None]
    ) -> None:
        super().__init__(counters, counts, route, target, report)
        self._collected = counters.index("messages_collected", route, target.target)

    def collected(self) -> None:
        """Joined a frame."""
        self._counts[self._collected] += 1


def _reason(error: Exception, is_topic: bool) -> str:
    if isinstance(error, NonFiniteError):
        return "non_finite"
    if isinstance(error, MAPPING_FAILURES):
        return "mapping_error"
    if is_topic:
        return "publish_error"
    return "send_buffer_full" if isinstance(error, OSError) and error.errno in _FULL else "send_error"
