"""The log: readable lines on a terminal, JSON lines elsewhere, both to stderr; floods are summarised."""

from __future__ import annotations

import io
import os
import select
import sys
import threading
from collections.abc import Callable, Hashable
from contextlib import suppress

from router.clock import monotonic_ns
from router.shortage import is_shortage

TYPE_CHECKING = False
if TYPE_CHECKING:
    import logging
    from types import ModuleType
    from typing import Any, TextIO

    from structlog.typing import FilteringBoundLogger, Processor

Emit = Callable[..., None]
"""Called as `emit(event, **values)`, like a method of a structlog logger."""

LEVELS = ("debug", "info", "warning", "error")

SUMMARY_INTERVAL_NS = 10_000_000_000
LONGEST_INTERVAL_NS = 300_000_000_000
MOST_KEYS = 1000


class Fault:
    """The log entry for an unexpected exception. `error` has the traceback."""

    __slots__ = ("emit", "error", "event")

    def __init__(self, emit: Emit, event: str, error: BaseException | None) -> None:
        self.emit = emit
        self.event = event
        self.error = error

    def log(self) -> None:
        self.emit(self.event, exc_info=self.error)


def fault(error: BaseException, what: str, within: str = "the router itself") -> Fault:
    """Describe an unexpected exception, and `what` it did, for example "lost a message"."""
    if is_shortage(error):
        why = str(error) or "no memory"
        return Fault(logger.error, f"memory, threads or descriptors have run out; this {what}: {why}", None)
    return Fault(logger.critical, f"a fault in {within} {what}; please report it", error)


class LazyLogger:
    """A structlog logger that imports and configures structlog when the first line is logged."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._configure: Callable[[ModuleType], None] | None = None
        self._logger: FilteringBoundLogger | None = None

    def configure(self, configure: Callable[[ModuleType], None]) -> None:
        """Call `configure` with structlog before the next line is logged."""
        self._configure, self._logger = configure, None

    def __getattr__(self, method: str) -> Any:
        if self._logger is None:
            structlog = _import_structlog()
            if self._configure is not None:
                self._configure(structlog)
            self._logger = structlog.get_logger(self._name)
        return getattr(self._logger, method)


logger: FilteringBoundLogger = LazyLogger("router")


def _import_structlog() -> ModuleType:
    """Import structlog without asyncio, which serves methods that are not used here."""
    import logging

    from router.lazy_import import lazy_import

    # structlog makes a log record. From Python 3.12 on, a record looks for the current task in sys.modules["asyncio"],
    # and the stand-in there would import asyncio.
    logging.logAsyncioTasks = False  # type: ignore[attr-defined]  # of Python 3.12
    with lazy_import("asyncio"):
        import structlog
    return structlog


def logger_of_library(name: str, library: str) -> logging.Logger:
    """Return a logger for a library that logs what its clients do wrong, which seldom helps an operator: as debug."""
    import logging

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            why = record.exc_info[1] if record.exc_info else None
            logger.debug("message of a library", library=library, what=record.getMessage(), why=repr(why))

    made = logging.getLogger(name)
    made.setLevel(logging.WARNING)
    made.propagate = False
    made.addHandler(Handler())
    return made


def configure_log(level: str = "info", *, coloured: bool = False) -> None:
    """Set up the log for the whole process. `level` is one of LEVELS; colours are for terminals only."""
    logger.configure(lambda structlog: _configure(structlog, level, coloured=coloured))  # type: ignore[attr-defined]


def _configure(structlog: Any, level: str, *, coloured: bool) -> None:
    import logging

    on_terminal = sys.stderr.isatty()
    rendering: list[Processor] = (
        # A plain traceback, without frames and locals.
        [
            structlog.dev.ConsoleRenderer(
                colors=coloured, sort_keys=False, exception_formatter=structlog.dev.plain_traceback
            )
        ]
        if on_terminal
        else [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(default=str)]
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S.%f%z" if on_terminal else "iso", utc=not on_terminal),
            *rendering,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=structlog.PrintLoggerFactory(_NonBlockingStream(sys.stderr)),
        cache_logger_on_first_use=True,
    )


class _NonBlockingStream:
    """A stream that drops lines if its reader is gone or slow, or its disk is full; it never blocks or raises.

    The events of dropped lines are also counted. `flush` bypasses the stream's buffer, which would keep a line that
    cannot be written, and make Python exit with code 120. It writes the rest of an incomplete line before the next one.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._line = ""
        self._rest = b""
        self._room = select.poll()
        self._is_file = _is_file(stream)
        if self._is_file:
            self._descriptor = _non_blocking(stream)
            self._room.register(self._descriptor, select.POLLOUT)

    def write(self, text: str) -> None:
        self._line += text

    def flush(self) -> None:
        line, self._line = self._line, ""
        if not self._is_file:
            self._stream.write(line)
            return
        with suppress(OSError):
            self._write_rest()
            if not self._rest:
                self._rest = line.encode(self._stream.encoding, "backslashreplace")
                self._write_rest()

    def _write_rest(self) -> None:
        while self._rest and self._room.poll(0):  # a pipe is ready if PIPE_BUF bytes fit
            self._rest = self._rest[os.write(self._descriptor, self._rest[: select.PIPE_BUF]) :]


def _non_blocking(stream: TextIO) -> int:
    """Return the stream's descriptor, but for a terminal a new one: writing to a stopped one blocks despite `poll`.

    The stream itself is not made non-blocking, because other processes use the same open file.
    """
    if stream.isatty():
        with suppress(OSError):  # the terminal belongs to another user
            return os.open(f"/proc/self/fd/{stream.fileno()}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    return stream.fileno()


def _is_file(stream: TextIO) -> bool:
    try:
        stream.fileno()
    except io.UnsupportedOperation:  # in memory, for tests
        return False
    return True


class _Flood:
    """Events of one kind: the times of the last line and the last event, and the number of events since that line."""

    __slots__ = ("emit", "event", "interval_ns", "last_event_ns", "last_line_ns", "pending", "values")

    def __init__(self, emit: Emit, event: str, values: dict[str, Any], now: int, pending: int) -> None:
        self.emit = emit
        self.event = event
        self.values = values
        self.interval_ns = SUMMARY_INTERVAL_NS
        self.last_line_ns = self.last_event_ns = now
        self.pending = pending

    def note(self, now: int, times: int, values: dict[str, Any]) -> None:
        """Count events. After a pause the interval is the shortest one again."""
        if now - self.last_event_ns >= SUMMARY_INTERVAL_NS:
            self.interval_ns = SUMMARY_INTERVAL_NS
        self.last_event_ns = now
        self.pending += times
        self.values = values

    def is_due(self, now: int) -> bool:
        """Return whether pending events are to be logged: after the interval, or sooner if no more have come."""
        is_over = now - self.last_event_ns >= SUMMARY_INTERVAL_NS
        return self.pending > 0 and now - self.last_line_ns >= (SUMMARY_INTERVAL_NS if is_over else self.interval_ns)

    def summarise(self, now: int) -> None:
        seconds = round((now - self.last_line_ns) / 1e9, 1)
        self.emit(self.event, **self.values, more=self.pending, in_seconds=seconds)
        self.pending, self.last_line_ns = 0, now
        self.interval_ns = min(2 * self.interval_ns, LONGEST_INTERVAL_NS)


class FloodLog:
    """Logs the first event of a kind at once, then summaries with the last event and their count.

    The first summary comes after 10 s; while events go on, each comes after twice the time, up to 5 minutes.

    Thread-safe. Call `flush()` regularly, or the last events of a flood are not logged. Kinds beyond `MOST_KEYS` share
    a summary.
    """

    def __init__(self, clock_ns: Callable[[], int] = monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._floods: dict[Hashable, _Flood] = {}
        self._lock = threading.Lock()

    def note(
        self,
        key: Hashable,
        emit: Emit,
        event: str,
        exc_info: BaseException | None = None,
        times: int = 1,
        **values: Any,
    ) -> None:
        """Log or count `times` events of the kind `key`. The first line has the traceback of `exc_info`."""
        now = self._clock_ns()
        with self._lock:
            flood = self._floods.get(key)
            if flood is None and len(self._floods) >= MOST_KEYS:
                flood = self._floods.get(None)
                key, event, values = None, "events of many further kinds", {}
            if flood is not None:
                flood.note(now, times, values)
                if flood.is_due(now):
                    flood.summarise(now)
                return
            self._floods[key] = _Flood(emit, event, values, now, times - 1)
        emit(event, exc_info=exc_info, **values)

    def flush(self, *, final: bool = False) -> None:
        """Write the summaries that are due, or with `final` all that are pending."""
        now = self._clock_ns()
        with self._lock:
            for flood in self._floods.values():
                if flood.is_due(now) or (final and flood.pending):
                    flood.summarise(now)
