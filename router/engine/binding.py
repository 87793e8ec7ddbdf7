"""Turns a handler's code into a function: its namespace gets counters, senders, publishers and limits."""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from router.compiler.books import DROP_REASONS, Books
from router.compiler.program import Handler, TargetPlan
from router.engine.limiter import rate_limit
from router.errors import MappingError, NonFiniteError

Handle = Callable[[object, bytes, int, int, str], None]
"""Takes the parsed message, the datagram, its arrival by wall clock and by monotonic clock (ns), the sender's name."""

MAPPING_FAILURES = (ArithmeticError, ValueError, LookupError, struct.error, MappingError)
"""What a value can make of a mapping. Everything else is a fault of ours and goes up, loudly."""

_FULL = frozenset({errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS})


@dataclass(frozen=True, slots=True)
class Report:
    """Something was lost. `kind` is `drop` (one target) or `reject` (a whole datagram).

    `place` is the route for a drop, the listener for a reject; `target` is empty for a reject.
    """

    kind: str
    place: str
    target: str
    reason: str
    error: BaseException | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Outlets:
    """What an engine hands to its handlers; see Engine for what each does."""

    counts: list[int]
    send: Mapping[str, Callable[[bytes], int]]
    publish: Mapping[str, Callable[[bytes], None]]
    wanted: Mapping[str, list[bool]]
    report: Callable[[Report], None]
    publish_errors: tuple[type[Exception], ...]


def bind(handler: Handler, books: Books, outlets: Outlets) -> Handle:
    namespace: dict[str, object] = {
        **handler.constants,
        "counts": outlets.counts,
        "FAILURES": (*MAPPING_FAILURES, OSError, *outlets.publish_errors),
    }
    for target in handler.targets:
        if target.is_topic:
            namespace[f"publish_{target.name}"] = outlets.publish[target.target]
            namespace[f"wanted_{target.name}"] = outlets.wanted[target.target]
        else:
            namespace[f"send_{target.name}"] = outlets.send[target.target]
        if target.max_rate is not None:
            namespace[f"limit_{target.name}"] = rate_limit(target.max_rate)
        namespace[f"lost_{target.name}"] = _lost(handler.case.name, target, books, outlets)
    exec(handler.code, namespace)  # noqa: S102 - code that our compiler made of a checked table
    handle: Handle = namespace[handler.function]  # type: ignore[assignment]
    return handle


def _lost(route: str, target: TargetPlan, books: Books, outlets: Outlets) -> Callable[[Exception], None]:
    slots = {reason: books.slot("messages_dropped", route, target.target, reason) for reason in DROP_REASONS}
    counts, report = outlets.counts, outlets.report

    def lost(error: Exception) -> None:
        reason = _reason(error, target.is_topic)
        counts[slots[reason]] += 1
        report(Report("drop", route, target.target, reason, error))

    return lost


def _reason(error: Exception, is_topic: bool) -> str:
    if isinstance(error, NonFiniteError):
        return "non_finite"
    if isinstance(error, MAPPING_FAILURES):
        return "mapping_error"
    if is_topic:
        return "publish_error"
    return "send_buffer_full" if isinstance(error, OSError) and error.errno in _FULL else "send_error"
