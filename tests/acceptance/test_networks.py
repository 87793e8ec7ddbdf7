"""Networks that are not there, or that routes forbid: the router starts, serves the others, and gets over it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping

import pytest

from tests.acceptance.site import ROOT, RouterProcess, wait_until
from tests.acceptance.two_networks import BRAKE, DRIVE, LAN, RADIO, Rover, udp
from tests.namespaces import cable

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:9108}}
listen: {{rover: {{address: 0.0.0.0:5000}}}}
endpoints:
  driving_board: {{address: 10.78.1.222:8, kind: board}}
  basestation: {{address: 10.78.2.10:9000, kind: basestation}}
  other: {{address: 10.79.9.9:9000, kind: basestation}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board, other]
    deadman: {{timeout: 1200ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], repeat: 10s}}
"""
TUNNEL = TABLE.replace(
    "listen: {{rover: {{address: 0.0.0.0:5000}}}}",
    """listen:
  rover: {{address: 10.78.1.1:5000}}
  tunnel: {tunnel}""",
).replace("10.78.2.10:9000, kind: basestation", "10.78.2.10:9000, kind: basestation, listener: tunnel")
UNREACHABLE = "nothing can be sent to this endpoint now; the router retries with every datagram"
WAITS = "this listener receives nothing until its network is up; the others work"
ADDRESS_GONE = "the address is gone: the listener receives nothing"
THERE = "these listeners now receive: their networks are up"


def reload(site: Rover, router: RouterProcess, text: str) -> str:
    """Have the router read another table. Return its log since then."""
    before, size = len(results(router)), len(router.text())
    site.table(text)
    router.process.send_signal(signal.SIGHUP)
    wait_until(lambda: len(results(router)) > before, "the reload")
    return router.text()[size:]


def results(router: RouterProcess) -> list[dict[str, object]]:
    refused = router.events("reload rejected; the old table is still running")
    return [*router.events("table reloaded"), *refused]


def drives(site: Rover) -> None:
    site.basestation.sendto(DRIVE, RADIO)
    wait_until(lambda: site.board_gets() == [DRIVE], "the command")


FORBIDDEN = {
    "no route": ((), "no route leads there"),
    "unreachable": (("unreachable", "10.79.0.0/16"), "the kernel refuses it: no route to host"),
    "prohibit": (("prohibit", "10.79.0.0/16"), "the kernel refuses it: permission denied"),
    "blackhole": (("blackhole", "10.79.0.0/16"), "the kernel refuses it: invalid argument"),
}


@pytest.mark.parametrize(("route", "why"), FORBIDDEN.values(), ids=FORBIDDEN)
def test_an_endpoint_that_cannot_be_reached_keeps_nothing_else_from_working(
    site: Rover, route: tuple[str, ...], why: str
) -> None:
    if route:
        site.rover.ip("route", "add", *route)
    with site.router(TABLE) as router:
        [warning] = router.events(UNREACHABLE)
        assert (warning["endpoint"], warning["address"], warning["why"]) == ("other", "10.79.9.9:9000", why)
        assert warning["remedy"]
        assert site.board.recv(100) == BRAKE
        drives(site)
        if route:
            site.rover.ip("route", "del", *route)
        site.radio.ip("address", "add", "10.79.9.9/32", "dev", "eth0")
        site.rover.ip("route", "add", "10.79.0.0/16", "dev", "radio0")
        with udp(site.radio, ("10.79.9.9", 9000)) as other:
            drives(site)
            assert other.recv(100) == DRIVE


def test_a_board_that_the_start_could_not_reach_is_stopped_when_it_can_be_reached(site: Rover) -> None:
    """Nobody commands it, and it may obey a router that was killed."""
    site.rover.ip("route", "add", "unreachable", "10.78.1.222/32")
    with site.router(TABLE) as router:
        wait_until(lambda: bool(router.events(UNREACHABLE)), "the warning")
        site.rover.ip("route", "del", "unreachable", "10.78.1.222/32")
        assert site.board.recv(100) == BRAKE
        assert site.count("deadman_trips_total", route="manual_drive") == 0
        assert site.count("deadman_datagrams_sent_total", route="manual_drive", destination="driving_board") == 1


def test_nor_does_one_that_a_reload_brings(site: Rover) -> None:
    with site.router(TABLE.replace("10.79.9.9", "10.78.1.60")) as router:
        log = reload(site, router, TABLE)
        assert "table reloaded" in log
        assert [each["why"] for each in router.events(UNREACHABLE)] == ["no route leads there"]
        drives(site)


def test_the_broadcast_address_of_an_interface_is_refused(site: Rover) -> None:
    said = "10.78.1.255 is not the address of a single machine"
    wrong = TABLE.replace("10.79.9.9", "10.78.1.255")
    path = site.table(wrong)
    refused = site.rover.inside(lambda: RouterProcess(site.folder, path))
    assert refused.wait() == 78
    assert f"{path}:8:20: {said}" in refused.text()
    assert "an endpoint has `group` or `broadcast` instead" in refused.text()
    with site.router(TABLE.replace("10.79.9.9", "10.78.1.60")) as router:
        assert said in reload(site, router, wrong)
        assert not router.events("table reloaded")
        drives(site)


Act = Callable[[Rover], None]


def gone_interface(site: Rover) -> None:
    site.rover.ip("link", "del", "radio0")


def gone_address(site: Rover) -> None:
    site.rover.ip("address", "flush", "dev", "radio0")


def new_interface(site: Rover) -> None:
    cable(site.rover, "radio0", "10.78.2.1/24", site.radio, "eth0", "10.78.2.10/24")


def new_address(site: Rover) -> None:
    site.rover.ip("address", "add", "10.78.2.1/24", "dev", "radio0")


ABSENT: Mapping[str, tuple[str, Act, str, Act]] = {
    "interface": (
        "{{address: 0.0.0.0:5001, interface: radio0}}",
        gone_interface,
        "there is no such network interface",
        new_interface,
    ),
    "address": (
        "{{address: 10.78.2.1:5001}}",
        gone_address,
        "no network interface of this computer has that address",
        new_address,
    ),
    "interface and port of another one": (
        "{{address: 10.78.2.1:5000, interface: radio0}}",
        gone_interface,
        "there is no such network interface",
        new_interface,
    ),
}


@pytest.mark.parametrize(
    ("what", "is_reloaded"), [*((what, False) for what in ABSENT), ("interface and port of another one", True)]
)
def test_a_listener_waits_for_its_network_and_the_others_serve(site: Rover, what: str, is_reloaded: bool) -> None:
    tunnel, goes, why, comes = ABSENT[what]
    goes(site)
    text = TUNNEL.replace("{tunnel}", tunnel)
    with site.router(TABLE.replace("0.0.0.0", LAN[0]) if is_reloaded else text) as router:
        assert site.board.recv(100) == BRAKE
        if is_reloaded:
            reload(site, router, text)
            assert router.events("table reloaded")
        [warning] = router.events(WAITS)
        assert (warning["listener"], warning["why"]) == ("tunnel", why)
        assert [site.count("listener_waiting", listener=each) for each in ("tunnel", "rover")] == [1, 0]
        if is_reloaded:
            assert "tunnel receives nothing: its address or network interface does not exist" in status(site)
        site.board.sendto(b"", LAN)
        wait_until(lambda: site.count("datagrams_received_total", listener="rover") == 1, "the other listener's input")
        comes(site)
        wait_until(lambda: bool(router.events(THERE)), "the binding")
        assert site.count("listener_waiting", listener="tunnel") == 0
        to = RADIO[0], 5000 if ":5000" in tunnel else 5001
        site.basestation.sendto(DRIVE, to)
        wait_until(lambda: site.board_gets() == [DRIVE], "the command")
        refused = router.events("reload rejected; the old table is still running")
        assert not refused


def status(site: Rover) -> str:
    return site.rover.run(
        ROOT / ".venv/bin/python", "-m", "router", "status", "-t", site.folder / "table.yaml", check=False
    )


def test_what_is_sent_moves_to_the_port_of_a_listener_that_was_waiting(site: Rover) -> None:
    gone_address(site)
    text = TUNNEL.replace("{tunnel}", ABSENT["address"][0]).replace("kind: board", "kind: board, send_from: tunnel")
    with site.router(text) as router:
        assert site.board.recvfrom(100)[1][1] != 5001  # the brake of the start leaves all the same
        new_address(site)
        wait_until(lambda: bool(router.events(THERE)), "the binding")
        site.lan.ip("route", "add", "10.78.2.0/24", "via", LAN[0])
        site.basestation.sendto(DRIVE, (RADIO[0], 5001))
        received = (site.board.recvfrom(100) for _ in range(10))  # first, more brakes of the start
        assert next(each for each in received if each[0] != BRAKE) == (DRIVE, (RADIO[0], 5001))


def test_of_listeners_on_one_port_one_that_is_there_serves_for_those_that_wait(site: Rover) -> None:
    gone_interface(site)
    text = TUNNEL.replace("{tunnel}", "{{address: 0.0.0.0:5000, interface: radio0}}")
    text = text.replace("10.78.1.1:5000", "0.0.0.0:5000, interface: lan0")
    with site.router(text.replace("kind: board", "kind: board, send_from: tunnel")):
        assert site.board.recvfrom(100) == (BRAKE, LAN)


def test_brakes_leave_although_the_listeners_address_has_gone(site: Rover) -> None:
    """The only listener is at the address of a tunnel, by which commands come; the board is in another network."""
    text = TABLE.replace("0.0.0.0:5000", "10.78.2.1:5000")
    site.lan.ip("route", "add", "10.78.2.0/24", "via", LAN[0])
    with site.router(text) as router:
        assert site.board.recvfrom(100) == (BRAKE, RADIO)
        drives(site)
        gone_address(site)
        assert site.board.recvfrom(100) == (BRAKE, LAN)
        assert site.count("listener_waiting", listener="rover") == 1
        wait_until(lambda: bool(router.events(ADDRESS_GONE)), "the loss")
        new_address(site)
        wait_until(lambda: bool(router.events(THERE)), "the return")
        drives(site)
