"""What is found after the loop was away counts as arrived when it was last there."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from router.clock import wall_ns
from router.errors import Located, SourceSpan
from router.gateway.transport import arrival as gateway_arrival
from router.gateway.transport.arrival import AWAY_NS, CATCH_UP_NS, LoopClock
from router.gateway.transport.base import Transport
from router.gateway.transport.stream import Limits, StreamTransport
from router.gateway.transport.tcp import TcpTransport
from router.gateway.transport.websocket import WebsocketTransport
from router.gateway.transport.zenoh import ZenohTransport
from router.table.addresses import Address
from router.table.model import ZenohSettings
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.transport_events import Events, opened
from tests.ports import free_port

ANY = Address("127.0.0.1", 0)
LIMITS = Limits(10, 10, 1000)
GREETING = (
    b"GET / HTTP/1.1\r\nHost: rover\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
MASKED = b"\x82\x84" + bytes(4) + b"stop"
"""One websocket message."""


def away() -> None:
    """Keeps the loop for longer than it may be kept."""
    time.sleep(2 * AWAY_NS / 1e9)


class Now:
    """A clock that goes as it is told."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def __call__(self) -> int:
        return self.ns


@contextmanager
def started(now: Now) -> Iterator[LoopClock]:
    """Its own ticks come as real time goes by, which it does not here."""
    clock = LoopClock(now)
    assert clock.away_since() is None
    clock.start()
    yield clock
    clock.stop()
    now.ns += 10 * AWAY_NS
    assert clock.away_since() is None


@asynchronous
async def test_a_loop_that_is_there_finds_what_has_just_come() -> None:
    now = Now()
    with started(now) as clock:
        for _ in range(10):
            now.ns += AWAY_NS
            assert clock.away_since() is None
            clock.tick()


@asynchronous
async def test_what_is_found_after_it_was_away_may_be_as_old_as_that_and_for_a_while_after() -> None:
    now = Now()
    with started(now) as clock:
        left = now.ns
        now.ns += AWAY_NS + 1
        assert clock.away_since() == left
        clock.tick()
        back = now.ns
        for _ in range(CATCH_UP_NS // AWAY_NS):
            assert clock.away_since() == left
            now.ns += AWAY_NS
            clock.tick()
        now.ns = max(now.ns, back + CATCH_UP_NS)
        assert clock.away_since() is None


@asynchronous
async def test_a_stamp_is_of_the_wall_clock() -> None:
    now = Now()
    before = wall_ns()
    with started(now) as clock:
        assert before <= clock.stamp() <= wall_ns()
        now.ns += 5_000_000_000
        assert before - 5_000_000_000 <= clock.stamp() <= wall_ns() - 5_000_000_000


def tcp(events: Events) -> TcpTransport:
    return TcpTransport(ANY, events, LIMITS, prefixed=False)


def websocket(events: Events) -> WebsocketTransport:
    return WebsocketTransport(ANY, events, LIMITS, text=False, page=b"")


def dial(transport: Transport) -> socket.socket:
    assert transport.address is not None
    return socket.create_connection(transport.address)


@pytest.mark.parametrize(
    ("make", "greeting", "one"), [(tcp, b"", b"stop\n"), (websocket, GREETING, MASKED)], ids=["tcp", "websocket"]
)
class TestStreams:
    @asynchronous
    async def test_all_that_waited_while_the_loop_was_away_is_as_old_as_that(
        self, make: type[StreamTransport], greeting: bytes, one: bytes
    ) -> None:
        """More than is handled in one turn."""
        count = 100
        events = Events()
        transport = make(events)  # type: ignore[call-arg,arg-type]
        async with opened(transport):
            with dial(transport) as peer:
                peer.sendall(greeting)
                await until(lambda: events.clients)
                peer.sendall(one * count)
                left = wall_ns()
                away()
                await until(lambda: len(events.said) == count)
                assert max(events.arrivals) <= left

    @asynchronous
    async def test_so_is_what_a_client_said_that_came_meanwhile(
        self, make: type[StreamTransport], greeting: bytes, one: bytes
    ) -> None:
        events = Events()
        transport = make(events)  # type: ignore[call-arg,arg-type]
        async with opened(transport):
            with dial(transport) as peer:
                peer.sendall(greeting + one)
                connected = wall_ns()
                away()
                await until(lambda: events.said)
                assert events.arrivals[0] <= connected + 20_000_000  # the kernel's measure is that coarse

    @asynchronous
    async def test_what_comes_while_the_loop_is_there_has_just_come(
        self, monkeypatch: pytest.MonkeyPatch, make: type[StreamTransport], greeting: bytes, one: bytes
    ) -> None:
        monkeypatch.setattr(gateway_arrival, "AWAY_NS", 10**12)
        events = Events()
        transport = make(events)  # type: ignore[call-arg,arg-type]
        async with opened(transport):
            with dial(transport) as peer:
                peer.sendall(greeting)
                await until(lambda: events.clients)
                sent = wall_ns()
                peer.sendall(one)
                await until(lambda: events.said)
                assert sent <= events.arrivals[0] <= wall_ns()


@asynchronous
async def test_what_zenoh_hears_while_the_loop_is_away_is_as_old_as_that() -> None:
    where = f"tcp/127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    key = Located("rovers/loki_1", SourceSpan("routes/rover.yaml"))
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([where]))
    config.insert_json5("scouting/multicast/enabled", "false")
    events = Events()
    async with opened(ZenohTransport(ZenohSettings(key, "peer", (), (where,)), events, 1000)):
        with zenoh.open(config) as far:

            def put() -> None:
                far.put(f"{key.value}/inbound/cmd_vel", b"stop")

            await until(lambda: put() or events.said)  # type: ignore[func-returns-value]
            await asyncio.sleep(0.3)
            events.arrivals.clear()
            left = wall_ns()
            late = threading.Timer(2 * AWAY_NS / 1e9, put)
            late.start()
            time.sleep(6 * AWAY_NS / 1e9)
            await until(lambda: events.arrivals)
            assert events.arrivals[-1] <= left
            late.join()
