"""Notifications to the service manager."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from router.app.process import Watchdog, notify, reloading, supervised
from router.errors import SourceSpan

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
