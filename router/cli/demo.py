"""`router demo`: simulated boards and a router on this computer, until Ctrl-C."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from router.assets import asset
from router.cli import OK, Subparsers, add_verb
from router.cli.findings import is_coloured
from router.cli.init import FIRST_TABLE
from router.cli.tool_options import good_table, say

if TYPE_CHECKING:
    from router.compiler.program import Program

_DESCRIPTION = """Play the rover's boards and its basestation, and route between them and ROS 2, until Ctrl-C.
Nothing leaves this computer. The first lines say where to look with a browser or Foxglove, and the command that shows
it in another terminal; 'ros2 topic list' and the other verbs look at it as well. What is recorded is in ./recordings.
Where the rover's ROS messages are not installed, it is the table of 'router init'."""


def add_parser(subparsers: Subparsers) -> None:
    add_verb(subparsers, "demo", _DESCRIPTION, "router demo")


def run(args: argparse.Namespace) -> int:
    from router.cli.run import route
    from router.log import configure_log

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RECORDINGS", str(Path.cwd() / "recordings"))  # not in the installation, where the table is
    configure_log(coloured=is_coloured(sys.stderr))
    table = _table()
    _, program = good_table(table)
    if sys.stderr.isatty():
        say(f"in another terminal: router top -t {shlex.quote(str(table))}; Ctrl-C ends this")
    with _simulated(program):
        route(program, [], os.environ)
    return OK


def _table() -> Path:
    if find_spec("comms") is not None:
        return asset("routes/sim.yaml")
    say("the rover's ROS messages (comms) are not installed: this is the table that `router init` writes")
    return FIRST_TABLE / "routes" / "rover.yaml"


@contextmanager
def _simulated(program: Program) -> Iterator[None]:
    """Play the table's endpoints in a thread; an error there ends the process as SIGTERM does, and is raised here.

    Raises UsageError where an address is taken.
    """
    from router.datagrams import Wire
    from router.tools.simulator import Simulator

    failures: list[Exception] = []

    def play() -> None:
        try:
            simulator.run(None, math.inf, lambda _: None)
        except Exception as error:  # noqa: BLE001 - raised by the main thread
            failures.append(error)
            os.kill(os.getpid(), signal.SIGTERM)

    simulator = Simulator(Wire(program.envelope), program.table, seed=1, deadmen=program.deadmen)
    # The thread inherits this, and leaves the signals to the main thread.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1})
    thread = Thread(target=play, name="simulator")
    thread.start()
    try:
        yield
    finally:
        simulator.stop()
        thread.join()
        simulator.close()
    if failures:
        raise failures[0]
