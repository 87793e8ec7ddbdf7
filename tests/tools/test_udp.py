from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from router.errors import UsageError
from router.table import read_table
from router.table.addresses import Address
from router.table.model import RouteTable
from router.tools import udp
from router.tools.udp import Sent, open_udp, send
from tests.ports import free_port
from tests.tables import ROUTES


def test_addresses_as_typed(table: RouteTable) -> None:
    assert udp.destination("127.0.0.1:5000", table) == Address("127.0.0.1", 5000)
    assert udp.destination("localhost:5000", None) == Address("127.0.0.1", 5000)
    assert udp.listening("5000", None) == Address("0.0.0.0", 5000)
    assert udp.listening("127.0.0.1:5000", table) == Address("127.0.0.1", 5000)
    assert udp.origin("127.0.0.7", table) == Address("127.0.0.7", 0)
    assert udp.origin("127.0.0.7:70", None) == Address("127.0.0.7", 70)


def test_ipv6_addresses_as_typed(table: RouteTable) -> None:
    for given in (table, None):
        assert udp.destination("[::1]:5000", given) == Address("::1", 5000)
        assert udp.destination("[FD00:0::30]:5000", given) == Address("fd00::30", 5000)
        assert udp.destination("[fe80::1%lo]:5000", given) == Address("fe80::1%lo", 5000)
        assert udp.listening("[::]:5000", given) == Address("::", 5000)
        assert udp.origin("::1", given) == udp.origin("[::1]", given) == Address("::1", 0)
        assert udp.origin("[::1]:70", given) == Address("::1", 70)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("::1:5000", r"not HOST:PORT; write an IPv6 address in brackets"),
        ("[::1]", r"'\[::1\]' is "),
        ("[::1]5000", r"'\[::1\]5000' is "),
        ("[::1", r"'\[::1' is "),
        ("[127.0.0.1]:5000", "is not HOST:PORT"),
        ("[::g]:5000", "'::g' is not an IPv6 address"),
        ("[fe80::1]:5000", "is link-local"),
        ("[::ffff:10.0.0.1]:5000", r"write 10\.0\.0\.1"),
        ("[::1]:70000", "'70000' is not a port"),
    ],
)
def test_what_is_no_ipv6_address_with_a_port_is_told(text: str, what: str) -> None:
    with pytest.raises(UsageError, match=what):
        udp.destination(text, None)


def test_a_sender_has_the_family_of_what_it_sends_to() -> None:
    ours, theirs = Address("::1", 7), Address("::1", 5000)
    assert udp.origin_of(theirs) == Address("::", 0)
    assert udp.origin_of(theirs, Address("0.0.0.0", 7)) == Address("::", 7)
    assert udp.origin_of(theirs, ours) == ours
    with pytest.raises(UsageError, match=r"nothing can be sent to \[::1\]:5000 from 127\.0\.0\.7: only one") as raised:
        udp.origin_of(theirs, Address("127.0.0.7", 0))
    assert raised.value.hint == "give --from an IPv6 address"


def test_what_listens_everywhere_is_reached_through_the_loopback_of_its_family() -> None:
    assert udp.reachable(Address("::", 5000)) == udp.reachable(Address("::", 5000), "lo") == Address("::1", 5000)
    with pytest.raises(UsageError, match="has no IPv6 address to send to"):
        udp.reachable(Address("::", 5000), "nowhere0")


def test_a_host_name_may_have_addresses_of_both_families(
    monkeypatch: pytest.MonkeyPatch, table_path: Callable[..., Path]
) -> None:
    found = ["10.0.0.7", "fd00::7"]
    monkeypatch.setattr(udp, "addresses_of", lambda _: found)
    assert udp.destination("robot.local:5000", None) == Address("10.0.0.7", 5000)
    path = table_path()
    path.write_text(re.sub(r"address: 127\.0\.6\.30:\d+", "address: robot.local:8", path.read_text()))
    assert udp.destination("board", read_table(path)) == Address("10.0.0.7", 8)
    path.write_text(re.sub(r"0\.0\.0\.0:(\d+)", r'"[::]:\1"', path.read_text()))
    assert udp.destination("board", read_table(path)) == Address("fd00::7", 8)
    del found[1]
    with pytest.raises(UsageError, match=r"no IPv6 address for 'robot\.local', as its listener needs"):
        udp.destination("board", read_table(path))


def test_names_of_the_table(table: RouteTable) -> None:
    rover, board = table.listeners["rover"].address.value, table.endpoints["board"].address.value
    assert udp.destination("rover", table) == Address("127.0.0.1", rover.port)
    assert udp.listening("rover", table) == rover
    assert udp.destination("board", table) == board
    assert udp.origin("board", table) == Address(board.host, 0)


def test_what_is_at_a_serial_line_has_no_address(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    line = "{serial: /dev/ttyAMA0, baud: 9600, framing: cobs}"
    path.write_text(f"extends: {ROUTES}/rover.yaml\nlisten: {{uart: {line}}}\n"
                    "endpoints: {lander: {listener: uart, kind: board}}\n")  # fmt: skip
    table = read_table(path)
    for parse, name in (
        (udp.destination, "lander"),
        (udp.destination, "uart"),
        (udp.listening, "lander"),
        (udp.origin, "lander"),
    ):
        with pytest.raises(UsageError, match=f"'{name}' is at /dev/ttyAMA0, but this works over UDP only"):
            parse(name, table)


def test_an_endpoint_known_by_its_source_port_sends_from_it(table_path: Callable[..., Path]) -> None:
    table = read_table(table_path(source_port=True))
    source_port = table.endpoints["station"].source_port
    assert source_port is not None
    assert udp.origin("station", table) == Address("127.0.6.10", source_port.value)
    name_of = udp.peer_names(table)
    assert name_of(("127.0.6.10", source_port.value)) == "station"
    assert name_of(("127.0.6.10", 1)) == "127.0.6.10:1"


def test_an_endpoint_whose_address_is_learned_sends_from_anywhere_and_has_no_address(
    table_path: Callable[..., Path],
) -> None:
    path = table_path(source_port=True)
    path.write_text(re.sub(r"127\.0\.6\.10:\d+", "learned", path.read_text()))
    table = read_table(path)
    source_port = table.endpoints["station"].source_port
    assert source_port is not None
    assert udp.origin("station", table) == Address("0.0.0.0", source_port.value)
    for parse in (udp.destination, udp.listening):
        with pytest.raises(UsageError, match="the table has no address of this endpoint"):
            parse("station", table)
    assert udp.peer_names(table)(("127.0.6.10", source_port.value)) == f"127.0.6.10:{source_port.value}"


def test_a_port_that_is_taken_and_an_address_that_is_not_ours_are_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
        first.bind(("127.0.0.1", 0))
        taken = Address(*first.getsockname())
        with pytest.raises(UsageError, match=f"board: cannot bind {taken}: .*has the port; "):
            udp.open_udp(taken, "board")
    with pytest.raises(UsageError, match=r"cannot bind 192\.0\.2\.1:5000: this machine has no such address"):
        udp.open_udp(Address("192.0.2.1", 5000), "board")


def test_one_port_is_open_for_ipv4_and_for_ipv6_at_once() -> None:
    port = free_port("0.0.0.0")
    with open_udp(Address("0.0.0.0", port), "one") as one, open_udp(Address("::", port), "other") as other:
        assert udp.address_of(one) == Address("0.0.0.0", port)
        assert udp.address_of(other) == Address("::", port)


def test_an_interface_that_is_not_there_is_told() -> None:
    with pytest.raises(UsageError, match=r"board: cannot bind \[fe80::1%nowhere0\]:0: No such device"):
        open_udp(Address("fe80::1%nowhere0", 0), "board")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_port_where_nobody_listens_is_noticed_and_does_not_stop_the_sending(host: str) -> None:
    with open_udp(Address(host, 0), "gone") as gone:
        nobody = udp.address_of(gone)
    with open_udp(Address(host, 0), "sender") as sender:
        sent = Sent()
        send(sender, nobody, b"hello", 3, None, sent)
    assert (sent.count, sent.refused) == (3, 3)
