"""`router tap` on a running router: it shows what comes, and the router does not notice."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from router.cli import main
from router.observe.tap import Lost
from router.tools.running_router import tap
from tests.acceptance.conftest import Rover
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import ROOT, total

IMU, GPS = (next(generated(case)).datagram for case in ("imu_info", "gps_info"))


@contextmanager
def tapping(rover: Rover, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A process that taps by now."""
    command = [sys.executable, "-m", "router", "tap", *words, "--table", str(rover.table)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("tapping the router at http://127.0.0.1:")
        try:
            yield process
        finally:
            process.kill()


def shown(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (0, "")
    return [json.loads(line) for line in out.splitlines()]


def test_a_tap_shows_what_the_router_receives_and_from_whom(rover: Rover) -> None:
    before = rover.site.scrape()
    with tapping(rover, "--json", "--hex", "--count", "3") as process:
        rover.site.send("sensor_board", IMU, GPS)
        rover.site.send("arm_board", b"junk")
        lines = shown(process)
    assert total(rover.site.settle(before, 3), "datagrams_sent") == 2  # the tap takes nothing away
    assert [(line.get("case"), line["peer"], line["hex"]) for line in lines] == [
        ("imu_info", "sensor_board", IMU.hex()),
        ("gps_info", "sensor_board", GPS.hex()),
        (None, "arm_board", b"junk".hex()),
    ]


def test_a_tap_shows_some_cases_senders_and_values_only(rover: Rover) -> None:
    words = ("imu_info", "gps_info", "--from", "sensor_board", "--where", "source == 'sensor_board'")
    with tapping(rover, *words, "--json", "--count", "2") as process:
        rover.site.send("arm_board", IMU)
        rover.site.send("sensor_board", b"junk", next(generated("ph_info")).datagram, IMU, GPS)
        assert [line["case"] for line in shown(process)] == ["imu_info", "gps_info"]


def test_who_does_not_read_his_tap_misses_datagrams_and_is_told_how_many(rover: Rover) -> None:
    """More than wait in the router and in the kernel's buffers. The router routes them all the same."""
    number, burst = 1000, 50
    with tap(f"http://127.0.0.1:{rover.site.metrics}") as batches:
        before = rover.site.scrape()
        for sent in range(burst, number + 1, burst):
            rover.site.send("sensor_board", *[b"\xff" * 16000] * burst)
            rover.site.settle(before, sent)
        seen = missed = 0
        arrived = number - total(rover.site.changes(before), "kernel_drops")
        while seen + missed < arrived:
            for each in next(batches):
                seen, missed = (seen, missed + each.number) if isinstance(each, Lost) else (seen + 1, missed)
    assert missed > 0
    assert seen + missed == arrived


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["imu_inf"], "PBEnvelope has no payload case 'imu_inf'\nhelp: did you mean 'imu_info'?"),
        (["imu_info", "5000"], "PBEnvelope has no payload case '5000'\nhelp: known: "),
        (["--from", "arm_bord"], "the router has no endpoint 'arm_bord'; did you mean 'arm_board'?"),
        (["--url", "ftp://here"], "'ftp://here' is not like http://127.0.0.1:9108"),
    ],
)
def test_a_mistake_is_one_line(
    rover: Rover, words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tap", *words, "--table", str(rover.table)]) == 2
    assert capsys.readouterr().err.startswith(f"router tap: {complaint}")


def test_a_tap_where_no_router_runs_says_so(rover: Rover, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tap", "--url", "http://127.0.0.1:1", "--table", str(rover.table)]) == 1
    assert "no router answers at http://127.0.0.1:1: " in capsys.readouterr().err
