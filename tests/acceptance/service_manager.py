"""A stand-in for systemd: holds sockets, starts the router with them, waits for READY, and restarts it."""

from __future__ import annotations

import fcntl
import os
import signal
import socket
import subprocess
from pathlib import Path
from time import monotonic, sleep

from tests.acceptance.ros_peer import PATIENCE
from tests.routers import start

SO_TIMESTAMPNS = 35
SO_RCVBUFFORCE = 33
ABOVE = 20
"""First descriptor that nothing else uses."""

LAUNCH = 'n=3; for fd in $FDS; do eval "exec $n<&$fd $fd<&-"; n=$((n + 1)); done; LISTEN_PID=$$ exec "$@"'


class ServiceManager:
    """`told` has all notifications of the routers. The sockets have the options of rover-router.socket.

    Without `stamps`, the kernel does not note when datagrams arrive, as for a socket unit without Timestamping=.
    """

    module = "router"

    def __init__(
        self, folder: Path, table: Path, *addresses: tuple[str, int], stamps: bool = True, **environment: str
    ) -> None:
        self._folder = folder
        self._table = table
        self._environment = environment
        self._log = folder / "router.log"
        self.sockets = [_held(address, stamps=stamps) for address in addresses]
        sleep(0.2)  # the kernel starts to timestamp datagrams a moment after the first socket requests it
        self.told: list[str] = []
        self.process: subprocess.Popen[bytes] | None = None
        self._hearing = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._hearing.bind(str(folder / "notify"))
        self._hearing.settimeout(PATIENCE)

    def start(self) -> subprocess.Popen[bytes]:
        """Start the router without waiting."""
        descriptors = [fcntl.fcntl(held, fcntl.F_DUPFD, ABOVE) for held in self.sockets]
        environment = {
            **self._environment,
            "NOTIFY_SOCKET": str(self._folder / "notify"),
            "FDS": " ".join(map(str, descriptors)),
            "LISTEN_FDS": str(len(descriptors)),
            "LISTEN_FDNAMES": ":".join(["rover-router.socket"] * len(descriptors)),
        }
        with self._log.open("a") as log:
            self.process = start(
                ("-m", self.module),
                "run",
                self._table,
                within=("/bin/bash", "-c", LAUNCH, "launch"),
                environment=environment,
                stdin=subprocess.DEVNULL,
                stdout=None,
                stderr=log,
                pass_fds=descriptors,
            )
        for descriptor in descriptors:
            os.close(descriptor)
        return self.process

    def hear(self, line: str) -> None:
        """Wait for this notification of the router."""
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
    """Set a receive buffer of 16 MiB, as systemd does, or the largest that this user may set."""
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 16 << 20)
    except PermissionError:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 20)


def room_of(opened: socket.socket) -> int:
    """The requested size of the receive buffer in bytes; the kernel reports twice that, with its overhead."""
    return opened.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def _held(address: tuple[str, int], *, stamps: bool) -> socket.socket:
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    make_room(held)
    held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamps)
    held.bind(address)
    return held
