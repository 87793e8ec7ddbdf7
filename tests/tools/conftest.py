from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from router.datagrams import Wire, wire_of_protos
from router.net.addresses import host_and_port
from router.table import read_table
from router.table.addresses import Address
from router.table.model import RouteTable
from router.types.protobuf import PayloadCase
from tests.ports import free_port

PROTOS = Path(__file__).parents[1] / "protos"

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: 0.0.0.0:{rover}}}
endpoints:
  board: {{address: 127.0.6.30:{board}, kind: board}}
  station: {{address: 127.0.6.10:{station}, kind: basestation{source_port}}}
routes:
  every_kind: {{source: {source}, destinations: [station]}}
  plain: {{source: station, destinations: [board]}}
"""


@pytest.fixture(scope="session")
def protos() -> Path:
    """A folder with `every_kind.proto` only."""
    return PROTOS


@pytest.fixture(scope="session")
def wire() -> Wire:
    return wire_of_protos(PROTOS)


@pytest.fixture(scope="session")
def every_kind(wire: Wire) -> PayloadCase:
    return wire.case("every_kind")


@pytest.fixture
def table_path(tmp_path: Path) -> Callable[..., Path]:
    """Write a table with a board and a basestation on free ports; `source` is the source of `every_kind`."""

    def write(source: str = "board", source_port: bool = False) -> Path:
        path = tmp_path / "table.yaml"
        path.write_text(
            TABLE.format(
                protos=PROTOS,
                rover=free_port("0.0.0.0"),
                board=free_port("127.0.6.30"),
                station=free_port("127.0.6.10"),
                source=source,
                source_port=f", source_port: {free_port('127.0.6.10')}" if source_port else "",
            )
        )
        return path

    return write


@pytest.fixture
def table(table_path: Callable[..., Path]) -> RouteTable:
    return read_table(table_path())


@pytest.fixture
def line_path(table_path: Callable[..., Path]) -> Path:
    """The same table with the board at a serial line, `uart` in the folder of the table."""
    path = table_path()
    line = f"  uart: {{serial: {path.parent / 'uart'}, baud: 460800, framing: cobs, checksum: crc16_ccitt_false}}\n"
    text = path.read_text().replace("endpoints:\n", f"{line}endpoints:\n", 1)
    path.write_text(re.sub("address: 127.0.6.30:[0-9]+", "listener: uart", text))
    return path


@pytest.fixture
def tcp_path(table_path: Callable[..., Path]) -> Callable[[str], Path]:
    """Write the same table with the board, and `other` if it is a server, over TCP: of `connect` or `accept`.

    With IPv6, there is no `other`: a computer has only one loopback address.
    """

    def write(way: str) -> Path:
        way, _, is_ipv6 = way.partition(" ")
        path, host = table_path(), "::1" if is_ipv6 else "127.0.0.1"
        tcp = Address(host, free_port(host, socket.SOCK_STREAM))
        link = f'  tcp: {{{way}: "{tcp}", framing: {{length: u16be}}, checksum: crc32}}\n'
        text = path.read_text().replace("endpoints:\n", f"{link}endpoints:\n", 1)
        address = "address: 127.0.6.30, " if way == "accept" else ""
        other = "  other: {address: 127.0.6.31, listener: tcp, kind: board}\n" if way == "accept" else ""
        if is_ipv6:
            address, other = address.replace("127.0.6.30", '"::1"'), ""
        text = text.replace("  station:", f"{other}  station:", 1)
        path.write_text(re.sub("address: 127.0.6.30:[0-9]+", f"{address}listener: tcp", text))
        return path

    return write


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.6.5", 0))
        opened.settimeout(5)
        yield opened


def place(receiver: socket.socket) -> str:
    return str(Address(*host_and_port(receiver.getsockname())))
