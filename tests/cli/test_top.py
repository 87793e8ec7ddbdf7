"""`router top` on a terminal and without one, and a router that does not answer."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from router.cli import OK, main
from tests.readable import readable
from tests.tools.answering import answering

PATIENCE = 30.0
BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
METRICS = """\
router_datagrams_received_total{listener="rover"} 7
router_messages_received_total{route="imu_info",source="sensor_board"} 7
router_messages_received_total{route="gps_info",source="sensor_board"} 0
router_datagrams_sent_total{route="imu_info",destination="basestation"} 7
router_messages_dropped_total{route="gps_info",target="basestation",reason="stale"} 2
router_datagrams_sent_total{route="gps_info",destination="basestation"} 0
router_endpoint_unheard_seconds{endpoint="sensor_board"} 12
"""


@pytest.fixture(scope="module")
def served() -> Iterator[str]:
    with answering(METRICS) as url:
        yield url


def test_without_a_terminal_it_is_shown_once(served: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["top", "--url", served, "--interval", "10ms", "--sort", "drops"]) == OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"rover.yaml at {served}"
    assert lines[1].startswith("in 7 (0/s), delivered 7")
    assert [line.split()[0] for line in lines[4:]] == ["gps_info", "imu_info"]


@pytest.mark.parametrize("more", ["", "endpoints: {arm_board: {kind: bord}}\n"], ids=["good", "with errors"])
def test_the_address_is_that_of_the_table(
    served: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: str
) -> None:
    table = tmp_path / "table.yaml"
    address = served.removeprefix("http://")
    table.write_text(f"version: 1\nextends: {BASE}\nhttp: {{address: {address}}}\n{more}")
    assert main(["top", "-t", str(table), "--once", "--interval", "10ms"]) == OK
    assert "imu_info" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["<html>hello</html>", "", 'node_cpu{cpu="0"} 1\n', 'router_kernel_drops{a="b"} 1\n'])
def test_what_is_no_router_is_said_in_a_line(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with answering(text) as url:
        assert main(["top", "--url", url, "--interval", "10ms"]) == 1
    assert re.fullmatch(rf"router top: what answers at {url}/metrics is not a router.*\n", capsys.readouterr().err)


def read_until(terminal: int, wanted: str) -> None:
    """Read what the terminal shows until it shows `wanted`."""
    limit, seen = time.monotonic() + PATIENCE, b""
    while wanted.encode() not in seen:
        assert readable(terminal, limit - time.monotonic()), f"no {wanted!r} in {seen!r}"
        seen += os.read(terminal, 65536)  # which may end within a character


def test_on_a_terminal_keys_sort_and_end_it(served: str) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 20, 100, 0, 0))
    before = termios.tcgetattr(theirs)
    command = [sys.executable, "-m", "router", "top", "--url", served, "--interval", "1min"]
    environment = {**os.environ, "TERM": "xterm"}
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        read_until(ours, "[t table]")
        os.write(ours, b"d")
        read_until(ours, "[d drops]")
        os.write(ours, b"q")
        assert process.wait(PATIENCE) == OK
    assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)
