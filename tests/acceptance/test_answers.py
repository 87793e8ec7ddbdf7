"""Where datagrams leave from, so that a board that answers there is heard, through firewalls too."""

from __future__ import annotations

import errno
import signal
import socket
import struct
from functools import partial

import pytest

from tests.acceptance.payloads import WIRE
from tests.acceptance.site import RouterProcess, key, wait_until
from tests.acceptance.two_networks import BASESTATION, BOARD, BRAKE, DRIVE, LAN, RADIO, Rover
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
  manual_drive: {{source: basestation, destinations: driving_board, deadman: {{none: a test}}}}
  drive_diag: {{source: driving_board, destinations: basestation}}
"""
SEVERAL = TABLE.replace(
    "listen: {{rover: {{address: 0.0.0.0:5000}}}}",
    """listen:
  lan: {{address: 0.0.0.0:5000, interface: lan0}}
  radio: {{address: 0.0.0.0:5000, interface: radio0}}""",
)
DIAG = WIRE.encode(WIRE.case("drive_diag"), WIRE.case("drive_diag").message_class())


def exchange(site: Rover, to: tuple[str, int] = RADIO) -> tuple[str, int]:
    """The basestation drives, the board answers where that came from, and the basestation gets the answer."""
    site.basestation.sendto(DRIVE, to)
    data, where_from = site.board.recvfrom(1000)
    assert data == DRIVE
    site.board.sendto(DIAG, where_from)
    assert site.basestation.recv(1000) == DIAG
    return str(where_from[0]), int(where_from[1])


def test_an_answer_to_where_a_command_came_from_is_routed_and_counted(site: Rover) -> None:
    """The listener is on all networks of a computer that has several."""
    with site.router(TABLE):
        assert exchange(site) == LAN
        assert site.count("messages_received_total", route="drive_diag", source="driving_board") == 1
        assert site.count("datagrams_received_total", listener="rover") == 2
        assert site.seen("driving_board")


def test_datagrams_leave_from_the_address_of_the_listener(site: Rover) -> None:
    """The computer has two in the boards' network, and would choose the other one."""
    site.rover.ip("address", "flush", "dev", "lan0")
    for address in ("10.78.1.7/24", "10.78.1.1/24"):
        site.rover.ip("address", "add", address, "dev", "lan0")
    with site.router(TABLE.replace("0.0.0.0:5000", "10.78.1.1:5000")):
        site.radio.ip("route", "add", "10.78.1.0/24", "via", RADIO[0])
        assert exchange(site, LAN) == LAN


def test_a_firewall_that_lets_only_answers_in_lets_them_in(site: Rover) -> None:
    """It is the rover's own: what the board sends is part of the exchange that the command has begun."""
    only_answers(site.rover)
    with site.router(TABLE):
        exchange(site)


def only_answers(rover: Computer) -> None:
    rules = """
table inet filter {
  chain input {
    type filter hook input priority 0; policy drop;
    iifname { "lo", "radio0" } accept
    ct state established accept
  }
}
"""
    rover.nft(rules)


@pytest.mark.parametrize(
    ("keys", "lan", "leaves_from"),
    [
        ("listener: lan", 5001, 5001),
        ("send_from: radio", 5001, 5000),
        ("listener: lan, send_from: ephemeral", 5001, None),
        ("", 5001, None),
        ("", 5000, 5000),
    ],
    ids=[
        "its own listener",
        "a named one",
        "asked for a port of its own",
        "none of several is named",
        "several on one port",
    ],
)
def test_of_several_listeners_the_table_chooses(site: Rover, keys: str, lan: int, leaves_from: int | None) -> None:
    text = SEVERAL.replace("0.0.0.0:5000, interface: lan0", f"0.0.0.0:{lan}, interface: lan0")
    with site.router(text.replace("kind: board", f"kind: board, {keys}".rstrip(", "))):
        site.basestation.sendto(DRIVE, RADIO)
        _, where_from = site.board.recvfrom(1000)
        assert where_from[0] == LAN[0]
        assert where_from[1] == leaves_from or (leaves_from is None and where_from[1] not in (5000, 5001))


@pytest.mark.parametrize("is_reloaded", [False, True], ids=["at the start", "at a reload"])
def test_what_is_for_the_address_of_one_listener_and_comes_to_another_is_received(
    site: Rover, is_reloaded: bool
) -> None:
    """The sender has the port of `lan`, but the basestation reaches that address by the radio, as by a route."""
    text = SEVERAL.replace("0.0.0.0:5000, interface: lan0", "10.78.1.1:5000, interface: lan0")
    text = text.replace("kind: board", "kind: board, listener: lan")
    site.radio.ip("route", "add", "10.78.1.0/24", "via", RADIO[0])
    with site.router(text.replace("0.0.0.0:5000", "0.0.0.0:5001") if is_reloaded else text) as router:
        if is_reloaded:
            site.table(text)
            router.process.send_signal(signal.SIGHUP)
            wait_until(lambda: bool(router.events("table reloaded")), "the reload")
        assert exchange(site, LAN) == LAN


def test_the_log_warns_of_a_listener_in_another_network_than_a_board(site: Rover) -> None:
    """A board, or a router on the way, may drop what comes from an address that no route leads back to."""
    warning = "datagrams to this endpoint have another network's source address; firewalls may drop them"
    text = TABLE.replace("0.0.0.0:5000", "10.78.2.1:5000")
    with site.router(text) as router:
        assert [(line["endpoint"], line["address"], line["route"]) for line in router.events(warning)] == [
            ("driving_board", RADIO[0], LAN[0])
        ]
    with site.router(text.replace("kind: board", "kind: board, send_from: ephemeral")) as router:
        assert not router.events(warning)


def test_the_port_changes_with_the_table(site: Rover) -> None:
    with site.router(TABLE) as router:

        def leaves_from(table: str, port: int) -> int:
            reloads = len(router.events("table reloaded"))
            site.table(table)
            router.process.send_signal(signal.SIGHUP)
            wait_until(lambda: len(router.events("table reloaded")) > reloads, "the reload")
            site.basestation.sendto(DRIVE, (RADIO[0], port))
            return int(site.board.recvfrom(1000)[1][1])

        assert leaves_from(TABLE.replace("kind: board", "kind: board, send_from: ephemeral"), 5000) != 5000
        assert leaves_from(TABLE.replace(":5000", ":5001"), 5001) == 5001
        assert leaves_from(TABLE, 5000) == 5000
        exchange(site)


def test_nobody_else_gets_the_port(site: Rover) -> None:
    with site.router(TABLE):
        with pytest.raises(OSError, match="Address already in use") as caught:
            site.rover.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).bind(("0.0.0.0", 5000)))
        assert caught.value.errno == errno.EADDRINUSE
        folder = site.folder / "second"
        folder.mkdir()
        second = site.rover.inside(lambda: RouterProcess(folder, site.folder / "table.yaml"))
        assert second.wait() == 1
        assert "has the port" in second.text()


@pytest.mark.parametrize("table", [TABLE, SEVERAL], ids=["one listener", "one for each interface"])
def test_a_board_whose_port_is_closed_is_counted_one_for_one(site: Rover, table: str) -> None:
    """Each datagram is refused by the board's computer; the next one reports it, and the last one has no next."""
    site.board.close()
    labels = {"route": "manual_drive"}
    with site.router(table) as router:

        def counted() -> tuple[float, float]:
            found = site.samples()
            dropped = {"target": "driving_board", "reason": "send_error"}
            return (
                found.get(key("datagrams_sent_total", destination="driving_board", **labels), 0),
                found.get(key("messages_dropped_total", **dropped, **labels), 0),
            )

        def has_grown(before: float) -> bool:
            return sum(counted()) > before

        for _ in range(5):
            before = sum(counted())
            site.basestation.sendto(DRIVE, RADIO)
            wait_until(partial(has_grown, before), "the command")
        assert counted() == (1, 4)
        wait_until(lambda: "nobody listens at 10.78.1.222:8" in router.text(), "the report")


def test_a_flood_of_forged_errors_keeps_no_datagram_away(site: Rover) -> None:
    """ICMP messages that say that nobody listens, about datagrams that the listener's port has never sent."""
    with site.router(TABLE), site.radio.inside(raw_icmp) as forging:
        for _ in range(20):
            for _ in range(500):
                forging.sendto(REFUSAL, (RADIO[0], 0))
            site.basestation.sendto(DRIVE, RADIO)
            assert site.board.recv(1000) == DRIVE
        assert site.count("kernel_drops_total", listener="rover") == 0
        site.board.sendto(DIAG, LAN)
        assert site.basestation.recv(1000) == DIAG
        refused = {"route": "drive_diag", "target": "basestation", "reason": "send_error"}
        wait_until(lambda: site.count("messages_dropped_total", **refused) == 1, "the report of what they say")


def test_forged_errors_about_the_board_keep_no_brake_away(site: Rover) -> None:
    """Each command leaves, and the board obeys it, though its computer is said to have refused the one before."""
    text = TABLE.replace(
        "{{none: a test}}", "{{timeout: 500ms, at_start: silent, send: {{manual_brake: {{brake: true}}}}}}"
    )
    with site.router(text), site.radio.inside(raw_icmp) as forging:
        refused = {"route": "manual_drive", "target": "driving_board", "reason": "send_error"}

        def refusals() -> float:
            return site.samples().get(key("messages_dropped_total", **refused), 0)

        for sent in range(1, 4):
            forging.sendto(refusal((LAN[0], 5000), BOARD), (RADIO[0], 0))
            site.basestation.sendto(DRIVE, RADIO)
            assert site.board.recv(1000) == DRIVE
            wait_until(partial(lambda sent: refusals() == sent, sent), "the report of what they say")
        assert site.board.recv(1000) == BRAKE


def raw_icmp() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)


def _checksum(data: bytes) -> bytes:
    total = sum(int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2))
    total = (total & 0xFFFF) + (total >> 16)
    return (0xFFFF - ((total & 0xFFFF) + (total >> 16))).to_bytes(2, "big")


def refusal(sender: tuple[str, int], receiver: tuple[str, int]) -> bytes:
    """Port unreachable, about a datagram between them."""
    addresses = socket.inet_aton(sender[0]) + socket.inet_aton(receiver[0])
    ports = struct.pack("!HH", sender[1], receiver[1])
    quoted = bytes.fromhex("45000021000040004011 0000") + addresses + ports + bytes.fromhex("000d 0000 0000000000")
    data = bytes.fromhex("0303 0000 00000000") + quoted + bytes(1)
    return data[:2] + _checksum(data) + data[4:]


REFUSAL = refusal(RADIO, BASESTATION)
