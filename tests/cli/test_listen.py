"""The verb listen as it is typed, against senders of its own."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from router.cli import BROKEN_PIPE, main
from router.gateway.packets import Packet, compress, datagrams, pack, unpack
from tests.ports import free_port

SCHEMA = {
    "name": "T",
    "namespace": "p::msg",
    "fields": [{"name": "x", "is_array": False, "type": "float32", "subtype": "primitive"}],
}
LISTEN = [sys.executable, "-m", "router", "listen"]


def packet(payload: object, topic: str = "/a/t", level: int = 0) -> bytes:
    text = json.dumps(payload).encode()
    return pack(Packet(5.25, level > 0, topic, "p/msg/T", compress(text, level) if level else text))


@pytest.fixture
def gateway() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(10)
        yield opened


@contextmanager
def listening(*options: str) -> Iterator[tuple[subprocess.Popen[str], tuple[str, int]]]:
    """A process that listens on a free UDP port by now, and where that is."""
    port = free_port()
    command = [*LISTEN, f"udp://127.0.0.1:{port}", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == f"listening: udp 127.0.0.1:{port}; press Ctrl-C to stop\n"
        yield process, ("127.0.0.1", port)


def test_what_arrives_is_printed_one_line_each(gateway: socket.socket) -> None:
    with listening("--count", "3") as (process, address):
        large = packet({"x": [0.5], "y": ["z" * 5000]})
        for data in datagrams([packet(SCHEMA), packet({"x": [1.5]}, level=3), large], 1400, 5.0):
            gateway.sendto(data, address)
        gateway.sendto(b"?", address)
        gateway.sendto(packet({"x": [2.5]}), address)
        out, err = process.communicate(timeout=30)
    assert [line.split(" ", 1)[1] for line in out.splitlines()] == [
        "/a/t p/msg/T schema x:float32",
        "/a/t p/msg/T x=1.5",
        f"/a/t p/msg/T x=0.5 y=[{'z' * 120}...(5000)]",
        "(1 bytes are too short for a packet): 3f",
        "/a/t p/msg/T x=2.5",
    ]
    assert err == "3 messages, 1 schemas, 1 undecodable, 0 lost\n"
    assert process.returncode == 0


def test_it_asks_for_schemas_and_json_lines_go_to_a_file_as_well(gateway: socket.socket, tmp_path: Path) -> None:
    path = tmp_path / "record.jsonl"
    path.write_text("what was there\n")
    host, port = gateway.getsockname()
    options = ["--json", "--record", str(path), "--topic", "/a/*", "--topic", "/b", "--count", "2"]
    with listening(*options, "--ask", f"{host}:{port}") as (process, address):
        request, peer = gateway.recvfrom(100)
        assert (peer, unpack(request).payload) == (address, b"")
        for data in (packet(SCHEMA), packet({"x": [1]}, "/c"), packet({"x": [1]}), packet({"x": [2]}, "/b")):
            gateway.sendto(data, address)
        out, err = process.communicate(timeout=30)
    assert [json.loads(line) for line in out.splitlines()] == [
        {"time": 5.25, "topic": "/a/t", "type": "p/msg/T", "schema": SCHEMA},
        {"time": 5.25, "topic": "/a/t", "type": "p/msg/T", "data": {"x": [1]}},
        {"time": 5.25, "topic": "/b", "type": "p/msg/T", "data": {"x": [2]}},
    ]
    assert path.read_text() == "what was there\n" + out
    assert err == "2 messages, 1 schemas, 0 undecodable, 0 lost, 1 of other topics\n"


def test_a_file_that_takes_no_more_ends_it(gateway: socket.socket) -> None:
    with listening("--record", "/dev/full") as (process, address):
        gateway.sendto(packet({"x": [1]}), address)
        _, err = process.communicate(timeout=30)
    assert err.splitlines()[-1] == "router listen: --record /dev/full: No space left on device"
    assert process.returncode == 1


def test_it_ends_after_its_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["listen", f"udp://127.0.0.1:{free_port()}", "--for", "1ms"]) == 0
    assert capsys.readouterr().err.endswith("\n0 messages, 0 schemas, 0 undecodable, 0 lost\n")


def test_ctrl_c_ends_it_with_what_there_was(gateway: socket.socket) -> None:
    with listening() as (process, address):
        gateway.sendto(packet({"x": [1]}), address)
        assert process.stdout is not None
        assert process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (0, "1 messages, 0 schemas, 0 undecodable, 0 lost, 1 before their schema\n")


def test_a_reader_that_leaves_ends_it_quietly(gateway: socket.socket) -> None:
    with listening() as (process, address):
        assert process.stdout is not None
        process.stdout.close()
        process.stdout = None
        gateway.sendto(packet({"x": [1]}), address)
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (
        BROKEN_PIPE,
        "1 messages, 0 schemas, 0 undecodable, 0 lost, 1 before their schema\n",
    )


def test_a_terminal_gets_colours_and_one_line_for_each(gateway: socket.socket) -> None:
    port = free_port()
    ours, terminal = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "60"}
    command = [*LISTEN, f"udp://127.0.0.1:{port}", "--count", "1"]
    with subprocess.Popen(command, stdout=terminal, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        process.stderr.readline()
        gateway.sendto(packet({"x": [1] * 100, "y": ["z" * 100]}, "/[bold]"), ("127.0.0.1", port))
        process.communicate(timeout=30)
    os.close(terminal)
    shown = os.read(ours, 4096).decode()
    os.close(ours)
    assert shown.count("\n") == 1
    assert "\x1b[32m/[bold]\x1b[0m" in shown
    assert "z" * 60 not in shown
