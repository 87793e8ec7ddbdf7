"""`router demo`: simulated boards and a router on this computer, until Ctrl-C."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING

from router.assets import asset
from router.cli import OK, Subparsers, add_verb
from router.cli.findings import is_coloured
from router.cli.init import FIRST_TABLE
from router.cli.tool_options import good_table, say

if TYPE_CHECKING:
    from router.compiler.compiled_table import CompiledTable

_DESCRIPTION = """Simulate the rover's boards and its basestation, and route between them and ROS 2, until Ctrl-C.
Nothing leaves this computer. The first lines show the addresses for a browser and Foxglove, and a command for another
terminal; 'ros2 topic list' and the other verbs also work. Recordings are written to ./recordings. If the rover's ROS
messages are not installed, the demo runs the table of 'router init'."""


def add_parser(subparsers: Subparsers) -> None:
    add_verb(subparsers, "demo", _DESCRIPTION, "router demo")


def run(args: argparse.Namespace) -> int:
    from router.cli.run import route
    from router.log import configure_log

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("RECORDINGS", str(Path.cwd() / "recordings"))  # the default may be in the installation
    configure_log(coloured=is_coloured(sys.stderr))
    table = _table()
    _, program = good_table(table)
    if sys.stderr.isatty():
        say(f"in another terminal: router top -t {shlex.quote(str(table))}\npress Ctrl-C to stop")
    with _simulated(program) as play:
        route(program, [], os.environ, started=play)
    return OK


def _table() -> Path:
    if find_spec("comms") is not None:
        return asset("routes/sim.yaml")
    say("the rover's ROS messages (comms) are not installed: running the table that `router init` writes")
    return FIRST_TABLE / "routes" / "rover.yaml"


@contextmanager
def _simulated(program: CompiledTable) -> Iterator[Callable[[], None]]:
    """Simulate the table's endpoints in a thread, which sends once the returned function is called: what is sent while
    the router starts becomes stale. An error there stops the process like SIGTERM and is raised here.

    Raises UsageError if an address is in use.
    """
    from router.datagrams import Wire
    from router.tools.simulator import Simulator

    failures: list[Exception] = []
    started = Event()

    def play() -> None:
        started.wait()
        try:
            simulator.run(None, math.inf, lambda _: None)
        except Exception as error:  # noqa: BLE001 - raised by the main thread
            failures.append(error)
            os.kill(os.getpid(), signal.SIGTERM)

    simulator = Simulator(Wire(program.envelopes), program.table, seed=1, deadmen=program.deadmen)
    # The thread inherits the signal mask, so that the main thread gets the signals.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1})
    thread = Thread(target=play, name="simulator")
    thread.start()
    try:
        yield started.set
    finally:
        simulator.stop()
        started.set()
        thread.join()
        simulator.close()
    if failures:
        raise failures[0]
