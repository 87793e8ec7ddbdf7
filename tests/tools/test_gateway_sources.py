"""The sources of `listen` against senders of real sockets: none of them is the gateway itself."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from websockets.sync.server import ServerConnection, serve

from router.errors import Located, UsageError
from router.gateway.packets import unpack
from router.net.addresses import family, host_and_port
from router.table.addresses import Address
from router.table.model.gateways import GatewayFormat, ZenohSettings
from router.tools import gateway_sources
from router.tools.gateway_sources import Source, Splitter, TcpSource, UdpSource, WebsocketSource, open_source
from router.tools.udp import address_of, open_udp
from router.tools.zenoh_source import ZenohSource
from tests.ports import free_port

Said = list[str]


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> Said:
    monkeypatch.setattr(gateway_sources, "_TRY_AGAIN", 0.02)
    return []


def received(source: Source, number: int) -> list[bytes]:
    """So many arrivals, however long they take: a test that hangs is ended by pytest's time limit."""
    found: list[bytes] = []
    while len(found) < number:
        found.extend(arrival.data for arrival in source.arrivals(0.2))
    return found


def until(source: Source, condition: Callable[[], object]) -> None:
    while not condition():
        assert list(source.arrivals(0.05)) == []


@contextmanager
def udp_source(said: Said, gateway: Address | None = None) -> Iterator[tuple[UdpSource, Address]]:
    host = gateway.host if gateway is not None else "127.0.0.1"
    address = Address(host, free_port(host))
    with closing(UdpSource(address, gateway, said.append)) as source:
        assert source.place == f"udp {address}"
        yield source, address


@contextmanager
def tcp_source(port: socket.socket, said: Said, form: GatewayFormat | None = None) -> Iterator[TcpSource]:
    """Connected to `port`, which is to accept it."""
    with closing(TcpSource(Address(*port.getsockname()), form, said.append)) as source:
        assert list(source.arrivals(0.01)) == []
        yield source


def test_udp_takes_whole_datagrams_of_any_size(said: Said) -> None:
    with udp_source(said) as (source, address), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gateway:
        gateway.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        assert list(source.arrivals(0.01)) == []
        for data in (b"a", b"", b"x" * 65_507):
            gateway.sendto(data, address)
        assert received(source, 3) == [b"a", b"", b"x" * 65_507]
        assert source.lost == 0


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_udp_asks_from_the_port_on_which_it_listens(said: Said, host: str) -> None:
    with open_udp(Address(host, 0), "gateway") as gateway:
        gateway.settimeout(5)
        with udp_source(said, address_of(gateway)) as (source, address):
            source.ask()
            data, peer = gateway.recvfrom(100)
    assert peer[:2] == address
    assert unpack(data)[1:] == (False, "", "", b"")


def test_udp_tells_what_the_kernel_dropped_for_want_of_room(said: Said) -> None:
    with udp_source(said) as (source, address), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gateway:
        while not source.lost:
            gateway.sendto(b"x" * 60_000, address)
        assert source.lost > 0
        assert len(source.arrivals(5)) > 1


def test_udp_that_cannot_ask_says_why(said: Said) -> None:
    with udp_source(said, Address("255.255.255.255", 9)) as (source, _):
        source.ask()
    assert said == ["cannot ask 255.255.255.255:9: Permission denied"]


@pytest.fixture
def port() -> Iterator[socket.socket]:
    """Of a TCP gateway, which the test plays."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        yield server


@pytest.mark.parametrize(
    ("form", "stream"),
    [
        (None, b'{"op":"x"}\n{"op":"y"}\n'),
        (GatewayFormat.JSON_LINES, b'{"op":"x"}\n{"op":"y"}\n'),
        (None, struct.pack("<I", 10) + b'{"op":"x"}' + struct.pack("<I", 10) + b'{"op":"y"}'),
    ],
)
def test_tcp_splits_the_stream(port: socket.socket, said: Said, form: GatewayFormat | None, stream: bytes) -> None:
    with tcp_source(port, said, form) as source, port.accept()[0] as gateway:
        gateway.sendall(stream)
        assert received(source, 2) == [b'{"op":"x"}', b'{"op":"y"}']
        source.close()
    assert said == []


def test_tcp_connects_again_when_the_gateway_went_away(port: socket.socket, said: Said) -> None:
    address = Address(*port.getsockname())
    with tcp_source(port, said) as source:
        with port.accept()[0] as gateway:
            gateway.sendall(b'{"n":1}\n{"half')
            [first] = source.arrivals(5)
        until(source, lambda: len(said) > 1)
        with port.accept()[0] as gateway:
            gateway.sendall(b'{"n":2}\n')
            [second] = source.arrivals(5)
    assert said == [
        f"tcp {address} has closed, after 6 bytes of a message; trying again",
        f"tcp {address} is connected",
    ]
    assert (first.data, second.data) == (b'{"n":1}', b'{"n":2}')
    assert first.sender != second.sender


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_tcp_waits_for_a_gateway_that_is_not_there_and_says_so_once(said: Said, host: str) -> None:
    address = Address(host, free_port(host, socket.SOCK_STREAM))
    with closing(TcpSource(address, None, said.append)) as source:
        for _ in range(3):
            source.arrivals(0.05)
        with socket.create_server(address, family=family(host)):
            until(source, lambda: len(said) > 1)
    assert said == [
        f"tcp {address} cannot be reached (Connection refused); trying again",
        f"tcp {address} is connected",
    ]


def test_tcp_leaves_a_gateway_whose_stream_makes_no_sense(port: socket.socket, said: Said) -> None:
    with tcp_source(port, said) as source, port.accept()[0] as gateway:
        gateway.sendall(struct.pack("<I", 3) + b"abc" + b"\xff" * 8)
        assert received(source, 1) == [b"abc"]
        until(source, lambda: said)
        assert gateway.recv(1) == b""
    assert "was disconnected (a packet of 4294967295 bytes); trying again" in said[0]


@contextmanager
def websocket_gateway(
    handler: Callable[[ServerConnection], None], port: int = 0, host: str = "127.0.0.1"
) -> Iterator[Address]:
    listening = socket.create_server((host, port), family=family(host))
    with serve(handler, sock=listening, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield Address(*host_and_port(server.socket.getsockname()))
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_websocket_carries_documents_as_text_and_packets_as_bytes(said: Said, host: str) -> None:
    large = b"x" * 2_000_000

    def handler(websocket: ServerConnection) -> None:
        websocket.send('{"op":"x"}\n{"op":"\u00e9"}')
        websocket.send(b"\n\n")
        websocket.send(large)
        for _ in websocket:
            pass

    with (
        websocket_gateway(handler, host=host) as address,
        closing(WebsocketSource(address, said.append)) as source,
    ):
        assert received(source, 4) == [b'{"op":"x"}', '{"op":"\u00e9"}'.encode(), b"\n\n", large]
        assert list(source.arrivals(0.01)) == []
        source.close()
    assert said == []


def test_a_websocket_is_connected_again_when_the_gateway_went_away(said: Said) -> None:
    def handler(websocket: ServerConnection) -> None:
        websocket.send("{}")

    with websocket_gateway(handler) as address, closing(WebsocketSource(address, said.append)) as source:
        assert received(source, 2) == [b"{}", b"{}"]
    assert said[0].startswith(f"websocket {address} has closed (")
    assert said[1] == f"websocket {address} is connected"


def test_what_is_no_websocket_is_said(port: socket.socket, said: Said) -> None:
    def answer() -> None:
        with port.accept()[0] as gateway:
            gateway.recv(4096)
            gateway.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    answering = threading.Thread(target=answer)
    answering.start()
    with closing(WebsocketSource(Address(*port.getsockname()), said.append)) as source:
        assert list(source.arrivals(0.01)) == []
        assert "cannot be reached (it is not a websocket: " in said[0]
        assert "404" in said[0]
    answering.join()


@pytest.fixture
def rover() -> Iterator[tuple[zenoh.Session, str]]:
    """A Zenoh session and the locator on which it listens."""
    locator = f"tcp/127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", f'["{locator}"]')
    with zenoh.open(config) as session:
        yield session, locator


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_zenoh_answers_come_before_live_data_and_schemas_before_all(
    rover: tuple[zenoh.Session, str], said: Said, mode: str
) -> None:
    session, locator = rover

    def answer(query: zenoh.Query) -> None:
        session.put("rovers/loki_1/data/imu", b"live")
        query.reply("rovers/loki_1/data/imu", b"latest")
        query.reply("rovers/loki_1/schema/p/msg/T", b"schema")

    session.declare_queryable("rovers/loki_1/**", answer)
    place = f"zenoh://rovers/loki_1?mode={mode}&connect={locator}"
    with closing(open_source(place, None, None, said.append)) as source:
        source.ask()
        assert received(source, 3) == [b"schema", b"latest", b"live"]
        session.put("rovers/loki_2/data/imu", b"of another")
        session.put("rovers/loki_1/schema/p/msg/T", b"schema again")
        assert received(source, 1) == [b"schema again"]
    assert said == []


def test_zenoh_without_a_gateway_waits_for_one(rover: tuple[zenoh.Session, str], said: Said) -> None:
    session, locator = rover
    settings = ZenohSettings(Located("rovers/loki_1", None), connect=(locator,))  # type: ignore[arg-type]
    with closing(ZenohSource(settings, said.append)) as source:
        source.ask()
        assert list(source.arrivals(5)) == []
        gateway = session.declare_publisher("rovers/loki_1/data/imu")
        until(source, lambda: gateway.matching_status.matching)  # type: ignore[attr-defined]
        gateway.put(b"live")
        assert received(source, 1) == [b"live"]


def test_zenoh_takes_a_configuration_of_its_library(
    rover: tuple[zenoh.Session, str], said: Said, tmp_path: Path
) -> None:
    session, locator = rover
    file = tmp_path / "station.json5"
    file.write_text(f'{{mode: "client", connect: {{endpoints: ["{locator}"]}}}}')
    session.declare_queryable("rovers/loki_1/**", lambda query: query.reply("rovers/loki_1/data/imu", b"latest"))
    with closing(open_source(f"zenoh://rovers/loki_1?config={file}", None, None, said.append)) as source:
        source.ask()
        assert received(source, 1) == [b"latest"]


def test_a_configuration_that_zenoh_refuses_is_named_and_not_quoted(tmp_path: Path, said: Said) -> None:
    file = tmp_path / "station.json5"
    place = f"zenoh://rovers/loki_1?config={file}"
    with pytest.raises(UsageError, match=r"station\.json5: No such file"):
        open_source(place, None, None, said.append)
    file.write_text('{transport: {auth: {usrpwd: {user: "a", password: 4711}}}}')
    with pytest.raises(UsageError, match=r"station\.json5: ") as refused:
        open_source(place, None, None, said.append)
    assert "4711" not in str(refused.value)
    with pytest.raises(UsageError, match="'config' alone"):
        open_source(f"{place}&mode=client", None, None, said.append)


def test_zenoh_tells_what_a_gateway_could_not_answer(rover: tuple[zenoh.Session, str], said: Said) -> None:
    session, locator = rover

    def answer(query: zenoh.Query) -> None:
        query.reply_err(b"not now")

    session.declare_queryable("rovers/loki_1/**", answer)
    with closing(open_source(f"zenoh://rovers/loki_1?connect={locator}", None, None, said.append)) as source:
        source.ask()
        until(source, lambda: said)
    assert said == ["a gateway could not answer: not now"]


def framed(packet: bytes) -> bytes:
    return struct.pack("<I", len(packet)) + packet


def fed(splitter: Splitter, stream: bytes, size: int) -> list[bytes]:
    pieces = (stream[start : start + size] for start in range(0, len(stream), size))
    return [whole for piece in pieces for whole in splitter.feed(piece)]


@given(st.lists(st.binary(max_size=300)), st.integers(1, 50), st.sampled_from([GatewayFormat.GATEWAY_V1, None]))
def test_packets_are_found_wherever_the_stream_is_cut(
    packets: list[bytes], size: int, form: GatewayFormat | None
) -> None:
    splitter = Splitter(form)
    assert fed(splitter, b"".join(map(framed, packets)), size) == packets
    assert splitter.unfinished == 0


@given(st.lists(st.binary(max_size=50).map(lambda text: b'{"op"' + text.replace(b"\n", b""))), st.integers(1, 50))
def test_lines_are_found_and_recognised_wherever_the_stream_is_cut(lines: list[bytes], size: int) -> None:
    stream = b"".join(line + b"\n" for line in lines)
    assert fed(Splitter(GatewayFormat.JSON_LINES), stream, size) == lines
    assert fed(Splitter(None), stream, size) == lines


def test_a_packet_whose_length_begins_like_a_document_is_a_packet() -> None:
    packet = b"x" * ord("{")
    assert fed(Splitter(None), framed(packet), 200) == [packet]
