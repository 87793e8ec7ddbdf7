"""The log of a running router: JSON for machines, lines for people, floods in summary, faults with the table's line."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

from tests.acceptance.conftest import Rover
from tests.acceptance.payloads import WIRE, generated, sample
from tests.acceptance.rover_map import topics_of
from tests.acceptance.site import ROOT, RouterProcess, balance, key, site, total
from tests.tables import ROUTES

FLOOD = 10_000
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


def test_a_value_that_a_mapping_cannot_take_is_told_with_the_line_of_the_table(watched: Rover) -> None:
    """Sine of infinity is no number: `gps/vel` goes without, the other targets are served."""
    payload = WIRE.envelope.cases["gps_info"].message_class(heading=float("inf"), speed=1.0)
    datagram = sample("gps_info", payload).datagram
    place, router = watched.site, watched.router
    before = place.scrape()
    place.send("sensor_board", datagram, datagram)
    assert [place.receive("basestation") for _ in range(2)] == [datagram] * 2
    counted = place.settle(before, 2)
    for topic in topics_of("gps_info"):
        published = counted[key("messages_published", route="gps_info", topic=topic)]
        assert published == (0 if topic == "gps/vel" else 2)
    assert counted[key("messages_dropped", route="gps_info", target="gps/vel", reason="mapping_error")] == 2
    balance(place.scrape())

    [line] = router.events("message dropped")
    assert (line["route"], line["target"], line["reason"]) == ("gps_info", "gps/vel", "mapping_error")
    rover_yaml = ROUTES / "rover.yaml"
    number = next(n for n, text in enumerate(rover_yaml.read_text().splitlines(), 1) if "speed * sin(" in text)
    frames = [text.strip() for text in line["exception"].splitlines() if text.strip().startswith("File ")]
    assert any("rover.yaml" in frame and f"line {number}," in frame for frame in frames), line["exception"]


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


def test_a_log_that_nobody_reads_any_more_does_not_stop_it(tmp_path: Path) -> None:
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
