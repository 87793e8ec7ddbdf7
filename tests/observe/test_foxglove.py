"""What Foxglove gets: a real server and a client that speaks its protocol, on a router that only shows datagrams."""

from __future__ import annotations

import shutil
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from ipaddress import IPv4Network
from itertools import repeat
from pathlib import Path
from time import monotonic, time_ns
from typing import cast

import pytest
from google.protobuf.message import Message
from structlog.testing import capture_logs
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.datagrams import Wire
from router.errors import Located, SourceSpan, StartError
from router.net import doors
from router.net.doors import Door
from router.observe import foxglove
from router.observe.foxglove import FoxgloveServer
from router.observe.running import Running
from router.recording.mirror import Consumer, MirroredDatagram
from router.table.addresses import Address
from router.table.model.settings import ServerSettings
from tests.observe.foxglove_client import PATIENCE, SUBPROTOCOL, FoxgloveClient
from tests.tables import PROTOS, ROUTES

TABLES = Path(__file__).parents[1] / "rehearsal" / "tables"
SPAN = SourceSpan("routes/rover.yaml", 8, 20, 34)
LOOPBACK = Address("127.0.0.1", 0)
PEER = ("192.168.0.30", 8)
REFUSED = Counter[str]()


class Showing:
    """A router in so far as it shows what it receives. `attached` has who is shown it."""

    def __init__(self, program: CompiledTable) -> None:
        self.program = program
        self.mirror = self
        self.attached: list[Consumer] = []
        self._changed = threading.Condition()

    def attach(self, consumer: Consumer) -> Callable[[], None]:
        with self._changed:
            self.attached.append(consumer)
            self._changed.notify_all()

        def detach() -> None:
            with self._changed:
                self.attached.remove(consumer)
                self._changed.notify_all()

        return detach

    def wait_for(self, consumers: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.attached) == consumers, PATIENCE)

    def show(self, *datagrams: bytes, at: int = 1, listener: str = "rover", reason: str = "") -> None:
        batch: Sequence[MirroredDatagram] = [
            MirroredDatagram(at + number, listener, PEER, "sensor_board", reason, data)
            for number, data in enumerate(datagrams)
        ]
        for consumer in list(self.attached):
            consumer(batch)


def serve(router: Showing, address: Address = LOOPBACK, networks: Sequence[IPv4Network] = ()) -> FoxgloveServer:
    settings = ServerSettings(SPAN, Located(address, SPAN))
    return FoxgloveServer(settings, Door("foxglove", networks, REFUSED), cast("Running", router))


def compiled(table: Path) -> CompiledTable:
    checked = check_table(table)
    assert checked.program is not None, [*map(str, checked.diagnostics)]
    return checked.program


@pytest.fixture(scope="module")
def program() -> CompiledTable:
    return compiled(ROUTES / "rover.yaml")


@pytest.fixture
def router(program: CompiledTable) -> Showing:
    return Showing(program)


@pytest.fixture
def server(router: Showing) -> Iterator[FoxgloveServer]:
    with closing(serve(router)) as opened:
        yield opened


@pytest.fixture
def client(server: FoxgloveServer) -> Iterator[FoxgloveClient]:
    with FoxgloveClient(server.address.port) as opened:
        yield opened


def envelope(program: CompiledTable, case: str, **fields: object) -> bytes:
    payload = program.envelopes.first.cases[case].message_class(**fields)
    return program.envelopes.first.message_class(**{case: payload}).SerializeToString()


def show_until_received(router: Showing, client: FoxgloveClient, case: str) -> None:
    """The protocol does not confirm a subscription."""
    deadline = monotonic() + PATIENCE
    while monotonic() < deadline:
        at = time_ns()
        router.show(envelope(router.program, case), at=at)
        with suppress(TimeoutError):
            while client.receive(0.1).log_time != at:
                pass
            return
    raise AssertionError(f"no {case} was received")


def test_there_is_a_channel_for_each_payload_case(program: CompiledTable, client: FoxgloveClient) -> None:
    assert client.channels.keys() == program.envelopes.first.cases.keys()
    assert client.info["name"] == "rover_router"
    assert client.info["capabilities"] == []  # a client can look, and nothing else


def test_payloads_come_with_their_arrival_and_are_read_by_the_schema_alone(
    program: CompiledTable, router: Showing, client: FoxgloveClient
) -> None:
    client.subscribe("imu_info")
    router.wait_for(1)
    router.show(envelope(program, "imu_info", accel_x=1.5, state=2), at=1_800_000_000_123_456_789)
    told = client.receive()
    assert (told.topic, told.log_time) == ("imu_info", 1_800_000_000_123_456_789)
    assert told.message.accel_x == 1.5  # type: ignore[attr-defined]
    assert (
        told.data == program.envelopes.first.cases["imu_info"].message_class(accel_x=1.5, state=2).SerializeToString()
    )
    assert told.message.DESCRIPTOR.full_name == client.channels["imu_info"]["schemaName"]


def test_every_schema_is_whole_and_only_what_was_subscribed_to_is_sent(
    program: CompiledTable, router: Showing, client: FoxgloveClient
) -> None:
    """Schemas of messages in other files are there as well."""
    client.subscribe(*(case for case in program.envelopes.first.cases if case != "imu_info"))
    router.wait_for(1)
    for case in program.envelopes.first.cases:
        router.show(envelope(program, "imu_info"), envelope(program, case))
        assert case == "imu_info" or client.receive().topic == case


KINDS = [
    ("framed", {"rover": [b"\x08\x02\x10\x02", b""]}),
    ("named", {"rover": [b"\x0a\x06Status\x12\x02\x08\x05", b"\x12\x02\x08\x01\x18\x01\x0a\x0bburt.Status"]}),
    ("vision", {"rover": [b"\x12\x02\x08\x05", b"\x3a\x02\x08\x09\x18\x03\x12\x04\x08\x05\x12\x00"]}),
    ("several", {"game": [b"\x08\x02\x10\x02", b""], "crowd": [b"\x08\x07\x12\x00", b"\x1a\x05\x0d\0\0\x80\x3f"]}),
]


@pytest.mark.parametrize(("table", "received"), KINDS)
def test_schemas_decode_the_payloads_of_each_kind_of_envelope(table: str, received: dict[str, list[bytes]]) -> None:
    made = compiled(TABLES / f"{table}.yaml")
    router = Showing(made)
    shown = [(at, data) for at, listed in received.items() for data in listed]
    expected = [each for at, data in shown for each in Wire(made.envelopes).decode_all(data, made.envelopes.at(at))]
    with closing(serve(router)) as server, FoxgloveClient(server.address.port) as client:
        assert client.channels.keys() == made.envelopes.cases.keys()
        client.subscribe(*made.envelopes.cases)
        router.wait_for(1)
        for at, data in shown:
            router.show(data, listener=at)
        for each in expected:
            told = client.receive()
            assert (told.topic, told.message.SerializeToString()) == (each.case.name, each.message.SerializeToString())


def test_router_is_watched_only_while_somebody_has_subscribed(router: Showing, server: FoxgloveServer) -> None:
    with FoxgloveClient(server.address.port) as first, FoxgloveClient(server.address.port) as second:
        assert router.attached == []
        first.subscribe("imu_info", "gps_info")
        second.subscribe("imu_info")
        router.wait_for(1)
        show_until_received(router, second, "imu_info")  # its subscription may come after the other's
        first.unsubscribe("imu_info", "gps_info")
        show_until_received(router, second, "imu_info")
        second.unsubscribe("imu_info")
        router.wait_for(0)
        first.subscribe("gps_info")
        router.wait_for(1)
    router.wait_for(0)  # a client that leaves has not unsubscribed


def test_trimmed_and_padded_datagrams_are_shown_and_what_is_no_payload_is_not(
    program: CompiledTable, router: Showing, client: FoxgloveClient
) -> None:
    client.subscribe("manual_brake")
    router.wait_for(1)
    empty, brake = envelope(program, "manual_brake"), envelope(program, "manual_brake", brake=True)
    router.show(empty.rstrip(b"\0"), b"\xff" * 9, b"", brake * 9000, brake + bytes(5), at=100)
    assert [client.receive().log_time for _ in range(2)] == [100, 104]


def test_what_no_route_took_is_not_shown(program: CompiledTable, router: Showing, client: FoxgloveClient) -> None:
    client.subscribe("imu_info")
    router.wait_for(1)
    router.show(envelope(program, "imu_info", accel_x=66.0), at=100, reason="source_mismatch")
    router.show(envelope(program, "imu_info", accel_x=1.5), at=101)
    assert client.receive().log_time == 101


def test_listener_that_repairs_nothing_shows_nothing_that_it_rejects(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(f"version: 1\nextends: {ROUTES}/rover.yaml\nlisten: {{rover: {{framing: exact}}}}\n")
    router = Showing(compiled(table))
    brake = envelope(router.program, "manual_brake", brake=True)
    with (
        closing(serve(router)) as server,
        FoxgloveClient(server.address.port) as client,
    ):
        client.subscribe("manual_brake")
        router.wait_for(1)
        router.show(brake + bytes(5), brake, at=100)
        assert client.receive().log_time == 101


def test_reload_keeps_channels_of_what_stays_and_brings_those_of_what_is_new(
    tmp_path: Path, program: CompiledTable, router: Showing, client: FoxgloveClient
) -> None:
    """The same protos elsewhere, in which one message has a field more."""
    protos = tmp_path / "protos"
    shutil.copytree(PROTOS, protos)
    [file] = [path for path in protos.rglob("*.proto") if "message BasestationManualBrake" in path.read_text()]
    file.write_text(
        file.read_text().replace(
            "message BasestationManualBrake {", "message BasestationManualBrake {\n  uint32 force = 77;", 1
        )
    )
    table = tmp_path / "table.yaml"
    table.write_text(f"version: 1\nextends: {ROUTES}/rover.yaml\nenvelope: {{protos: {protos}}}\n")
    before = dict(client.channels)
    client.subscribe("imu_info")
    router.wait_for(1)
    changed = router.program = compiled(table)
    client.await_change()
    while client.channels.keys() != before.keys():
        client.await_change()
    assert client.channels["imu_info"] == before["imu_info"]
    assert client.channels["manual_brake"] != before["manual_brake"]
    told: dict[str, Message] = {}
    limit = monotonic() + PATIENCE
    while "manual_brake" not in told:
        assert monotonic() < limit, told
        client.subscribe("manual_brake")  # again: the library advertises a channel before it takes any
        router.show(envelope(changed, "imu_info"), envelope(changed, "manual_brake", force=7))
        next_one = client.receive()
        told[next_one.topic] = next_one.message
    assert "imu_info" in told  # subscribed to before
    assert told["manual_brake"].force == 7  # type: ignore[attr-defined]


def test_a_fault_is_told_once_and_does_not_end_the_view(
    program: CompiledTable, router: Showing, client: FoxgloveClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = threading.Semaphore(0)

    def fail(consumer: Consumer) -> Callable[[], None]:
        faults.release()
        raise LookupError

    monkeypatch.setattr(foxglove, "LOOK_SECONDS", 0.01)
    with capture_logs() as logs:
        with monkeypatch.context() as faulty:
            faulty.setattr(router, "attach", fail)
            client.subscribe("imu_info")
            assert all(faults.acquire(timeout=PATIENCE) for _ in range(3))
        router.wait_for(1)
        router.show(envelope(program, "imu_info"))
        assert client.receive().topic == "imu_info"
    assert [each["log_level"] for each in logs] == ["critical"]


def test_router_that_is_started_again_gets_its_port_back(router: Showing) -> None:
    address = LOOPBACK
    for _ in range(3):
        with closing(serve(router, address)) as server:
            address = server.address
            with FoxgloveClient(server.address.port) as client:
                client.subscribe("imu_info")
                router.wait_for(1)
                server.close()  # while the client is there
        router.wait_for(0)


def test_an_address_that_cannot_be_had_is_told(router: Showing) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        address = Address("127.0.0.1", holder.getsockname()[1])
        with pytest.raises(StartError, match=rf"rover.yaml:8:20: .*{address}: .*\(pid \d+\) has the port"):
            serve(router, address)
    with pytest.raises(StartError, match="this machine has no such address"):
        serve(router, Address("203.0.113.1", 1))


def test_who_speaks_another_protocol_is_turned_away_without_a_word_in_the_log(
    server: FoxgloveServer, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{server.address.port}")
    server.close()
    assert "handshake" not in capfd.readouterr().err


def handshake(server: FoxgloveServer, host: str = "", *, subprotocol: str = SUBPROTOCOL, **headers: str) -> bool:
    """Whether the server lets a client in that names this host."""
    with socket.create_connection(server.address, PATIENCE) as connection:
        protocol = ClientProtocol(parse_uri(f"ws://{host or server.address}/"), subprotocols=[Subprotocol(subprotocol)])
        request = protocol.connect()
        request.headers.update(headers)
        protocol.send_request(request)
        connection.sendall(b"".join(protocol.data_to_send()))
        return connection.recv(65536).startswith(b"HTTP/1.1 101 ")


def test_pages_of_the_same_host_can_look_at_an_ipv6_address(router: Showing) -> None:
    with closing(serve(router, Address("::1", 0), [IPv4Network("10.0.0.0/8")])) as server:
        assert str(server.address).startswith("[::1]:")
        assert handshake(server)
        assert handshake(server, Origin=f"http://{server.address}")
        assert not handshake(server, Origin="http://[fd00::1]:8766")


def test_the_app_and_pages_of_the_same_host_can_look(server: FoxgloveServer) -> None:
    assert handshake(server)
    assert handshake(server, subprotocol="foxglove.websocket.v1")
    assert handshake(server, Origin=f"http://{server.address}")
    assert handshake(server, "rover.example.org", Origin="https://app.foxglove.dev")
    assert handshake(server, "rover.local:8766", Origin="https://rover.local:8766")


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("", "http://rover.example.org"),
        ("", "https://app.foxglove.dev.example.org"),
        ("", "null"),
        ("rover.example.org:8766", "http://rover.example.org:8766"),
        ("rover.example.org:8766", ""),
    ],
)
def test_pages_of_other_hosts_cannot_look(server: FoxgloveServer, host: str, origin: str) -> None:
    assert not handshake(server, host, **({"Origin": origin} if origin else {}))


def test_clients_outside_the_networks_are_refused_and_counted(router: Showing, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doors, "is_own_computer", lambda *_: False)
    REFUSED.clear()
    with capture_logs() as logs, closing(serve(router, networks=[IPv4Network("127.0.1.0/24")])) as server:
        for host, is_let_in in (("127.0.1.1", True), ("127.0.2.1", False), ("127.0.2.1", False)):
            with socket.create_connection(server.address, PATIENCE, source_address=(host, 0)) as connection:
                connection.sendall(b"GET / HTTP/1.1\r\n\r\n")
                try:
                    answer = connection.recv(1000)
                except ConnectionError:
                    answer = b""
                assert bool(answer) == is_let_in
    assert REFUSED == {"foxglove": 2}
    told = [(each["server"], each["client"]) for each in logs if each["log_level"] == "warning"]
    assert told == [("foxglove", "127.0.2.1")] * 2  # and a summary


@pytest.mark.parametrize(
    "order",
    [
        "x",
        "[]",
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": [7]}',
        '{"op": "subscribe", "subscriptions": [{"id": 0.5, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 4294967296, "channelId": 1}]}',
        '{"op": "unsubscribe", "subscriptionIds": [[]]}',
        "[" * 60_000,
    ],
)
def test_nonsense_ends_its_own_connection_only(server: FoxgloveServer, client: FoxgloveClient, order: str) -> None:
    with connect(f"ws://{server.address}", subprotocols=[Subprotocol(SUBPROTOCOL)]) as other:
        other.send(order)
        with pytest.raises(ConnectionClosedError, match="not a request of the protocol"):
            all(map(other.recv, repeat(PATIENCE)))  # information and channels come first
    client.subscribe("imu_info")


def test_a_slow_client_loses_the_oldest_messages(
    program: CompiledTable, router: Showing, client: FoxgloveClient
) -> None:
    client.subscribe("imu_info")
    router.wait_for(1)
    sent = 60 * foxglove.BACKLOG
    router_backlog = [envelope(program, "imu_info", accel_x=1.5)] * foxglove.BACKLOG
    for number in range(60):  # the client's library reads some, and then pauses
        router.show(*router_backlog, at=1 + number * foxglove.BACKLOG)
    times = [client.receive().log_time]
    while times[-1] != sent:
        times.append(client.receive().log_time)
    assert times == sorted(set(times))
    assert len(times) < sent
