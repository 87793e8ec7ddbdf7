"""Commands that cannot leave do not keep the rover going: firewalls, routes and boards that refuse them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from tests.acceptance.payloads import WIRE
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import wait_until
from tests.acceptance.two_networks import BOARD, BRAKE, Rover

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen:
  lan: {{address: 0.0.0.0:5000, interface: lan0}}
  radio: {{address: 0.0.0.0:5000, interface: radio0}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board, listener: lan{bandwidth}}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation, listener: radio}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 200ms
    deadman: {{timeout: 500ms, repeat: 500ms, at_start: silent, send: {{manual_brake: {{brake: true}}}}}}
"""
DRIVE = WIRE.envelopes.first.message_class(manual_drive={"forward_backward": 50, "turn": -3}).SerializeToString()

FORWARD = """\
import socket, sys, time
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sender.bind(("10.78.2.10", 9000))
while True:
    sender.sendto(bytes.fromhex(sys.argv[1]), ("10.78.2.1", 5000))
    time.sleep(0.02)
"""


@contextmanager
def driving(site: Rover) -> Iterator[None]:
    """The basestation's stick is pushed forward, and every command says so."""
    site.basestation.close()
    forward = site.radio.inside(lambda: subprocess.Popen([sys.executable, "-c", FORWARD, DRIVE.hex()]))
    try:
        while site.board.recv(1000) != DRIVE:
            pass
        yield
    finally:
        forward.kill()
        forward.wait()


def trips(site: Rover) -> float:
    return site.count("deadman_trips_total", route="manual_drive")


def refuse_long_datagrams(site: Rover) -> None:
    """The firewall lets the brake pass, which is shorter."""
    site.rover.nft("add table ip filter")
    site.rover.nft("add chain ip filter output { type filter hook output priority 0; }")
    site.rover.nft(f"add rule ip filter output udp dport 8 udp length > {8 + len(BRAKE)} drop")


@pytest.mark.parametrize("bandwidth", ["", ", bandwidth: 100kB/s"], ids=["at once", "paced"])
def test_a_firewall_that_refuses_commands_lets_the_brake_pass(site: Rover, bandwidth: str) -> None:
    with site.router(TABLE.replace("{bandwidth}", bandwidth)), driving(site):
        refuse_long_datagrams(site)
        while site.board.recv(1000) != BRAKE:
            pass
        assert [site.board.recv(1000) for _ in range(3)] == 3 * [BRAKE]
        assert trips(site) == 1
        site.rover.nft("flush ruleset")
        while site.board.recv(1000) != DRIVE:
            pass


def test_the_deadman_trips_while_no_route_leads_to_the_board_and_the_brake_comes_first(site: Rover) -> None:
    def errors() -> float:
        return site.count("deadman_send_errors_total", route="manual_drive", destination="driving_board")

    with site.router(TABLE.replace("{bandwidth}", "")):
        with driving(site):
            site.rover.ip("route", "add", "blackhole", f"{BOARD[0]}/32")
            wait_until(lambda: errors() >= 2, "the second brake that fails")
            assert trips(site) == 1
        site.board_gets()
        site.rover.ip("route", "del", "blackhole", f"{BOARD[0]}/32")
        assert site.board.recv(1000) == BRAKE
        assert site.board_gets() == []


def test_a_board_that_was_gone_gets_few_old_commands_and_then_the_brake(site: Rover) -> None:
    """While it does not answer, the kernel keeps what is sent to it, for up to three seconds."""
    with site.router(TABLE.replace("{bandwidth}", "")):
        with driving(site):
            site.lan.ip("link", "set", "eth0", "down")
            site.rover.ip("neighbour", "flush", "dev", "lan0")
            wait_until(lambda: trips(site) == 1, "the trip")
        site.board.setblocking(False)
        with suppress(BlockingIOError):
            while True:  # what came before
                site.board.recv(1000)
        site.board.settimeout(PATIENCE)
        site.lan.ip("link", "set", "eth0", "up")
        arrived = [site.board.recv(1000)]
        while arrived[-1] != BRAKE:
            arrived.append(site.board.recv(1000))
        assert arrived[:-1] == (len(arrived) - 1) * [DRIVE]
        assert len(arrived) - 1 <= 24
        errors = site.count("deadman_send_errors_total", route="manual_drive", destination="driving_board")
        assert errors == 0


def test_a_board_that_refuses_commands_is_braked(site: Rover) -> None:
    """Nobody listens at its port: it says so by ICMP after each datagram, as boards do; Linux would once per second."""
    site.lan.run("sysctl", "-qw", "net.ipv4.icmp_ratelimit=0")
    with site.router(TABLE.replace("{bandwidth}", "")), driving(site):
        site.board.close()
        wait_until(lambda: trips(site) == 1, "the trip")
