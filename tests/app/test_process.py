"""Notifications to the service manager."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from router.app.process import notify, reloading, supervised
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


def _not_asked(*_: int) -> None:
    raise AssertionError("the watchdog is not ours")


def test_it_is_ready_inside_and_stops_at_the_end(manager: socket.socket) -> None:
    with supervised():
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
    with capture_logs() as log, supervised(), reloading():
        pass
    assert log == []


def test_a_service_manager_that_is_gone_is_told_of_in_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    with capture_logs() as log:
        notify("READY=1")
    assert [line["event"] for line in log] == ["the service manager cannot be notified"]


def test_without_a_free_descriptor_a_reload_goes_on(manager: socket.socket) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with capture_logs() as logged:
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
        try:
            with reloading():
                pass
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert [entry["error"] for entry in logged] == ["[Errno 24] Too many open files"] * 2
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        manager.recv(1000)


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


def test_native_threads_feed_the_watchdog_from_the_start_to_the_end(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    fed: list[tuple[str, int]] = []

    def feed(descriptor: int, interval: int) -> None:
        fed.append((str(Path(f"/proc/self/fd/{descriptor}").readlink()) if descriptor >= 0 else "", interval))

    with supervised(feed):
        assert said(manager) == ["READY=1"]
        [(opened, interval)] = fed
        assert (opened.startswith("socket:"), interval) == (True, 10_000_000)
    assert fed[1:] == [("", 0)]


def test_the_watchdog_of_another_process_is_not_ours(manager: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "1000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    with supervised(_not_asked):
        assert said(manager) == ["READY=1"]
    assert said(manager)[0] == "STOPPING=1"


def test_garbage_collection_goes_on_once_the_interpreter_is_tuned_although_the_start_has_paused_it() -> None:
    code = (
        "import gc; from router.app import tune_interpreter; from router.compiler.check import uncollected\n"
        "with uncollected(): tune_interpreter(); print(gc.isenabled())"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout == "True\n"
