"""Boards that answer no ARP for a while: they get the brake once they do."""

from __future__ import annotations

import time
from contextlib import suppress

import pytest

from tests.acceptance.site import wait_until
from tests.acceptance.two_networks import BRAKE, DRIVE, RADIO, Rover
from tests.namespaces import Computer

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{rover: {{address: 0.0.0.0:5000}}}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation}}
routes:
  manual_drive:
    source: basestation
    destinations: driving_board
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}}}
"""
losses = pytest.mark.parametrize("loses_link", [False, True], ids=["neighbour", "link and neighbour"])
FAILED = 4.0
"""Seconds after which the kernel has given up on a neighbour, and has dropped what waited for it."""


def answers_arp(computer: Computer, *, does: bool) -> None:
    computer.run("sysctl", "-qw", f"net.ipv4.conf.eth0.arp_ignore={0 if does else 8}")


def lose(site: Rover, *, loses_link: bool) -> None:
    answers_arp(site.lan, does=False)
    site.rover.ip("neigh", "flush", "dev", "lan0")
    if loses_link:
        site.rover.ip("link", "set", "lan0", "down")


def taken(site: Rover) -> list[bytes]:
    found = []
    site.board.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            found.append(site.board.recv(1000))
    return found


def regain_link(site: Rover) -> None:
    site.rover.ip("link", "set", "lan0", "up")


@losses
def test_a_board_that_is_not_reached_at_the_start_gets_the_brake_when_it_is(site: Rover, loses_link: bool) -> None:
    lose(site, loses_link=loses_link)
    with site.router(TABLE):
        time.sleep(1.5)
        regain_link(site)
        time.sleep(FAILED)
        assert taken(site) == []
        answers_arp(site.lan, does=True)
        wait_until(lambda: taken(site) != [], "the brake")


@losses
def test_a_board_that_is_lost_while_the_deadman_sends_gets_the_brake_when_it_is_back(
    site: Rover, loses_link: bool
) -> None:
    with site.router(TABLE):
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: DRIVE in taken(site), "the command")
        lose(site, loses_link=loses_link)
        time.sleep(1.5)
        regain_link(site)
        time.sleep(FAILED)
        taken(site)
        answers_arp(site.lan, does=True)
        wait_until(lambda: BRAKE in taken(site), "the brake")
