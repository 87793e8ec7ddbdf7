"""Turns a handler's code into a function: its namespace gets counters, senders, publishers and limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from router.compiler.books import Books
from router.compiler.program import Handler
from router.engine.limiter import RateLimit
from router.engine.outcome import MAPPING_FAILURES, Outcome, Report

Handle = Callable[[object, bytes, int, int, str], None]
"""Takes the parsed message, the datagram, its arrival by wall clock and by monotonic clock (ns), the sender's name."""


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
            namespace[f"limit_{target.name}"] = RateLimit(target.max_rate).may_pass
        namespace[f"lost_{target.name}"] = Outcome(
            books, outlets.counts, handler.case.name, target, outlets.report
        ).failed
    exec(handler.code, namespace)  # noqa: S102 - code that our compiler made of a checked table
    handle: Handle = namespace[handler.function]  # type: ignore[assignment]
    return handle
