"""Endpoints whose address is learned: a running router, and senders that come, go silent and take over."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from structlog.testing import capture_logs

from router.app import Router
from router.clock import boottime_ns
from router.observe.problems import Kind
from router.observe.watch import Watch
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, Site, numbered, site, udp

__all__ = ["site"]

ENDPOINTS = """\
  robot: {address: learned, kind: board, stale_after: 500ms, networks: [127.0.0.40/29], because: a test}
"""
ROUTES = """\
  ph_info: {source: robot, destinations: [basestation]}
  manual_drive:
    source: sensor_board
    destinations: [robot]
    deadman: {timeout: 60s, send: {manual_brake: {brake: true}}, to: [robot], repeat: 1h}
"""
UNLEARNED = "its address is not learned: nobody has sent a message for a route with this source"


@pytest.fixture
def robots() -> Iterator[list[socket.socket]]:
    with ExitStack() as opened:
        yield [opened.enter_context(udp(host)) for host in ("127.0.0.41", "127.0.0.42", "127.0.0.50")]


def of(router: Router, metric: str, *labels: str) -> float:
    return router.read(boottime_ns(), (metric,)).counts(metric).get(labels, 0.0)


def place(opened: socket.socket) -> str:
    return "{}:{}".format(*opened.getsockname())


def learned(router: Router) -> list[str]:
    return [address for _, address in router.read(boottime_ns(), ("endpoint_learned",)).counts("endpoint_learned")]


def commands(robot: socket.socket) -> list[bytes]:
    """Return what has come, without the brakes of the start."""
    robot.setblocking(False)
    found = []
    try:
        while True:
            found.append(robot.recv(100))
    except BlockingIOError:
        return [each for each in found if each != BRAKE]


def drive(site: Site, router: Router, robot: socket.socket) -> None:
    """Send a command, and receive it."""
    site.send(DRIVE)
    wait_until(lambda: commands(robot) == [DRIVE], f"the command for {place(robot)}; {router.mismatches()}")


def test_the_first_sender_gets_commands_and_the_brake_until_it_is_stale(
    site: Site, robots: list[socket.socket]
) -> None:
    one, two, outside = robots
    with capture_logs() as logged, Router(site.program(ROUTES, ENDPOINTS)) as router:
        site.send(DRIVE)
        wait_until(lambda: of(router, "messages_dropped", "manual_drive", "robot", "send_error") == 1, "the loss")
        assert learned(router) == []
        outside.sendto(numbered(0), ("127.0.0.1", site.listen))
        wait_until(lambda: of(router, "datagrams_rejected", "rover", "source_mismatch") == 1, "the rejection")
        one.sendto(numbered(1), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(1)
        assert learned(router) == [place(one)]
        drive(site, router, one)
        two.sendto(numbered(2), ("127.0.0.1", site.listen))
        wait_until(lambda: of(router, "datagrams_rejected", "rover", "source_mismatch") == 2, "the second rejection")

        def takes_over() -> bool:
            two.sendto(numbered(3), ("127.0.0.1", site.listen))
            return learned(router) == [place(two)]

        wait_until(takes_over, "the other sender")
        assert site.basestation.recv(100) == numbered(3)
        drive(site, router, two)
        assert not commands(one)
        assert router.reload().text == "nothing changed"
        assert learned(router) == [place(two)]
        drive(site, router, two)
    two.setblocking(True)
    assert two.recv(100) == BRAKE  # the last one, at the stop
    told = [entry for entry in logged if entry.get("endpoint") == "robot" and "learned" in entry["event"]]
    assert [(entry["event"], entry["address"]) for entry in told] == [
        ("address learned", place(one)),
        ("another address was learned", place(two)),
    ]
    assert UNLEARNED in {entry.get("error") for entry in logged}


def test_a_board_is_braked_soon_after_its_address_is_learned(site: Site, robots: list[socket.socket]) -> None:
    with Router(site.program(ROUTES, ENDPOINTS)):
        robots[0].sendto(numbered(1), ("127.0.0.1", site.listen))
        assert robots[0].recv(100) == BRAKE


def test_a_reload_that_excludes_the_address_forgets_it(site: Site, robots: list[socket.socket]) -> None:
    one, _, outside = robots
    with capture_logs() as logged, Router(site.program(ROUTES, ENDPOINTS)) as router:
        one.sendto(numbered(1), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(1)
        site.write(ROUTES, endpoints=ENDPOINTS.replace("kind: board", "kind: tool"))
        assert router.reload().ok
        drive(site, router, one)
        site.write(ROUTES, endpoints=ENDPOINTS.replace("40/29", "48/29"))
        assert router.reload().ok
        assert learned(router) == []
        outside.sendto(numbered(2), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(2)
        drive(site, router, outside)
        site.write(ROUTES, endpoints=f"{ENDPOINTS}  other: {{address: '{place(outside)}', kind: tool}}\n")
        assert router.reload().ok
        assert learned(router) == []
    told = [entry.get("before") for entry in logged if "excludes the address" in entry["event"]]
    assert told == [place(one), place(outside)]


def test_a_restart_forgets(site: Site, robots: list[socket.socket]) -> None:
    for robot in robots[:2]:
        with Router(site.program(ROUTES, ENDPOINTS)) as router:
            robot.sendto(numbered(1), ("127.0.0.1", site.listen))
            assert site.basestation.recv(100) == numbered(1)
            assert learned(router) == [place(robot)]


def test_who_is_not_learned_is_named_with_what_to_do(site: Site, robots: list[socket.socket]) -> None:
    one, two, _ = robots
    endpoints = ENDPOINTS.replace("500ms", "5s")
    with Router(site.program(ROUTES, endpoints)) as router:
        watch = Watch(router)
        watch.look(boottime_ns())
        site.send(DRIVE)
        wait_until(lambda: of(router, "messages_dropped", "manual_drive", "robot", "send_error") == 1, "the loss")
        lost = next(each for each in watch.look(boottime_ns()).problems if each.kind is Kind.COMMANDS_DROPPED)
        assert lost.remedy.startswith("It gets nothing before it sends:")
        one.sendto(numbered(1), ("127.0.0.1", site.listen))
        two.sendto(numbered(2), ("127.0.0.1", site.listen))
        wait_until(lambda: len(router.mismatches()) == 1, "the rejection")
        now = watch.look(boottime_ns())
        [rejected] = [each for each in now.problems if each.kind is Kind.DATAGRAMS_REJECTED]
        assert rejected.more.endswith("127.0.0.42 sends messages expected from robot (127.0.0.41)")
        assert now.learned == {"robot": place(one)}
        silent = watch.look(boottime_ns() + 6 * 10**9)
        kind, labels = Kind.ENDPOINT_SILENT, {"endpoint": "robot", "sender": "127.0.0.42"}
        [excluded] = [each for each in silent.problems if each.kind is kind and each.labels == labels]
        assert excluded.remedy.startswith("If 127.0.0.42 is robot, its port, network or listener is another one")
