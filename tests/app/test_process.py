"""What the service manager is told, and which of its sockets a listener takes."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from router.app.process import Watchdog, notify, reloading, supervised
from router.clock import wall_ns
from router.errors import Located, SourceSpan
from router.net import udp
from router.net.udp import Inherited, Listener
from router.table import model
from router.table.addresses import Address
from router.table.model import Framing

SPAN = SourceSpan("routes/rover.yaml", 12, 20, 34)
SO_TIMESTAMPNS = 35


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def manager(tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> socket.socket:
    """The service manager's ear."""
    ear = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    ear.bind(str(tmp_path / "notify"))
    ear.settimeout(5)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    return ear


def said(manager: socket.socket) -> list[str]:
    return manager.recv(1000).decode().splitlines()


def test_it_is_ready_inside_and_stops_at_the_end(manager: socket.socket) -> None:
    with supervised(lambda: 0):
        assert said(manager) == ["READY=1"]
    assert said(manager)[0] == "STOPPING=1"


def test_a_reload_is_told_with_its_time_and_its_end(manager: socket.socket) -> None:
    with reloading():
        word, time = said(manager)
        assert word == "RELOADING=1"
        assert time.startswith("MONOTONIC_USEC=")
    assert said(manager) == ["READY=1"]


def test_an_abstract_socket_is_one_too(stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    ear = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
    ear.bind(f"\0rover-router-test-{os.getpid()}")
    ear.settimeout(5)
    monkeypatch.setenv("NOTIFY_SOCKET", f"@rover-router-test-{os.getpid()}")
    notify("READY=1")
    assert said(ear) == ["READY=1"]


def test_without_a_service_manager_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    with capture_logs() as log, supervised(lambda: 0), reloading():
        pass
    assert log == []


def test_a_service_manager_that_is_gone_is_told_of_in_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    with capture_logs() as log:
        notify("READY=1")
    assert [line["event"] for line in log] == ["the service manager cannot be notified"]


def test_a_service_manager_that_does_not_listen_holds_nobody_up(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.app.process.NOTIFY_TIMEOUT", 0.05)
    with capture_logs() as logged:
        for _ in range(1000):
            if logged:
                break
            notify("READY=1")
    assert [entry["event"] for entry in logged] == ["the service manager cannot be notified"]


def test_the_watchdog_is_fed_only_while_there_is_progress(manager: socket.socket) -> None:
    reached = 7
    watchdog = Watchdog(lambda: reached, 100, now=1000)
    assert watchdog.next_due == 1100
    watchdog.due(1100)
    assert said(manager) == ["WATCHDOG=1"]
    watchdog.due(1200)
    watchdog.due(1300)
    reached = 8
    watchdog.due(1450)
    assert said(manager) == ["WATCHDOG=1"]
    assert watchdog.next_due == 1550
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        said(manager)


def test_the_watchdog_is_fed_from_the_start_to_the_end(manager: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    numbers = iter(range(1_000_000))
    with supervised(lambda: next(numbers)):
        assert [said(manager) for _ in range(3)] == [["READY=1"], ["WATCHDOG=1"], ["WATCHDOG=1"]]


def test_the_watchdog_of_another_process_is_not_ours(manager: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "1000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    with supervised(lambda: 1):
        assert said(manager) == ["READY=1"]
    assert said(manager)[0] == "STOPPING=1"


# -- inherited sockets ---------------------------------------------------------------------------------------------


@pytest.fixture
def held(stack: ExitStack) -> socket.socket:
    """The service manager's."""
    held = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    held.bind(("127.0.0.1", 0))
    return held


def plan(held: socket.socket) -> model.Listener:
    return model.Listener(
        "rover", SPAN, Located(Address(*held.getsockname()), SPAN), Framing.EXACT, receive_buffer=65536, coalesce=0
    )


@pytest.fixture
def listener(held: socket.socket, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> Listener:
    ours = Inherited([held.dup()])
    monkeypatch.setattr(udp, "inherited", lambda: ours)
    return stack.enter_context(closing(Listener(plan(held))))


def test_a_listener_takes_the_socket_that_has_its_address(held: socket.socket, listener: Listener) -> None:
    assert listener.is_inherited
    before = wall_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        board.sendto(b"hello", held.getsockname())
    assert listener.socket.recvfrom(100)[0] == b"hello"
    assert before <= listener.arrived_at() <= wall_ns()


def test_the_next_one_finds_what_the_last_one_left(held: socket.socket, listener: Listener) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        for word in (b"first", b"second"):
            board.sendto(word, held.getsockname())
    assert listener.socket.recv(100) == b"first"
    listener.end_input()
    listener.close()
    with closing(Listener(plan(held))) as successor:
        assert successor.socket.recv(100) == b"second"


def test_its_buffer_is_never_made_smaller(held: socket.socket, listener: Listener) -> None:
    before = held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    assert before > 2 * 65536
    assert listener.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before
    listener.follow(replace(plan(held), receive_buffer=32768))  # as a reload asks for
    assert held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before


def test_a_socket_is_taken_for_its_interface_only(stack: ExitStack) -> None:
    bound = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
    bound.bind(("127.0.0.1", 0))
    address = Address(*bound.getsockname())
    ours = Inherited([bound.dup()])
    assert ours.take(str(address)) is None
    assert ours.take(f"{address} on eth0") is None
    assert ours.unclaimed() == [f"{address} on lo"]
    stack.enter_context(ours.take(f"{address} on lo") or pytest.fail("it is there"))
    assert ours.unclaimed() == []


def test_what_nobody_takes_is_told(held: socket.socket, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
    stream = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
    stream.bind(("127.0.0.1", 0))
    address = Address(*held.getsockname())
    ours = Inherited([held.dup(), stream.dup()])
    assert len(ours.unclaimed()) == 2
    stack.enter_context(ours.take(str(address)) or pytest.fail("it is there"))
    [left] = ours.unclaimed()
    assert left.endswith("which is no IPv4 UDP socket")
    assert ours.take(str(address._replace(port=1))) is None
    assert ours.take(f"{address} on lo") is None


def test_what_is_meant_for_another_process_is_left_alone() -> None:
    environment = {"LISTEN_PID": "1", "LISTEN_FDS": "3", "LISTEN_FDNAMES": "a:b:c"}
    assert udp._inherited_descriptors(environment) == []
    assert environment == {}
