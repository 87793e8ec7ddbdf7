"""A head start in this process, by the image of a program that was compiled here, and how a router takes it over."""

from __future__ import annotations

import marshal
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from router.app import Router
from router.app import router as whole
from router.app.plane import Plane
from router.app.runtime import Runtime
from router.carrier import events
from router.carrier.forwarding_threads import ForwardingThreads
from router.cli import run
from router.compiler.compiled_table import CompiledTable
from router.image.image import Image
from router.image.writer import write_image
from router.net.sockets import ListeningSocket, open_sending
from router.startup_image import head_start as head_starts
from router.startup_image.head_start import HeadStart, HeadStartAttempt
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, Site, site
from tests.app.test_runtime import NAN_PH, PH

__all__ = ["site"]

DRIVING = """\
  manual_drive:
    source: sensor_board
    destinations: [basestation]
    deadman: {timeout: 20ms, send: {manual_brake: {brake: true}}, to: [basestation], repeat: 1h}
"""
TRIPPED = "no commands arrive; the deadman sends in their place"
ROOT = Path(__file__).parents[2]


def head_start(program: CompiledTable) -> HeadStart:
    parts = marshal.loads(marshal.dumps(write_image(program).parts()))  # noqa: S302 - written here
    return HeadStart(Image(**parts), ())


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """What runs as `router run` blocks signals for good."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def test_a_deadman_that_trips_while_the_router_is_made_is_told_once_it_is_complete(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = site.program(DRIVING)
    started = head_start(program)
    assert site.basestation.recv(1000) == BRAKE

    class Slow(Runtime):
        def __init__(self, *arguments: object) -> None:
            site.send(DRIVE)
            assert [site.basestation.recv(1000) for _ in range(2)] == [DRIVE, BRAKE]
            time.sleep(0.1)  # for a thread that would tell it now
            super().__init__(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(whole, "Runtime", Slow)
    with capture_logs() as logged, Router(program, head_start=started):
        wait_until(lambda: TRIPPED in [entry["event"] for entry in logged], "the report")


def test_what_was_told_before_the_router_was_made_is_read_at_once(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "_PULSE_MS", 3_600_000)
    program = site.program(DRIVING)
    started = head_start(program)
    assert site.basestation.recv(1000) == BRAKE
    site.send(DRIVE)
    assert [site.basestation.recv(1000) for _ in range(2)] == [DRIVE, BRAKE]
    time.sleep(0.1)  # it is told after it was sent
    with capture_logs() as logged, Router(program, head_start=started) as router:
        wait_until(lambda: TRIPPED in [entry["event"] for entry in logged], "the report")
        assert router.total("deadman_trips") == 1


def test_what_was_lost_before_the_router_was_made_is_explained(site: Site) -> None:
    condition = "{endpoint: basestation, when: 1 / temperature > 0}"
    program = site.program(f"  ph_info: {{source: sensor_board, destinations: [{condition}]}}\n")
    started = head_start(program)
    site.send(b"\xff", NAN_PH, PH)
    assert site.basestation.recv(1000) == PH
    with capture_logs() as logged, Router(program, head_start=started):
        wait_until(
            lambda: {"datagram rejected", "message dropped"} <= {entry["event"] for entry in logged}, "the report"
        )
    details = {entry["event"]: str(entry["detail"]) for entry in logged if "detail" in entry}
    assert details["datagram rejected"].endswith("does not parse as PBEnvelope")
    assert details["message dropped"].endswith("when: division by zero")


def test_a_router_that_cannot_be_made_leaves_the_board_halted(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    program = site.program(DRIVING.replace("20ms", "1h"))
    started = head_start(program)
    assert site.basestation.recv(1000) == BRAKE
    site.send(DRIVE)
    assert site.basestation.recv(1000) == DRIVE

    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(whole, "Plane", fail)
    with pytest.raises(MemoryError), closing(HeadStartAttempt(started)) as attempt:
        run.route(program, [], os.environ, attempt)
    assert site.basestation.recv(1000) == BRAKE


def test_a_head_start_whose_threads_cannot_start_is_undone(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("no threads")

    monkeypatch.setattr(ForwardingThreads, "start", fail)
    with pytest.raises(OSError, match="no threads"):
        head_start(site.program(DRIVING.replace("20ms", "1h")))
    assert site.basestation.recv(1000) == BRAKE


def test_what_fails_before_the_verb_runs_leaves_the_board_halted(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    import router

    program = site.program(DRIVING.replace("20ms", "1h"))
    started = head_start(program)
    assert site.basestation.recv(1000) == BRAKE
    site.send(DRIVE)
    assert site.basestation.recv(1000) == DRIVE
    monkeypatch.setattr(head_starts, "begin", lambda: HeadStartAttempt(started))
    monkeypatch.setattr(sys, "argv", ["router", "run"])
    monkeypatch.setitem(sys.modules, "router.cli", None)
    with pytest.raises(ImportError):
        router.main()
    assert site.basestation.recv(1000) == BRAKE


def test_sockets_of_a_head_start_are_no_standard_streams() -> None:
    script = """\
import os, sys
from router.startup_image import head_start
def begin():
    os.write(1, os.readlink("/proc/self/fd/2").encode())
    raise KeyboardInterrupt
head_start.begin = begin
sys.argv = ["router", "run"]
import router
sys.exit(router.main())
"""
    command = ["sh", "-c", f"exec {sys.executable} -c '{script.replace(chr(39), '')}' 2>&-"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, os.devnull)


def test_a_socket_that_a_head_start_sends_by_is_closed_once_no_thread_uses_it(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = site.program(DRIVING)

    def open_elsewhere(
        source: ListeningSocket | None, every: Collection[ListeningSocket] = (), **settings: Any
    ) -> socket.socket:
        if source is not None:
            raise OSError("the port of the listener cannot be shared")
        return open_sending(None, every, **settings)

    monkeypatch.setattr(head_starts, "open_sending", open_elsewhere)
    started = head_start(program)
    left, was_open = started.senders["basestation"][1].socket, []

    class Observed(Plane):
        def wait_until_adopted(self) -> bool:
            was_open.append(left.fileno() >= 0)
            return super().wait_until_adopted()

    monkeypatch.setattr(whole, "Plane", Observed)
    with Router(program, head_start=started):
        assert (was_open, left.fileno()) == ([True], -1)


def test_topics_of_a_head_start_are_bound_once(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """While messages of the head start wait, a reload that fails closes the publishers that it has opened."""
    pytest.importorskip("rclpy", reason="needs ROS 2")
    topic = """\
  ph_info:
    source: sensor_board
    topics:
      - {topic: ph, type: comms/msg/SensorBoardPHInfo, queue_depth: 10, fields: auto}
"""
    program = site.program(topic)
    started = head_start(program)
    bound: list[object] = []
    monkeypatch.setattr(started.image, "bind_topics", bound.append)
    with Router(program, head_start=started) as router:
        site.write(topic.replace("queue_depth: 10", "queue_depth: 11"))
        assert router.reload().ok
    assert len(bound) == 1
