"""Two gateways under one key: processes of their own, with a Zenoh router between them on the loopback interface."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest
import zenoh

from router.gateway.transport.zenoh_session import Owner, owner_of
from tests.gateway.asynchronous import PATIENCE_SECONDS
from tests.gateway.test_zenoh import locator, session
from tests.gateway.zenoh_gateway import Gateway

NUMBERS = itertools.count()
Start = Callable[..., Gateway]


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


@pytest.fixture
def key() -> str:
    """One of this test, in which nobody is left of the test before."""
    return f"rovers/loki_{next(NUMBERS)}"


@pytest.fixture(scope="module")
def where() -> Iterator[str]:
    """Where a Zenoh router is."""
    place = locator()
    with session("router", listen=place):
        yield place


@pytest.fixture
def gateway(key: str, where: str) -> Iterator[Start]:
    """Starts `Gateway(key, where)`, or at another place, and opens it."""
    with ExitStack() as started:

        def start(place: str = where, mode: str = "client", **config: object) -> Gateway:
            gateway = started.enter_context(closing(Gateway(key, place, config, mode)))
            until(lambda: gateway.is_up)
            gateway.open()
            return gateway

        yield start


def test_the_second_tells_who_has_the_key_and_waits_until_it_is_free(gateway: Start) -> None:
    first = gateway()
    until(lambda: first.is_ready)
    second = gateway()
    until(lambda: second.waits)
    assert second.contentions == 1
    assert f"pid {first.process.pid} on {socket.gethostname()}, since 20" in second.others[0]
    time.sleep(0.3)
    assert second.waits
    first.kill()
    until(lambda: second.is_ready)
    third = gateway()
    until(lambda: third.waits)
    assert f"pid {second.process.pid} " in third.others[0]
    assert second.is_ready
    assert (second.contentions, third.contentions) == (1, 1)


@pytest.mark.parametrize("number", [0, *(pytest.param(again, marks=pytest.mark.slow) for again in range(1, 3))])
def test_of_several_that_start_at_once_exactly_one_serves(key: str, where: str, number: int) -> None:
    with ExitStack() as started:
        rivals = [started.enter_context(closing(Gateway(key, where))) for _ in range(3)]
        until(lambda: all(rival.is_up for rival in rivals))
        for rival in rivals:
            rival.open()
        while rivals:
            until(lambda: sum(rival.is_ready for rival in rivals) == 1)
            until(lambda: sum(rival.waits for rival in rivals) == len(rivals) - 1)
            time.sleep(0.3)
            [winner] = [rival for rival in rivals if rival.is_ready]
            assert all(rival.waits for rival in rivals if rival is not winner)
            rivals.remove(winner)
            winner.kill()


@pytest.mark.slow
def test_one_that_stands_still_has_the_key_until_its_lease_ends(gateway: Start) -> None:
    first = gateway(transport={"link": {"tx": {"lease": 1000}}})
    until(lambda: first.is_ready)
    second = gateway()
    until(lambda: second.waits)
    os.kill(first.process.pid, signal.SIGSTOP)
    until(lambda: second.is_ready)
    os.kill(first.process.pid, signal.SIGCONT)  # it came first, and is there again
    until(lambda: second.waits)
    until(lambda: first.is_ready)


def test_when_a_link_comes_back_the_one_that_took_the_key_later_gives_it_up(gateway: Start, where: str) -> None:
    first = gateway()
    until(lambda: first.is_ready)
    with bridge(where) as between:
        second = gateway(between.place)
        until(lambda: second.waits)
        between.cut()
        until(lambda: second.is_ready)
        assert first.is_ready
        between.mend()
        until(lambda: second.waits)
        assert first.is_ready
        until(lambda: second.contentions == 2)
        assert f"pid {first.process.pid} " in second.others[1]


@pytest.mark.slow
def test_peers_that_are_connected_directly_agree_as_well(gateway: Start) -> None:
    place = locator()
    first = gateway(place, "listening")
    until(lambda: first.is_ready)
    second = gateway(place, "peer")
    until(lambda: second.waits)
    assert first.is_ready
    first.kill()
    until(lambda: second.is_ready)
    again = gateway(place, "listening")  # finds nobody until the other one has connected again
    until(lambda: again.waits)
    assert second.is_ready


def test_what_is_no_token_of_a_gateway_takes_no_key(gateway: Start, key: str, where: str) -> None:
    with session("client", connect=where) as stranger:
        for name in ("owner/now/a/b/1", "owner/1", "owner/12345678901234567890/a/b/1", "data/1/a/b/1"):
            stranger.liveliness().declare_token(f"{key}/{name}")
        stranger.liveliness().declare_token(f"{key}_2/owner/1/a/b/1")
        first = gateway()
        until(lambda: first.is_ready)
        assert first.contentions == 0


def test_a_token_says_who_declared_it(key: str) -> None:
    owner = Owner(1_763_805_301_000_000_001, "8092df", "rover-1", "4711")
    assert owner_of(owner.token(key)) == owner
    assert str(owner) == "pid 4711 on rover-1, since 2025-11-22T09:55:01Z, session 8092df"
    assert zenoh.KeyExpr(owner.token(key))


class Bridge:
    """A TCP connection to `where` through `place`, which can be cut."""

    def __init__(self, where: str) -> None:
        self._there = ("127.0.0.1", int(where.rpartition(":")[2]))
        self._server = socket.create_server(("127.0.0.1", 0))
        self._opened: list[socket.socket] = []
        self._is_cut = False
        self.place = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._is_cut = True
        for each in self._opened:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def mend(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        self._server.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                here = self._server.accept()[0]
                if self._is_cut:
                    here.close()
                    continue
                there = socket.create_connection(self._there)
                self._opened += [here, there]
                for ends in ((here, there), (there, here)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
        for each in (source, sink):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


@contextmanager
def bridge(where: str) -> Iterator[Bridge]:
    with closing(Bridge(where)) as opened:
        yield opened
