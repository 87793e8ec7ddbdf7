"""A router, in this process or in another, between a board that sends and a basestation that receives."""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import time

import pytest

from router.app import Router
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from tests.ports import free_port
from tests.repeating import repeating
from tests.tables import PROTOS

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
{listen}
endpoints:
  sensor_board: {{address: 127.0.0.30:8, kind: board}}
  basestation: {{address: "127.0.0.1:{basestation}", kind: basestation}}
{more}"""
DRIVE, BRAKE = bytes.fromhex("c201021005"), bytes.fromhex("ca01020801")


def numbered(number: int) -> bytes:
    """A `ph_info` with this number as its value."""
    return bytes.fromhex("0a050d") + struct.pack("<f", number)


def let_rest(path: Path) -> None:
    """Make the file look a minute old, because a reload waits for files that are still changing."""
    os.utime(path, (time() - 60,) * 2)


def udp(host: str) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    opened.bind((host, 0))
    opened.settimeout(10)
    return opened


@dataclass
class Site:
    """A folder for the table, a board that sends and a basestation that receives."""

    folder: Path
    board: socket.socket
    basestation: socket.socket
    listen: int
    sent: list[int] = field(default_factory=list)
    received: list[int] = field(default_factory=list)
    """The numbers that `take` has received at the basestation."""

    def write(self, routes: str, *, listen: str | None = None, endpoints: str = "") -> Path:
        """Write a table; `routes` may be followed by other keys."""
        path = self.folder / "table.yaml"
        listeners = listen or f'  rover: {{address: "127.0.0.1:{self.listen}"}}'
        destination = self.basestation.getsockname()[1]
        path.write_text(
            TABLE.format(protos=PROTOS, listen=listeners, basestation=destination, more=f"{endpoints}routes:\n{routes}")
        )
        let_rest(path)
        return path

    def program(self, routes: str, endpoints: str = "") -> CompiledTable:
        checked = check_table(self.write(routes, endpoints=endpoints))
        assert checked.program, "\n".join(map(str, checked.diagnostics))
        return checked.program

    @contextmanager
    def router(self, routes: str) -> Iterator[Router]:
        with Router(self.program(routes)) as router:
            yield router

    def send(self, *datagrams: bytes, port: int | None = None) -> None:
        for datagram in datagrams:
            self.board.sendto(datagram, ("127.0.0.1", port or self.listen))

    def under_load(self) -> AbstractContextManager[None]:
        """Meanwhile send 2,000 numbered datagrams per second."""

        def load() -> None:
            self.send(numbered(len(self.sent)))
            self.sent.append(len(self.sent))
            self.take()

        return repeating(load, 0.0005)

    def take(self) -> None:
        """Receive the datagrams that have arrived."""
        self.basestation.setblocking(False)
        with suppress(BlockingIOError):
            while datagram := self.basestation.recv(1000):
                self.received.append(int(struct.unpack("<f", datagram[3:])[0]))


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with udp("127.0.0.30") as board, udp("127.0.0.1") as basestation:
        yield Site(tmp_path, board, basestation, free_port())


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[threading.Event, threading.Event]]:
    """Native publishing sets the first event and blocks until the second one is set."""
    rcl = pytest.importorskip("router.ros.rcl", reason="needs ROS 2")
    is_in, goes_on = threading.Event(), threading.Event()

    def block(*_: object) -> int:
        is_in.set()
        goes_on.wait(60)
        return 0

    blocking = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)(block)
    functions = rcl.publish_functions()._replace(publish=ctypes.cast(blocking, ctypes.c_void_p).value)
    monkeypatch.setattr(rcl, "publish_functions", lambda: functions)
    yield is_in, goes_on
    goes_on.set()
