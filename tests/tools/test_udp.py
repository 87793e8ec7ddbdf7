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
from tests.tables import ROUTES


def test_addresses_as_typed(table: RouteTable) -> None:
    assert udp.destination("127.0.0.1:5000", table) == Address("127.0.0.1", 5000)
    assert udp.destination("localhost:5000", None) == Address("127.0.0.1", 5000)
    assert udp.listening("5000", None) == Address("0.0.0.0", 5000)
    assert udp.listening("127.0.0.1:5000", table) == Address("127.0.0.1", 5000)
    assert udp.origin("127.0.0.7", table) == Address("127.0.0.7", 0)
    assert udp.origin("127.0.0.7:70", None) == Address("127.0.0.7", 70)


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


HERE = Address("127.0.0.1", 0)


def test_a_port_where_nobody_listens_is_noticed_and_does_not_stop_the_sending() -> None:
    with open_udp(HERE, "gone") as gone:
        nobody = Address(*gone.getsockname())
    with open_udp(HERE, "sender") as sender:
        sent = Sent()
        send(sender, nobody, b"hello", 3, None, sent)
    assert (sent.count, sent.refused) == (3, 3)
