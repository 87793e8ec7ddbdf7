"""Recorded events and shared helpers for tests of the gateway's transports."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from router.gateway.transport.base import Client, Frame, Transport
from tests.gateway.asynchronous import until


def data(payload: bytes, topic: str = "/imu", type_name: str = "T") -> Frame:
    return Frame(payload, topic, type_name, is_schema=False)


@dataclass
class Events:
    """Records clients that connect and disconnect, in order, and their messages."""

    clients: list[Client] = field(default_factory=list)
    gone: list[Client] = field(default_factory=list)
    eased: list[Client] = field(default_factory=list)
    said: list[bytes] = field(default_factory=list)
    said_by: list[Client] = field(default_factory=list)
    arrivals: list[int] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    failures: list[tuple[Client | None, Exception, int]] = field(default_factory=list)
    shown: list[Frame] = field(default_factory=list)
    contentions: int = 0
    connections: list[int] = field(default_factory=list)
    on_drained: Callable[[Client], None] | None = None

    def joined(self, client: Client) -> None:
        self.clients.append(client)

    def left(self, client: Client) -> None:
        self.clients.remove(client)
        self.gone.append(client)

    def drained(self, client: Client) -> None:
        self.eased.append(client)
        if self.on_drained is not None:
            self.on_drained(client)

    def received(self, client: Client, data: bytes, arrived_ns: int) -> None:
        assert type(data) is bytes
        assert arrived_ns > 1_600_000_000_000_000_000
        self.said.append(data)
        self.said_by.append(client)
        self.arrivals.append(arrived_ns)

    def refused(self, reason: str) -> None:
        self.refusals.append(reason)

    def failed(self, client: Client | None, error: Exception, lost: int) -> None:
        self.failures.append((client, error, lost))

    def contended(self) -> None:
        self.contentions += 1

    def connected(self, number: int) -> None:
        self.connections.append(number)

    async def snapshot(self) -> Sequence[Frame]:
        return self.shown


@asynccontextmanager
async def opened(transport: Transport) -> AsyncIterator[None]:
    """Open a transport. Check that it leaves no task, thread or socket behind."""
    tasks, threads, sockets = asyncio.all_tasks(), _threads(), _sockets()
    await transport.open()
    try:
        yield
    finally:
        await transport.close()
    await until(lambda: asyncio.all_tasks() <= tasks)
    await until(lambda: _threads() <= threads)
    await until(lambda: _sockets() <= sockets)


def _threads() -> set[threading.Thread]:
    """All threads except those of asyncio's executor, which tests use."""
    return {thread for thread in threading.enumerate() if not thread.name.startswith("asyncio")}


def _sockets() -> int:
    """The number of open sockets. Zenoh keeps descriptors of other kinds for its threads."""
    count = 0
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # the descriptor of this listing
            count += str(descriptor.readlink()).startswith("socket:")
    return count


def resident_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024
