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
from router.gateway.transport.zenoh import ZenohTransport
from router.table.model.gateways import ZenohSettings
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stream_peers import GREETING, KINDS, framed, join, served
from tests.gateway.transport_events import Events, opened
from tests.ports import free_port


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
    assert clock.delay() == 0
    clock.start()
    yield clock
    clock.stop()
    now.ns += 10 * AWAY_NS
    assert clock.delay() == 0


@asynchronous
async def test_a_loop_that_is_there_finds_what_has_just_come() -> None:
    now = Now()
    with started(now) as clock:
        for _ in range(10):
            now.ns += AWAY_NS
            assert clock.delay() == 0
            clock.tick()


@asynchronous
async def test_what_is_found_after_it_was_away_may_be_as_old_as_that_and_for_a_while_after() -> None:
    now = Now()
    with started(now) as clock:
        left = now.ns
        now.ns += AWAY_NS + 1
        assert clock.delay() == now.ns - left
        clock.tick()
        back = now.ns
        for _ in range(CATCH_UP_NS // AWAY_NS):
            assert clock.delay() == now.ns - left
            now.ns += AWAY_NS
            clock.tick()
        now.ns = max(now.ns, back + CATCH_UP_NS)
        assert clock.delay() == 0


@asynchronous
async def test_a_stamp_is_of_the_wall_clock() -> None:
    now = Now()
    before = wall_ns()
    with started(now) as clock:
        assert before <= clock.stamp() <= wall_ns()
        now.ns += 5_000_000_000
        assert before - 5_000_000_000 <= clock.stamp() <= wall_ns() - 5_000_000_000


GREETINGS = {"packets": b"", "lines": b"", "websocket": GREETING}


@pytest.mark.parametrize("kind", KINDS)
class TestStreams:
    @asynchronous
    async def test_all_that_waited_while_the_loop_was_away_is_as_old_as_that(self, kind: str) -> None:
        """More than is handled in one turn."""
        async with served(kind) as (transport, events):
            peer = await join(kind, transport)
            await until(lambda: events.clients)
            peer.writer.write(framed(kind, *[b"stop"] * 100))
            left = wall_ns()
            away()
            await until(lambda: len(events.said) == 100)
            assert max(events.arrivals) <= left
            peer.leave()

    @asynchronous
    async def test_so_is_what_a_client_said_that_came_meanwhile(self, kind: str) -> None:
        async with served(kind) as (transport, events):
            assert transport.address is not None
            with socket.create_connection(transport.address) as peer:
                peer.sendall(GREETINGS[kind] + framed(kind, b"stop"))
                connected = wall_ns()
                away()
                await until(lambda: events.said)
                assert events.arrivals[0] <= connected + 20_000_000  # the kernel's measure is that coarse

    @asynchronous
    async def test_the_clock_rests_without_clients(self, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
        ticks: list[LoopClock] = []

        def tick(clock: LoopClock) -> None:
            ticks.append(clock)

        monkeypatch.setattr(LoopClock, "tick", tick)
        async with served(kind) as (transport, events):
            await asyncio.sleep(3 * gateway_arrival.TICK_SECONDS)
            assert ticks == []
            one, other = await join(kind, transport), await join(kind, transport)
            await until(lambda: len(events.clients) == 2 and ticks)
            one.leave()
            await until(lambda: len(events.clients) == 1)
            before = len(ticks)
            await until(lambda: len(ticks) > before)
            other.leave()
            await until(lambda: not events.clients)
            await asyncio.sleep(gateway_arrival.TICK_SECONDS)
            before = len(ticks)
            await asyncio.sleep(3 * gateway_arrival.TICK_SECONDS)
            assert len(ticks) == before

    @asynchronous
    async def test_what_comes_while_the_loop_is_there_has_just_come(
        self, monkeypatch: pytest.MonkeyPatch, kind: str
    ) -> None:
        monkeypatch.setattr(gateway_arrival, "AWAY_NS", 10**12)
        async with served(kind) as (transport, events):
            peer = await join(kind, transport)
            sent = wall_ns()
            await peer.say(b"go")
            await until(lambda: events.said)
            assert sent <= events.arrivals[0] <= wall_ns()
            peer.leave()


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

            def put(what: bytes) -> None:
                far.put(f"{key.value}/inbound/cmd_vel", what)

            await until(lambda: put(b"go") or events.said)  # type: ignore[func-returns-value]
            await asyncio.sleep(0.3)
            left = wall_ns()
            late = threading.Timer(2 * AWAY_NS / 1e9, put, [b"stop"])
            late.start()
            time.sleep(6 * AWAY_NS / 1e9)
            await until(lambda: events.said[-1] == b"stop")
            assert events.arrivals[-1] <= left
            late.join()
