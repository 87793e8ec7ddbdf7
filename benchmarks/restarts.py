"""A router of the service is killed while it drives: how long does the driving board hear nothing?

    python -m benchmarks.restarts [--restarts 9]

The service is installed in a machine within this one (tests/deploy/machine.py), with the rover's table on the loopback
interface. Needs root. Silence is from `kill -9` to the next datagram at the board, which is the brake.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from router.net.ready import readable
from tests.deploy.machine import machine
from tests.tables import ROUTES

ROOT = Path(__file__).resolve().parent.parent
BOARD, OPERATOR, ROUTER = ("127.0.0.222", 25008), ("127.0.0.10", 29000), ("127.0.0.5", 25000)
DRIVE = bytes.fromhex("c20102080a")
"""A `manual_drive`."""
EVERY = 0.005
"""Seconds between two of them."""
PATIENCE = 30.0
RESTED = "until systemctl is-active -q rover-router; do sleep 0.05; done; systemctl reset-failed rover-router; sleep 2"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--restarts", type=int, default=9)
    parser.add_argument("--inside", action="store_true", help="this is the machine")
    args = parser.parse_args()
    if args.inside:
        measure(args.restarts)
        return
    with tempfile.TemporaryDirectory() as folder, machine(Path(folder)) as found:
        found.shell(f"{ROOT}/deploy/install-service.sh {ROUTES}/sim.yaml")
        words = (sys.executable, "-m", "benchmarks.restarts", "--inside", "--restarts", args.restarts)
        print(found.run("env", "-C", ROOT, *words).stdout, end="")


def measure(restarts: int) -> None:
    """`exec` is when systemd has started the shell that becomes the router."""
    silences, execs = [], []
    for _ in range(restarts):
        subprocess.run(["/bin/sh", "-c", RESTED], check=True)
        killed, heard = kill()
        silences.append(heard - killed)
        execs.append(int(shown("ExecMainStartTimestampMonotonic")) / 1e6 - killed)
    for what, values in (("silence", silences), ("kill to exec", execs)):
        print(f"{what}: {statistics.median(values):.3f} s (median), {min(values):.3f} to {max(values):.3f}")


def kill() -> tuple[float, float]:
    """When a router that drives was killed, and when the board heard the next one."""
    with _bound(BOARD) as board, _bound(OPERATOR) as operator:
        while _next(board, operator) != DRIVE:
            pass
        pid = int(shown("MainPID"))
        killed = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        while (heard := _next(board, operator)) == DRIVE:  # sent before it died
            pass
        if heard is None:
            sys.exit("the router does not come back")
        return killed, time.monotonic()


def shown(name: str) -> str:
    words = ["systemctl", "show", "--property", name, "--value", "rover-router"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def _next(board: socket.socket, operator: socket.socket) -> bytes | None:
    """What the board hears next while the operator drives; None if nothing comes."""
    deadline = time.monotonic() + PATIENCE
    while not readable([board], EVERY):
        if time.monotonic() > deadline:
            return None
        operator.sendto(DRIVE, ROUTER)
    return board.recv(4096)


def _bound(address: tuple[str, int]) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind(address)
    return opened


if __name__ == "__main__":
    main()
