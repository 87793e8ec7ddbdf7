"""`router demo` on a terminal: it says where to look, and ends with Ctrl-C."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from demo.places import alone
from router.cli import demo
from router.cli.init import FIRST_TABLE
from tests.readable import readable

PATIENCE = 60.0


def test_without_the_rovers_messages_it_plays_the_first_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "find_spec", lambda _: None)
    assert demo._table() == FIRST_TABLE / "routes" / "rover.yaml"
    assert "comms" in capsys.readouterr().err


FAILING = """
import signal

from router.cli import demo
from router.compiler import check_table
from router.tools import simulator


class Failing:
    def __init__(self, *_, **__):
        pass

    def run(self, *_):
        raise RuntimeError("the simulator is broken")

    stop = close = __init__


simulator.Simulator = Failing
with demo._simulated(check_table(demo.FIRST_TABLE / "routes" / "rover.yaml").program) as play:
    play()
    assert signal.sigwait({signal.SIGTERM}) == signal.SIGTERM
"""


def test_a_simulator_that_fails_ends_it_with_the_error() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FAILING], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 1
    assert "RuntimeError: the simulator is broken" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(find_spec("rclpy") is None or find_spec("comms") is None, reason="needs ROS 2 and comms")
def test_it_says_where_to_look_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    """In a network of its own: its ports are fixed, and another demo may be running."""
    if (wrapper := alone()) is None:
        pytest.skip("needs a network namespace")
    ours, theirs = pty.openpty()
    environment = {**os.environ, "RECORDINGS": str(tmp_path), "NO_COLOR": "1"}
    command = [*wrapper, sys.executable, "-m", "router", "demo"]
    with subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True
    ) as process:
        os.close(theirs)
        limit, seen = time.monotonic() + PATIENCE, b""
        while b"Foxglove " not in seen:
            assert readable(ours, limit - time.monotonic()), seen
            try:
                seen += os.read(ours, 65536)  # which may end within a character
            except OSError:  # the terminal is closed
                pytest.fail(f"it ended: {seen.decode(errors='replace')}")
        assert b"status page        http://127.0.0.1:29108/" in seen
        assert b"gateway dashboard  http://127.0.0.1:28765/" in seen
        process.send_signal(2)
        assert process.wait(PATIENCE) == 0
    assert b"dropped" not in seen  # the simulated rover sends nothing before the router can deliver it
    os.close(ours)
