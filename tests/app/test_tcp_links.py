"""Boards on TCP connections: the router connects, or boards do; and what happens when they stop reading or vanish."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

import pytest
from structlog.testing import capture_logs

from router.app import Router
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.hosts import bracketed
from router.net.addresses import family
from tests.acceptance.site import wait_until
from tests.app.conftest import BRAKE, DRIVE, let_rest, numbered, udp
from tests.app.test_links import LIMIT, counted
from tests.namespaces import Computer, cable, computers
from tests.oracles.framings import Framing, decoded, encoded
from tests.ports import free_port
from tests.tables import PROTOS

VARINT = Framing("varint")


class Connection:
    """A connection of a board to the router."""

    def __init__(self, opened: socket.socket) -> None:
        self.socket, self.received = opened, b""
        opened.setblocking(False)

    def send(self, *payloads: bytes) -> None:
        for payload in payloads:
            self.socket.sendall(encoded(VARINT, payload))

    def frames(self) -> list[bytes | str]:
        """What has arrived."""
        try:
            while data := self.socket.recv(65536):
                self.received += data
        except OSError:  # nothing is there, or it was reset
            pass
        return decoded(VARINT, self.received, LIMIT)[0]

    def await_frames(self, count: int) -> list[bytes | str]:
        wait_until(lambda: len(self.frames()) >= count)
        return self.frames()

    @property
    def has_ended(self) -> bool:
        """Whether the router has closed it."""
        try:
            return not self.socket.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True


class Site:
    """An operator and a basestation on UDP; boards on TCP."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.timeout = "200ms"
        """Of the deadman; a connection is closed when nothing is acknowledged for 3/4 of it."""
        self.operator, self.basestation = udp("127.0.0.30"), udp("127.0.0.1")
        self.port, self.tcp = free_port(), free_port()
        self.opened = ExitStack()

    def program(self, listener: str, endpoints: str) -> CompiledTable:
        path = self.folder / "table.yaml"
        basestation = self.basestation.getsockname()[1]
        path.write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:{self.port}"}}
  tcp: {{{listener}, framing: varint}}
endpoints:
  operator: {{address: 127.0.0.30:8, kind: tool}}
  basestation: {{address: "127.0.0.1:{basestation}", kind: basestation}}
{endpoints}
routes:
  ph_info: {{source: board, destinations: [basestation]}}
  manual_drive:
    source: operator
    destinations: [board]
    deadman: {{timeout: {self.timeout}, repeat: 50ms, send: {{manual_brake: {{brake: true}}}}, to: [board]}}
""")
        checked = check_table(path, {})
        assert checked.program is not None, "\n".join(map(str, checked.diagnostics))
        return checked.program

    def client(self, host: str = "127.0.0.1") -> CompiledTable:
        """The table of a router that connects to its board."""
        return self.program(f'connect: "{bracketed(host)}:{self.tcp}"', "  board: {listener: tcp, kind: board}")

    def server(self, *more: str, host: str = "127.0.0.1", board: str = "127.0.0.41") -> CompiledTable:
        """The table of a router that its board connects to."""
        line = f'  board: {{listener: tcp, address: "{board}", kind: board}}'
        return self.program(f'accept: "{bracketed(host)}:{self.tcp}"', "\n".join([line, *more]))

    def listening(self, host: str = "127.0.0.1", room: int | None = None) -> socket.socket:
        """Listen for the router, as a board."""
        opened = self.opened.enter_context(socket.socket(family(host)))
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if room is not None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
        opened.bind((host, self.tcp))
        opened.listen()
        opened.settimeout(10)
        return opened

    def accepted(self, listening: socket.socket) -> Connection:
        return Connection(self.opened.enter_context(listening.accept()[0]))

    def connected(self, host: str = "127.0.0.41", router: str = "127.0.0.1") -> Connection:
        """Connect to the router, as a board."""
        connection: list[socket.socket] = []

        def connects() -> bool:
            try:
                connection.append(socket.create_connection((router, self.tcp), 10, (host, 0)))
            except ConnectionRefusedError:
                return False
            return True

        wait_until(connects)
        return Connection(self.opened.enter_context(connection[0]))

    def drive(self) -> None:
        self.operator.sendto(DRIVE, ("127.0.0.1", self.port))

    def close(self) -> None:
        self.opened.close()
        self.operator.close()
        self.basestation.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.close()


def test_the_router_connects_to_a_board_that_gets_its_brake_first(site: Site) -> None:
    with site.listening() as listening, Router(site.client()) as router:
        board = site.accepted(listening)
        assert board.await_frames(1) == [BRAKE]
        board.send(numbered(1), numbered(2))
        assert [site.basestation.recv(100) for _ in range(2)] == [numbered(1), numbered(2)]
        site.drive()
        assert board.await_frames(3)[:3] == [BRAKE, DRIVE, BRAKE]
        assert counted(router, "link_up", "board") == 1


def test_a_board_that_comes_later_is_connected_to_and_gets_nothing_that_waited(site: Site) -> None:
    with capture_logs() as log, Router(site.client()) as router:
        wait_until(lambda: any(each.get("why") == "nothing listens there" for each in log))
        site.drive()
        wait_until(lambda: counted(router, "messages_dropped", "manual_drive", "board", "send_error") == 1)
        with site.listening() as listening:
            board = site.accepted(listening)
            assert board.await_frames(1)[0] == BRAKE
            sleep(0.1)
            assert DRIVE not in board.frames()


def test_a_board_that_is_restarted_is_braked_before_it_is_commanded(site: Site) -> None:
    with site.listening() as listening, Router(site.client()) as router:
        first = site.accepted(listening)
        first.await_frames(1)
        first.send(numbered(1))
        first.socket.close()
        wait_until(lambda: not counted(router, "link_up", "board"))
        site.drive()
        again = site.accepted(listening)
        site.drive()
        assert again.await_frames(1)[0] == BRAKE
        wait_until(lambda: counted(router, "link_openings", "board") == 2)
        site.drive()
        wait_until(lambda: DRIVE in again.frames())


def test_boards_on_a_server_are_told_apart_by_their_addresses(site: Site) -> None:
    lander = "  lander: {listener: tcp, address: 127.0.0.42, kind: board}"
    program = site.server(lander)
    path = program.table.path
    path.write_text(path.read_text() + "  imu_info: {source: lander, destinations: [basestation]}\n")
    checked = check_table(path, {})
    assert checked.program is not None
    imu = bytes.fromhex("6a00")
    with Router(checked.program) as router:
        board, other = site.connected(), site.connected("127.0.0.42")
        assert board.await_frames(1) == [BRAKE]
        wait_until(lambda: counted(router, "link_up", "lander") == 1)
        board.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        other.send(imu, numbered(2))
        assert site.basestation.recv(100) == imu
        wait_until(lambda: counted(router, "datagrams_rejected", "tcp", "source_mismatch") == 1)
        site.drive()
        wait_until(lambda: DRIVE in board.frames())
        assert other.frames() == []


def test_a_connection_from_another_address_is_refused_and_counted(site: Site) -> None:
    with capture_logs() as log, Router(site.server()) as router:
        with suppress(ConnectionResetError):  # before `connect` has returned
            stranger = site.connected("127.0.0.9")
            wait_until(lambda: stranger.has_ended)
        wait_until(lambda: counted(router, "datagrams_rejected", "tcp", "source_mismatch") == 1)
        wait_until(lambda: any("has this address" in each.get("detail", "") for each in log))
        assert counted(router, "link_up", "board") == 0


def test_a_bad_frame_of_a_board_is_not_said_to_be_a_stranger(site: Site) -> None:
    with capture_logs() as log, Router(site.server()):
        site.connected().socket.sendall(b"\xff\xff\xff\xff\x0f\x00")
        wait_until(lambda: any(each.get("reason") == "bad_frame" for each in log))
    assert [each["detail"] for each in log if each.get("reason") == "bad_frame"] == ["from 127.0.0.41"]


def test_a_board_that_connects_again_is_the_one_that_counts(site: Site) -> None:
    """The earlier connection may be half-open: the board was reset."""
    with Router(site.server()) as router:
        first = site.connected()
        first.await_frames(1)
        again = site.connected()
        assert again.await_frames(1)[0] == BRAKE
        wait_until(lambda: first.has_ended)
        again.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        assert counted(router, "link_openings", "board") == 2


def test_a_board_that_does_not_read_loses_its_own_commands_and_its_connection(site: Site) -> None:
    """Before its deadman would have noticed: then it is braked first on the next connection."""
    with site.listening(room=2048) as listening, Router(site.client()) as router:
        board = site.accepted(listening)
        board.await_frames(1)
        for _ in range(3000):
            site.drive()
        wait_until(lambda: counted(router, "link_openings", "board") == 2)
        assert counted(router, "messages_dropped", "manual_drive", "board", "send_buffer_full")
        again = site.accepted(listening)
        assert again.await_frames(1)[0] == BRAKE


def test_a_frame_whose_length_is_wrong_has_the_router_connect_again(site: Site) -> None:
    with site.listening() as listening, Router(site.client()) as router:
        board = site.accepted(listening)
        board.await_frames(1)
        board.socket.sendall(b"\xff\xff\xff\xff\x0f")
        again = site.accepted(listening)
        assert again.await_frames(1)[0] == BRAKE
        assert counted(router, "datagrams_rejected", "tcp", "bad_frame") == 1


def test_the_last_brake_arrives_at_the_stop(site: Site) -> None:
    with site.listening() as listening:
        with Router(site.client()):
            board = site.accepted(listening)
            board.await_frames(1)
            site.drive()
            wait_until(lambda: DRIVE in board.frames())
        assert board.frames()[-1] == BRAKE


def test_a_reload_keeps_connections(site: Site) -> None:
    site.timeout = "2s"
    with Router(site.server()) as router:
        board = site.connected()
        board.await_frames(1)
        path = site.server().table.path
        path.write_text(path.read_text() + "  imu_info: {ignore: nobody}\n")
        let_rest(path)
        router.reload()
        board.send(numbered(1))
        assert site.basestation.recv(100) == numbered(1)
        assert counted(router, "link_openings", "board") == 1


def test_a_server_whose_port_is_taken_listens_as_soon_as_it_is_free(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.log.SUMMARY_INTERVAL_NS", 0)  # log each change
    with site.listening() as other, capture_logs() as log, Router(site.server()):
        wait_until(lambda: any("has the port" in each.get("why", "") for each in log))
        other.close()
        wait_until(lambda: [each["why"] for each in log if "why" in each][-1] == "it has not connected yet")
        assert site.connected().await_frames(1)[0] == BRAKE


@dataclass
class Network:
    """A rover and a board on a cable, with their addresses. The board's computer also has that of a stranger."""

    rover: Computer
    at_board: Computer
    host: str
    board: str
    stranger: str

    def pull(self) -> None:
        """End the network without a word."""
        self.at_board.ip("link", "set", "eth0", "down")

    def plug_in(self) -> None:
        self.at_board.ip("link", "set", "eth0", "up")
        for host in (self.board, self.stranger):  # without a link there are no IPv6 addresses
            self.at_board.ip("address", "replace", f"{host}/{64 if ':' in host else 24}", "dev", "eth0")


@pytest.fixture(params=[("10.78.1.{}", 24), ("fd00:78::{}", 64)], ids=["IPv4", "IPv6"])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    pattern, size = request.param
    host, board, stranger = (pattern.format(number) for number in (1, 2, 3))
    with computers("rover", "board") as (rover, at_board):
        cable(rover, "eth0", f"{host}/{size}", at_board, "eth0", f"{board}/{size}")
        network = Network(rover, at_board, host, board, stranger)
        network.plug_in()
        yield network


@contextmanager
def running(router: Router, network: Network) -> Iterator[None]:
    network.rover.inside(router.__enter__)
    try:
        yield
    finally:
        router.__exit__(None, None, None)


@pytest.mark.parametrize(("commands", "limit"), [("flow", 1.0), ("have ended", 4.0)])
def test_a_board_that_vanishes_is_noticed_before_its_deadman(
    commands: str, limit: float, network: Network, tmp_path: Path
) -> None:
    """Without commands, that matters less. It is braked first when it is back."""
    with closing(network.rover.inside(lambda: Site(tmp_path))) as site:
        site.timeout = "1s"
        router = Router(site.client(network.board))
        listening = network.at_board.inside(lambda: site.listening(network.board))
        with running(router, network):
            board = site.accepted(listening)
            board.await_frames(1)
            for _ in range(20 if commands == "flow" else 0):
                site.drive()
                sleep(0.01)
            network.pull()
            began = monotonic()
            while counted(router, "link_up", "board"):
                if commands == "flow":
                    site.drive()
                sleep(0.005)
            assert monotonic() - began < limit
            network.plug_in()
            again = site.accepted(listening)
            assert again.await_frames(1)[0] == BRAKE


def test_a_board_that_vanished_may_return_from_another_port_but_not_from_another_address(
    network: Network, tmp_path: Path
) -> None:
    """Before the router has noticed, too. Commands of meanwhile are not sent to it."""
    with closing(network.rover.inside(lambda: Site(tmp_path))) as site:
        router = Router(site.server(host=network.host, board=network.board))
        with running(router, network):
            first = network.at_board.inside(lambda: site.connected(network.board, network.host))
            first.await_frames(1)
            network.pull()
            site.drive()
            wait_until(lambda: counted(router, "datagrams_sent", "manual_drive", "board") == 1)
            network.plug_in()
            again = network.at_board.inside(lambda: site.connected(network.board, network.host))
            assert again.await_frames(1)[0] == BRAKE
            assert counted(router, "link_openings", "board") == 2
            with suppress(ConnectionResetError):  # before `connect` has returned
                stranger = network.at_board.inside(lambda: site.connected(network.stranger, network.host))
                wait_until(lambda: stranger.has_ended)
            wait_until(lambda: counted(router, "datagrams_rejected", "tcp", "source_mismatch") == 1)
            assert DRIVE not in again.frames()
            site.drive()
            wait_until(lambda: DRIVE in again.frames())
            assert DRIVE not in first.frames()
            assert counted(router, "link_openings", "board") == 2
