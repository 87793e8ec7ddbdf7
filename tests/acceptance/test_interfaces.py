"""Who is believed by which network interface: a rover with a LAN and a radio, and attackers on both.

Each is a network namespace of its own, with interfaces as on real computers.
"""

from __future__ import annotations

import signal
import socket
from contextlib import ExitStack

import pytest

from router.net.sockets import Inherited
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import ROOT, wait_until
from tests.acceptance.two_networks import (
    BASESTATION,
    BOARD,
    DRIVE,
    LAN,
    RADIO,
    Rover,
    attacker,
)
from tests.namespaces import Computer, cable

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen:
  lan: {{address: 0.0.0.0:5000, interface: lan0}}
  radio: {{address: 0.0.0.0:5000, interface: radio0}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board, listener: lan}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation, listener: radio}}
  anywhere: {{address: 10.78.1.60:9000, kind: tool}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1s
    deadman: {{timeout: 1200ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], repeat: 10s}}
  drive_diag: {{source: driving_board, destinations: [basestation]}}
  arm_diag: {{source: anywhere, destinations: [basestation]}}
  imu_info: {{source: any, destinations: [basestation]}}
"""
DIAG = WIRE.encode(WIRE.case("drive_diag"), WIRE.case("drive_diag").message_class())
ARM = WIRE.encode(WIRE.case("arm_diag"), WIRE.case("arm_diag").message_class())
IMU = WIRE.encode(WIRE.case("imu_info"), WIRE.case("imu_info").message_class())


def test_a_command_is_believed_by_its_listener_only(site: Rover) -> None:
    """The basestation's drives. A forged one from the LAN does not, whichever of the rover's addresses it goes to."""
    with site.router(TABLE) as router, ExitStack() as stack:
        forger = attacker(site, stack, site.lan, BASESTATION)
        forger.sendto(DRIVE, LAN)
        site.lan.ip("route", "replace", "10.78.2.1", "via", "10.78.1.1", "dev", "eth0", "onlink")
        forger.sendto(DRIVE, RADIO)
        wait_until(lambda: site.mismatches("lan") == 2, "the second forged command")
        assert not site.seen("basestation")
        assert site.board_gets() == []
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command")
        assert site.seen("basestation")
        assert (site.mismatches("lan"), site.mismatches("radio")) == (2, 0)
        assert router.events("router started")[0]["listening"] == {
            "lan": "0.0.0.0:5000 on lan0",
            "radio": "0.0.0.0:5000 on radio0",
        }


@pytest.mark.slow
def test_the_kernels_reverse_path_filter_drops_it_before_that(site: Rover) -> None:
    site.rover.run("sysctl", "-qw", "net.ipv4.conf.all.rp_filter=1")
    with site.router(TABLE), ExitStack() as stack:
        forger = attacker(site, stack, site.lan, BASESTATION)
        forger.sendto(DRIVE, LAN)
        site.board.sendto(DIAG, LAN)
        assert site.basestation.recv(1000) == DIAG
        assert site.count("datagrams_received_total", listener="lan") == 1


@pytest.mark.slow
def test_a_board_is_not_played_from_the_radio_either(site: Rover) -> None:
    with site.router(TABLE), ExitStack() as stack:
        forger = attacker(site, stack, site.radio, BOARD)
        site.rover.ip("neighbour", "replace", "10.78.2.10", "lladdr", mac(site.radio), "dev", "radio0")
        forger.sendto(DIAG, RADIO)
        wait_until(lambda: site.mismatches("radio") == 1, "the forged datagram")
        site.board.sendto(DIAG, LAN)
        assert site.basestation.recv(1000) == DIAG
        assert site.mismatches("lan") == 0


@pytest.mark.slow
def test_without_a_listener_an_endpoint_is_believed_by_all_and_any_takes_whatever_comes(site: Rover) -> None:
    """A datagram from an endpoint's address by another listener is a stranger's: routes from `any` take it as such."""
    with site.router(TABLE), ExitStack() as stack:
        tool = attacker(site, stack, site.radio, ("10.78.1.60", 0))
        tool.sendto(ARM, RADIO)
        assert site.basestation.recv(1000) == ARM
        forger = attacker(site, stack, site.lan, BASESTATION)
        forger.sendto(IMU, LAN)
        assert site.basestation.recv(1000) == IMU
        assert site.count("messages_received_total", route="imu_info", source="unknown") == 1
        assert not site.seen("basestation")


def test_forged_commands_do_not_keep_a_deadman_from_tripping(site: Rover) -> None:
    with site.router(TABLE), ExitStack() as stack:
        forger = attacker(site, stack, site.lan, BASESTATION)
        site.basestation.sendto(DRIVE, RADIO)

        def trips() -> bool:
            forger.sendto(DRIVE, LAN)
            return site.count("deadman_trips_total", route="manual_drive") == 1

        wait_until(trips, "the deadman's trip")
        assert site.board_gets() == [DRIVE]


@pytest.mark.slow
def test_verbs_reach_a_listener_by_the_address_of_its_interface(site: Rover) -> None:
    """`router send`, and so `replay`; `doctor` finds nothing wrong with the interfaces."""
    with site.router(TABLE):
        router = ROOT / ".venv/bin/python", "-m", "router"
        table = site.folder / "table.yaml"
        for listener in ("lan", "radio"):
            site.rover.run(*router, "send", "imu_info", "--table", table, "--to", listener)
            assert site.basestation.recv(1000) == IMU
            assert site.count("datagrams_received_total", listener=listener) == 1
        found = site.rover.run(*router, "doctor", "-t", table, check=False)
        assert "listener 'lan': network interface lan0 is up" in found
        site.rover.ip("link", "set", "radio0", "down")
        found = site.rover.run(*router, "doctor", "-t", table, check=False)
        assert "listener 'radio': network interface radio0 is down: the listener receives nothing" in found


def mac(computer: Computer) -> str:
    return computer.ip("-br", "link", "show", "eth0").split()[2]


@pytest.mark.slow
def test_a_listener_on_another_interface_is_another_listener(site: Rover) -> None:
    """Reloaded, the two change places."""
    with site.router(TABLE) as router:
        swapped = TABLE.replace("lan0", "other").replace("radio0", "lan0").replace("other", "radio0")
        site.table(swapped)
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: bool(router.events("table reloaded")), "the reload")
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: site.mismatches("lan") == 1, "the command by the other listener")
        site.table(TABLE)
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: len(router.events("table reloaded")) == 2, "the second reload")
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command")


@pytest.mark.slow
def test_a_socket_that_was_handed_over_is_not_taken_when_its_interface_has_gone(site: Rover) -> None:
    def bound() -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"radio0")
        opened.bind(("0.0.0.0", 5000))
        return opened

    with site.rover.inside(bound) as held:
        ours = Inherited([held.dup()])
        with ours.take(("0.0.0.0", 5000), "radio0") or pytest.fail("it is there"):
            pass
        site.rover.ip("link", "del", "radio0")
        assert ours.take(("0.0.0.0", 5000), "radio0") is None


@pytest.mark.slow
def test_an_interface_that_goes_and_comes_back_is_heard_again(site: Rover) -> None:
    """As a tunnel that is restarted, or an adapter that is plugged in again: it has the name, and is another one."""
    with site.router(TABLE) as router:
        site.rover.ip("link", "del", "radio0")
        gone = "the network interface is gone: the listener receives nothing"
        wait_until(lambda: bool(router.events(gone)), "the loss")
        cable(site.rover, "radio0", "10.78.2.1/24", site.radio, "eth0", "10.78.2.10/24")
        wait_until(lambda: bool(router.events("these listeners now receive: their networks are up")), "the return")
        site.basestation.sendto(DRIVE, RADIO)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command")
        site.board.sendto(DIAG, LAN)
        assert site.basestation.recv(1000) == DIAG
        site.rover.ip("link", "del", "radio0")  # and it stops as usual without it
