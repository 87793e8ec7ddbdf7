"""Endpoints with host names: a running router whose resolver answers what the test says, late, or never."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing

import pytest
from structlog.testing import capture_logs

from router.app import Router, host_names
from router.app.host_names import HostNames
from router.clock import boottime_ns
from router.compiler import check_table
from router.net.addresses import family
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, Site, numbered, site, udp

__all__ = ["site"]

ROBOT = "127.0.0.41"
ENDPOINTS = '  robot: {{address: "Robot-3.local:{port}", kind: board, stale_after: 100ms}}\n'
ROUTES = """\
  ph_info: {source: robot, destinations: [basestation]}
  manual_drive:
    source: sensor_board
    destinations: [robot]
    deadman: {timeout: 60s, send: {manual_brake: {brake: true}}, to: [robot], repeat: 1h}
"""


class Resolver:
    """Answers like `addresses_of`; hangs while `answers` is not set."""

    def __init__(self) -> None:
        self.found: list[str] = []
        self.asked: list[str] = []
        self.answers = threading.Event()
        self.answers.set()

    def __call__(self, host: str) -> list[str]:
        self.asked.append(host)
        self.answers.wait(60)
        if not self.found:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return self.found


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Iterator[Resolver]:
    resolver = Resolver()
    monkeypatch.setattr(host_names, "addresses_of", resolver)
    monkeypatch.setattr(host_names, "_RETRY_S", 0.05)
    yield resolver
    resolver.answers.set()


@pytest.fixture
def robot() -> Iterator[socket.socket]:
    with udp(ROBOT) as opened:
        yield opened


def of(router: Router, metric: str, *labels: str) -> float:
    return router.read(boottime_ns(), (metric,)).counts(metric).get(labels, 0.0)


def is_unresolved(router: Router) -> float:
    return of(router, "endpoint_unresolved", "robot")


def program(site: Site, robot: socket.socket) -> Router:
    return Router(site.program(ROUTES, ENDPOINTS.format(port=robot.getsockname()[1])))


@pytest.mark.parametrize("hangs", [False, True])
def test_until_its_name_is_resolved_nothing_is_sent_to_an_endpoint_or_accepted_from_it(
    site: Site, resolver: Resolver, robot: socket.socket, hangs: bool
) -> None:
    if hangs:
        resolver.answers.clear()
    with capture_logs() as logged, program(site, robot) as router:
        assert is_unresolved(router) == 1
        site.send(DRIVE)
        wait_until(lambda: of(router, "messages_dropped", "manual_drive", "robot", "send_error") == 1, "the loss")
        robot.sendto(numbered(1), ("127.0.0.1", site.listen))
        wait_until(lambda: of(router, "datagrams_rejected", "rover", "source_mismatch") == 1, "the rejection")
        wait_until(lambda: len(resolver.asked) > (not hangs), "an attempt that hangs, or one that has failed")
        resolver.found = [ROBOT]
        resolver.answers.set()
        wait_until(lambda: is_unresolved(router) == 0, "the address")
        site.send(DRIVE)
        received = [robot.recv(100)]
        while received[-1] != DRIVE:
            received.append(robot.recv(100))
        assert {*received[:-1]} <= {BRAKE}
        robot.sendto(numbered(2), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(2)
    assert robot.recv(100) == BRAKE  # the last one, at the stop
    errors = [entry["error"] for entry in logged if entry.get("target") == "robot"]
    assert errors == ["the host name robot-3.local is not resolved: `getent ahosts robot-3.local`"] * len(errors) != []
    unresolved = [entry for entry in logged if entry["event"].startswith("host name not resolved")]
    assert [entry["why"] for entry in unresolved] == ([] if hangs else ["Name or service not known"])


def test_a_board_is_braked_soon_after_its_name_is_resolved(
    site: Site, resolver: Resolver, robot: socket.socket
) -> None:
    with program(site, robot):
        resolver.found = [ROBOT]
        assert robot.recv(100) == BRAKE


def test_another_address_is_followed_once_the_endpoint_is_silent(
    site: Site, resolver: Resolver, robot: socket.socket
) -> None:
    resolver.found = [ROBOT]
    port = robot.getsockname()[1]
    with program(site, robot) as router, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as moved:
        moved.bind(("127.0.0.42", port))
        moved.settimeout(10)
        wait_until(lambda: is_unresolved(router) == 0, "the address")
        robot.sendto(numbered(1), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(1)
        site.send(DRIVE)
        resolver.found = ["127.0.0.42", "127.0.0.43"]
        wait_until(lambda: router.program.table.endpoints["robot"].address.value.host == "127.0.0.42", "the move")
        site.send(DRIVE)
        wait_until(lambda: moved.recv(100) == DRIVE, "the command")
        moved.sendto(numbered(2), ("127.0.0.1", site.listen))
        assert site.basestation.recv(100) == numbered(2)
        robot.sendto(numbered(3), ("127.0.0.1", site.listen))
        wait_until(lambda: of(router, "datagrams_rejected", "rover", "source_mismatch") == 1, "the rejection")
        resolver.found = []
        assert router.reload().text == "nothing changed"
        assert router.program.table.endpoints["robot"].address.value.host == "127.0.0.42"


@pytest.mark.parametrize(("keys", "host"), [(", listener: six", "::1"), ("", ROBOT)])
def test_the_address_is_of_the_listeners_family_and_ipv4_if_both_fit(
    site: Site, resolver: Resolver, keys: str, host: str
) -> None:
    resolver.found = [ROBOT, "fe80::1", "::1"]
    listen = f'  rover: {{address: "127.0.0.1:{site.listen}"}}\n  six: {{address: "[::1]:{site.listen}"}}'
    with socket.socket(family(host), socket.SOCK_DGRAM) as robot:
        robot.bind((host, 0))
        robot.settimeout(10)
        endpoints = ENDPOINTS.format(port=robot.getsockname()[1]).replace("kind: board", f"kind: board{keys}")
        checked = check_table(site.write(ROUTES, listen=listen, endpoints=endpoints))
        assert checked.program is not None
        with Router(checked.program) as router:
            assert robot.recv(100) == BRAKE
            assert router.program.table.endpoints["robot"].address.value.host == host
            robot.sendto(numbered(1), (host if keys else "127.0.0.1", site.listen))
            assert site.basestation.recv(100) == numbered(1)


@pytest.mark.parametrize("found", ["224.0.0.1", "0.0.0.0", "127.0.0.1"])
def test_an_address_that_cannot_be_a_boards_is_refused(site: Site, resolver: Resolver, found: str) -> None:
    resolver.found = [found]
    endpoints = ENDPOINTS.format(port=site.listen)
    with capture_logs() as logged, Router(site.program(ROUTES, endpoints)) as router:
        wait_until(lambda: any(entry.get("host") == "robot-3.local" for entry in logged), "the warning")
        assert is_unresolved(router) == 1
    [entry] = [entry for entry in logged if entry.get("host") == "robot-3.local"]
    assert found in entry["why"]


def test_names_that_a_table_no_longer_has_are_not_asked_for(resolver: Resolver) -> None:
    with closing(HostNames(lambda: True, lambda _: True, lambda *_: "")) as names:
        names.follow({"one"})
        wait_until(lambda: len(resolver.asked) > 2, "the questions")
        names.follow({"two"})
        wait_until(lambda: len(resolver.asked) > 3 and {*resolver.asked[-3:]} == {"two"}, "the other name alone")
