"""Summaries in the log: the first event is logged at once, the following ones are counted."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import structlog

from router import log
from router.log import SUMMARY_INTERVAL_NS, FloodLog


class Lines:
    """Stands in for a logger's method and for the clock, which advances only when the test sets it."""

    def __init__(self) -> None:
        self.now = 0
        self.written: list[tuple[str, dict[str, Any]]] = []
        self.floods = FloodLog(clock_ns=lambda: self.now)

    def emit(self, event: str, **values: Any) -> None:
        self.written.append((event, values))

    def note(self, key: str, error: Exception | None = None) -> None:
        self.floods.note(key, self.emit, key, error, route="imu_info")


@pytest.fixture
def lines() -> Lines:
    return Lines()


def test_the_first_event_is_written_at_once_with_its_error(lines: Lines) -> None:
    error = ValueError("no")
    lines.note("drop", error)
    assert lines.written == [("drop", {"exc_info": error, "route": "imu_info"})]


def test_a_flood_becomes_one_line_per_interval_with_a_count(lines: Lines) -> None:
    for _ in range(1000):
        lines.note("drop")
    lines.now = SUMMARY_INTERVAL_NS
    lines.note("drop")
    lines.note("drop")
    assert lines.written[1:] == [("drop", {"more": 1000, "in_seconds": 10.0, "route": "imu_info"})]


def test_the_line_with_the_count_tells_of_the_last_event(lines: Lines) -> None:
    for part in range(3):
        lines.floods.note("drop", lines.emit, "drop", part=part)
    lines.floods.flush(final=True)
    assert [values["part"] for _, values in lines.written] == [0, 2]


def test_flush_tells_the_end_of_a_flood_when_it_is_due(lines: Lines) -> None:
    lines.note("drop")
    lines.note("drop")
    lines.floods.flush()
    assert len(lines.written) == 1
    lines.now = SUMMARY_INTERVAL_NS
    lines.floods.flush()
    lines.floods.flush()
    assert [values.get("more") for _, values in lines.written] == [None, 1]


def test_what_goes_on_for_an_hour_is_told_less_and_less_often_and_soon_again_after_a_pause(lines: Lines) -> None:
    for second in range(3600):
        lines.now = second * 10**9
        lines.note("drop")
        lines.floods.flush()
    assert len(lines.written) == 16
    assert [values["in_seconds"] for _, values in lines.written[1:8]] == [10, 20, 40, 80, 160, 300, 300]
    lines.now += SUMMARY_INTERVAL_NS
    lines.floods.flush()  # over: the rest is told without waiting for the interval
    assert 1 + sum(values.get("more", 0) for _, values in lines.written) == 3600
    lines.now += SUMMARY_INTERVAL_NS
    lines.note("drop")
    assert len(lines.written) == 18
    lines.note("drop")
    lines.now += SUMMARY_INTERVAL_NS
    lines.floods.flush()
    assert len(lines.written) == 19


def test_the_number_of_kinds_is_bounded(lines: Lines, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, "MOST_KEYS", 2)
    for kind in "abcde":
        lines.note(kind)
    lines.floods.flush(final=True)
    assert [event for event, _ in lines.written] == ["a", "b"] + 2 * ["events of many further kinds"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def fresh_log(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(log, "logger", log.LazyLogger("router"))
    yield
    structlog.reset_defaults()


@pytest.mark.usefixtures("fresh_log")
@pytest.mark.parametrize("coloured", [True, False])
def test_on_a_terminal_a_line_is_for_reading(coloured: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    log.configure_log(coloured=coloured)
    log.logger.warning("datagram rejected", reason="empty", detail="from here")
    line = terminal.getvalue()
    assert ("\x1b[" in line) is coloured
    if not coloured:
        assert line.split()[1:] == ["[warning", "]", "datagram", "rejected", "reason=empty", "detail='from", "here'"]


@pytest.mark.usefixtures("fresh_log")
@pytest.mark.parametrize("length", [180, 10_000])
def test_a_reader_that_stands_still_holds_nobody_up(length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading) as pipe, os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        log.configure_log()
        for _ in range(2000):  # several times what a pipe holds
            log.logger.warning("datagram rejected", reason="empty", detail="x" * length)
        written = os.read(pipe.fileno(), 1 << 20)
        log.logger.warning("the reader is back")
        written += os.read(pipe.fileno(), 1 << 20)
    *many, last = [json.loads(line)["event"] for line in written.splitlines()]
    assert 0 < len(many) < 2000
    assert (*{*many}, last) == ("datagram rejected", "the reader is back")


@pytest.mark.usefixtures("fresh_log")
def test_a_terminal_that_stands_still_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.openpty()
    with os.fdopen(reading, "rb"), os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        log.configure_log()
        for _ in range(2000):  # several times what a terminal holds
            log.logger.warning("datagram rejected", reason="empty", detail="from here" * 20)
        assert os.read(reading, 100)


def test_structlog_is_loaded_with_the_first_line_and_without_what_it_does_not_need_here() -> None:
    script = """
import sys
from router.log import FloodLog, configure_log, logger
configure_log("error")
print("structlog" in sys.modules)
logger.error("a line")
print("structlog" in sys.modules, *{"asyncio", "ssl"} & {*sys.modules})
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
    assert '"event": "a line"' in done.stderr
