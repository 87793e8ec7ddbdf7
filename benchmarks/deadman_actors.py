"""Who plays in `deadman_trials`: boards that note when something came, and sources that can be made to fail."""

from __future__ import annotations

import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.deadman_sources import WRAP, envelope_class
from router.net.ready import readable
from tests.acceptance.site import ROOT

SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")


@dataclass(frozen=True)
class Arrival:
    """A datagram that a board got at `at` (wall clock, ns). `made` is what a command carries, None for a brake."""

    at: int
    made: int | None

    def is_older_than(self, age: int) -> bool:
        """Whether it is a command that was made more than `age` ms before it came."""
        return self.made is not None and (self.at // 1_000_000 - self.made) % WRAP > age


class Board:
    """A socket that takes commands and brakes."""

    def __init__(self, opened: socket.socket, table: Path) -> None:
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket = opened
        self._parse = envelope_class(table).FromString

    def next(self) -> Arrival:
        """Waits for it; raises TimeoutError when nothing comes."""
        data, [(_, _, stamp)], _, _ = self._socket.recvmsg(2048, 64)
        seconds, nanoseconds = _TIMESPEC.unpack(stamp)
        envelope: Any = self._parse(data)
        case = envelope.WhichOneof("payload")
        made = {
            "manual_brake": None,
            "manual_drive": envelope.manual_drive.forward_backward,
            "drive_motor": int(envelope.drive_motor.distance_to_go),
        }[case]
        return Arrival(seconds * 1_000_000_000 + nanoseconds, made)

    def arrivals(self, seconds: float) -> Iterator[Arrival]:
        """What comes within some time, from what has come already on."""
        end = time.monotonic() + seconds
        while readable([self._socket], end - time.monotonic()):
            yield self.next()


class Proxy:
    """Stands between the operator and the router; while it is closed, nothing comes through."""

    def __init__(self, operator: socket.socket, router: tuple[str, int]) -> None:
        self.is_open = True
        self._operator = operator
        self._router = router
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inside.bind(("127.0.0.1", 0))
        self.address = "{}:{}".format(*self._inside.getsockname())
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while data := self._inside.recv(2048):
            if self.is_open:
                self._operator.sendto(data, self._router)

    def close(self) -> None:
        self._inside.sendto(b"", self._inside.getsockname())
        self._thread.join()
        self._inside.close()


class Source:
    """A command source in a process of its own. Each fault ends its commands, and `recover` brings them back."""

    FAULTS = ("killed", "stopped", "cut off")

    def __init__(self, arguments: Sequence[str], proxy: Proxy | None) -> None:
        self._arguments = arguments
        self._proxy = proxy
        self._process = child(*arguments)

    def fail(self, fault: str) -> None:
        if fault == "cut off":
            self._toggle()
        else:
            self._process.send_signal(signal.SIGKILL if fault == "killed" else signal.SIGSTOP)

    def recover(self, fault: str) -> None:
        if fault == "cut off":
            self._toggle()
        elif fault == "stopped":
            self._process.send_signal(signal.SIGCONT)
        else:
            self._process.wait()
            self._process = child(*self._arguments)

    def _toggle(self) -> None:
        if self._proxy is None:
            self._process.send_signal(signal.SIGUSR1)
        else:
            self._proxy.is_open = not self._proxy.is_open

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


class Churn:
    """Subscribers of `topic` that are killed and started again every 1.5 s, as `kill -9` does it, until closed."""

    SUBSCRIBERS, INTERVAL = 5, 1.5

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.is_set():
            subscribers = [child("subscriber", self._topic) for _ in range(self.SUBSCRIBERS)]
            self._ended.wait(self.INTERVAL)
            for each in subscribers:
                each.kill()
                each.wait()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


def child(*arguments: str) -> subprocess.Popen[bytes]:
    """A process of `deadman_sources`."""
    return subprocess.Popen([sys.executable, "-m", "benchmarks.deadman_sources", *arguments], cwd=ROOT)
