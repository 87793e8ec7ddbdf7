"""A router from UDP to UDP with a deadman, on loopback: `python3 udp_to_udp.py ROUTER`, with any Python.

Exits with 0 if each datagram arrived unchanged, the brake came when commands stopped, `/metrics` counted both, and the
router exited with 0 on SIGTERM. Prints the results, and warnings of the router's log.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path
from time import monotonic, sleep

COMMANDS, PAUSE_S, TIMEOUT_S, PATIENCE_S = 500, 0.01, 0.5, 120.0
OPERATOR, LISTENER, BOARD = ("127.0.0.10", 29001), ("127.0.0.5", 29002), ("127.0.0.30", 29003)
METRICS = "http://127.0.0.1:29004/metrics"
BRAKE = bytes.fromhex("12020801")
PROTO = """\
syntax = "proto3";
message Drive { uint32 number = 1; }
message Brake { bool hard = 1; }
message Envelope { oneof payload { Drive drive = 1; Brake brake = 2; } }
"""
TABLE = f"""\
version: 1
envelope: {{protos: protos, message: Envelope, oneof: payload}}
http: {{address: "127.0.0.1:29004"}}
listen: {{rover: {{address: "{LISTENER[0]}:{LISTENER[1]}"}}}}
endpoints:
  operator: {{address: "{OPERATOR[0]}:{OPERATOR[1]}", kind: basestation}}
  board: {{address: "{BOARD[0]}:{BOARD[1]}", kind: board}}
routes:
  brake: {{ignore: the deadman sends it}}
  drive:
    source: operator
    destinations: board
    ttl: 400ms
    deadman: {{timeout: {TIMEOUT_S:g}s, send: {{brake: {{hard: true}}}}, repeat: 100ms, at_start: silent}}
"""


def command(number: int) -> bytes:
    """An envelope with a `drive` whose number takes two bytes."""
    return bytes((0x0A, 3, 0x08, number % 128 | 0x80, number // 128))


def bound(address: tuple[str, int]) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind(address)
    opened.settimeout(PATIENCE_S)
    return opened


def write(folder: Path) -> Path:
    (folder / "protos").mkdir()
    (folder / "protos" / "envelope.proto").write_text(PROTO)
    table = folder / "table.yaml"
    table.write_text(TABLE)
    return table


def await_start(log: Path, router: subprocess.Popen[bytes]) -> None:
    until = monotonic() + PATIENCE_S
    while "router started" not in log.read_text():
        if router.poll() is not None or monotonic() > until:
            sys.exit(f"the router does not start:\n{log.read_text()}")
        sleep(0.05)


def counted(metric: str) -> int:
    with urllib.request.urlopen(METRICS, timeout=PATIENCE_S) as answer:
        lines = answer.read().decode().splitlines()
    return sum(int(float(line.rpartition(" ")[2])) for line in lines if line.startswith(f"router_{metric}{{"))


def drive(operator: socket.socket, board: socket.socket) -> tuple[int, float]:
    """The number of commands that arrived unchanged, and the seconds from the last one to the brake."""
    whole, arrived_at = 0, monotonic()
    for number in range(128, 128 + COMMANDS):
        operator.sendto(command(number), LISTENER)
        whole += board.recv(2048) == command(number)
        arrived_at = monotonic()
        sleep(PAUSE_S)
    if (found := board.recv(2048)) != BRAKE:
        sys.exit(f"not the brake: {found.hex()}")
    return whole, monotonic() - arrived_at


def main() -> int:
    with tempfile.TemporaryDirectory() as name, bound(OPERATOR) as operator, bound(BOARD) as board:
        folder = Path(name)
        table, log = write(folder), folder / "log"
        with log.open("wb") as stderr:
            router = subprocess.Popen([sys.argv[1], "run", table], stderr=stderr)
        try:
            await_start(log, router)
            whole, brake_s = drive(operator, board)
            received, trips = counted("datagrams_received_total"), counted("deadman_trips_total")
            router.send_signal(signal.SIGTERM)
            ended = router.wait(PATIENCE_S)
        finally:
            router.kill()
        lines = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
    for line in lines:
        if line["level"] != "info":
            print(line["level"], line["event"])
    print(f"{whole} of {COMMANDS} commands byte for byte, brake after {brake_s:.3f} s, SIGTERM: {ended}")
    print(f"/metrics: {received} received, {trips} deadman tripped")
    return 0 if (whole, received, trips, ended) == (COMMANDS, COMMANDS, 1, 0) and brake_s >= TIMEOUT_S else 1


if __name__ == "__main__":
    sys.exit(main())
