"""The log of a running router: JSON for machines, lines for people, floods in summary, faults with the table's line."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.acceptance.payloads import generated
from tests.acceptance.site import ROOT, RouterProcess, site, total

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
    with site(tmp_path) as place:
        ours, theirs = pty.openpty()
        command = [sys.executable, "-m", "router", "run", str(place.table())]
        with subprocess.Popen(command, cwd=ROOT, stderr=theirs) as process:
            os.close(theirs)
            shown = b""
            while b"router started" not in shown:
                shown += os.read(ours, 4096)
            process.terminate()
        os.close(ours)
    assert process.returncode == 0
    assert not any(line.startswith("{") for line in shown.decode().splitlines())


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_log_that_nobody_reads_any_more_does_not_stop_it(
    tmp_path: Path, unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    good = next(generated("ph_info")).datagram
    with site(tmp_path) as place:
        command = [sys.executable, "-m", "router", "run", str(place.table())]
        with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr
            while "router started" not in process.stderr.readline():
                assert process.poll() is None
            process.stderr.close()
            place.send("sensor_board", b"\xff", b"", good)
            assert place.receive("basestation") == good
            process.terminate()
    assert process.returncode == 0
