"""The log of a running router: JSON for machines, lines for people, floods in summary, faults with the table's line."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import RouterProcess, site, total
from tests.routers import MODULE, log_until_started, start

FLOOD = 2_000
HANDFUL = 10
"""Lines. The first, one every 10 s, one at the end."""


def test_a_flood_is_told_in_a_handful_of_lines_that_add_up(tmp_path: Path) -> None:
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table()) as router:
        before = place.scrape()
        place.send("sensor_board", *[b"\xff" * 30] * FLOOD)
        counted = place.settle(before, FLOOD)
        assert router.stop(signal.SIGTERM) == 0
        for line in router.text().splitlines():
            assert {"event", "level", "timestamp"} <= set(json.loads(line))
        lines = router.events("datagram rejected")
        assert len(lines) <= HANDFUL
        told = 1 + sum(line.get("more", 0) for line in lines)
        assert told == total(counted, "datagrams_rejected", reason="malformed") == total(counted, "datagrams_received")


def test_a_person_at_a_terminal_reads_lines(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    with site(tmp_path) as place, running(place.table(), stderr=theirs) as process, os.fdopen(ours) as log:
        os.close(theirs)
        shown = log_until_started(log)
        process.terminate()
        assert process.wait(PATIENCE) == 0
    assert not any(line.startswith("{") for line in shown)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_log_that_nobody_reads_any_more_does_not_stop_it(tmp_path: Path, unbuffered: str) -> None:
    good = next(generated("ph_info")).datagram
    environment = {"PYTHONUNBUFFERED": unbuffered}
    with site(tmp_path) as place, running(place.table(), environment=environment) as process:
        assert process.stderr
        log_until_started(process.stderr)
        process.stderr.close()
        place.send("sensor_board", b"\xff", b"", good)
        assert place.receive("basestation") == good
        process.terminate()
        assert process.wait(PATIENCE) == 0


@contextmanager
def running(table: Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A router whose log the test reads; it is killed if the test has not ended it."""
    with start(MODULE, "run", table, **options) as process:
        try:
            yield process
        finally:
            process.kill()
