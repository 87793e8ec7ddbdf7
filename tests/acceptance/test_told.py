"""What an operator is told while a link is lost, an address is wrong, or a board sends what no route accepts."""

from __future__ import annotations

import json
import signal
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.payloads import WIRE
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import wait_until
from tests.acceptance.test_silent_neighbours import answers_arp
from tests.acceptance.two_networks import DRIVE, LAN, RADIO, Rover, rover_with_networks

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{rover: {{address: 0.0.0.0:5000}}}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board, stale_after: 1s}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation, source_port: PORT}}
routes:
  drive_diag: {{source: driving_board, destinations: basestation}}
  manual_drive:
    source: basestation
    destinations: driving_board
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}}}
"""
DIAGNOSTICS = WIRE.encode(WIRE.case("drive_diag"), WIRE.case("drive_diag").message_class())
UNHANDLED = WIRE.encode(WIRE.case("arm_diag"), WIRE.case("arm_diag").message_class())

Problems = list[dict[str, Any]]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Rover]:
    with rover_with_networks(tmp_path) as rover:
        yield rover


def problems(site: Rover) -> Problems:
    def ask() -> Problems:
        with urllib.request.urlopen("http://127.0.0.1:9108/health.json", timeout=PATIENCE) as answer:
            return list(json.load(answer)["problems"])

    return site.rover.inside(ask)


def driven(site: Rover, until: Callable[[Problems], bool], *, board_sends: bool) -> Problems:
    """Send 20 commands a second, and messages of the board, until the problems are as expected; return them."""
    end = time.monotonic() + PATIENCE
    while not until(found := problems(site)):
        assert time.monotonic() < end, found
        for _ in range(10):
            site.basestation.sendto(DRIVE, RADIO)
            if board_sends:
                site.board.sendto(DIAGNOSTICS, LAN)
            time.sleep(0.05)
    return found


def test_a_board_that_does_not_answer_is_named_and_not_the_network(site: Rover) -> None:
    with site.router(TABLE.replace("PORT", "9000")):
        driven(site, lambda _: site.seen("driving_board"), board_sends=True)
        answers_arp(site.lan, does=False)
        site.rover.ip("neigh", "flush", "dev", "lan0")
        found = driven(site, lambda found: "does not answer" in str(found), board_sends=False)
    kinds = [problem["kind"] for problem in found if problem["kind"] != "DeadmanActive"]  # the kernel takes a few
    assert kinds == ["EndpointSilent"]
    silent = found[-1]
    assert "last heard" in silent["more"]
    assert "of manual_drive for it lost in" in silent["more"]
    assert silent["remedy"].startswith("Check its power, cable or radio, and address: `ping 10.78.1.222`")


def test_after_a_reload_that_repairs_an_address_nobody_is_said_to_use_another(site: Rover) -> None:
    with site.router(TABLE.replace("PORT", "9001")) as router:
        found = driven(site, lambda found: "basestation (10.78.2.10) uses another port" in str(found), board_sends=True)
        site.table(TABLE.replace("PORT", "9000"))
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: bool(router.events("table reloaded")), "the reload")
        found = driven(site, lambda _: site.seen("basestation"), board_sends=True)
        assert "uses another port" not in str(found)


def test_who_sends_a_case_without_a_route_is_named(site: Rover) -> None:
    with site.router(TABLE.replace("PORT", "9000")):

        def is_named() -> bool:
            site.board.sendto(UNHANDLED, LAN)
            return "driving_board (10.78.1.222) sent it" in str(problems(site))

        wait_until(is_named, "the sender")
