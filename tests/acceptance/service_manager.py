"""What systemd is to a router: keeps its sockets, starts it with them, hears that it is ready, and starts it again."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

from tests.acceptance.ros_peer import PATIENCE

ROOT = Path(__file__).parent.parent.parent
SO_TIMESTAMPNS = 35
SO_RCVBUFFORCE = 33
ABOVE = 20
"""Descriptors from here on are in nobody's way."""

LAUNCH = 'n=3; for fd in $FDS; do eval "exec $n<&$fd $fd<&-"; n=$((n + 1)); done; LISTEN_PID=$$ exec "$@"'


class ServiceManager:
    """`told` are the lines that the routers have sent it, all of them. Its sockets are as rover-router.socket says."""

    module = "router"

    def __init__(self, folder: Path, table: Path, *addresses: tuple[str, int], **environment: str) -> None:
        self._folder = folder
        self._table = table
        self._environment = environment
        self._log = folder / "router.log"
        self.sockets = [_held(address) for address in addresses]
        sleep(0.2)  # the kernel begins to stamp datagrams a moment after the first socket has asked for it
        self.told: list[str] = []
        self.process: subprocess.Popen[bytes] | None = None
        self._hearing = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._hearing.bind(str(folder / "notify"))
        self._hearing.settimeout(PATIENCE)

    def start(self) -> subprocess.Popen[bytes]:
        """Returns at once."""
        descriptors = [fcntl.fcntl(held, fcntl.F_DUPFD, ABOVE) for held in self.sockets]
        environment = {
            **os.environ,
            **self._environment,
            "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))),
            "NOTIFY_SOCKET": str(self._folder / "notify"),
            "FDS": " ".join(map(str, descriptors)),
            "LISTEN_FDS": str(len(descriptors)),
            "LISTEN_FDNAMES": ":".join(["rover-router.socket"] * len(descriptors)),
        }
        router = (sys.executable, "-m", self.module, "run", str(self._table))
        with self._log.open("a") as log:
            self.process = subprocess.Popen(
                ["/bin/bash", "-c", LAUNCH, "launch", *router],
                stdin=subprocess.DEVNULL,
                stderr=log,
                env=environment,
                pass_fds=descriptors,
            )
        for descriptor in descriptors:
            os.close(descriptor)
        return self.process

    def hear(self, line: str) -> None:
        """Waits until the router tells this."""
        deadline = monotonic() + PATIENCE
        while True:
            lines = self._hearing.recv(4096).decode().splitlines()
            self.told += lines
            if line in lines:
                return
            assert monotonic() < deadline, self.text()

    def end(self, number: signal.Signals) -> int:
        assert self.process is not None
        self.process.send_signal(number)
        return self.process.wait(PATIENCE)

    def text(self) -> str:
        return self._log.read_text()

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.end(signal.SIGKILL)
        self._hearing.close()
        for held in self.sockets:
            held.close()


def make_room(opened: socket.socket) -> None:
    """For 16 MiB, as systemd does; where this user may not have so much, for what he may."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 16 << 20)
    except PermissionError:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 20)


def room_of(opened: socket.socket) -> int:
    """Bytes, as they were asked for; the kernel has twice as many, for its own needs as well."""
    return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def _held(address: tuple[str, int]) -> socket.socket:
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    make_room(held)
    held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    held.bind(address)
    return held
