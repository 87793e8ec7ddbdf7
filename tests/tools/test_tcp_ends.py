"""Both ends of TCP connections, with the router as client and as server."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest

from router.app import Router
from router.carrier.frames import Frame
from router.cli import main
from router.compiler import check_table
from router.datagrams import Wire
from router.errors import UsageError
from router.recording.mirror import Mirrored, MirroredDatagram
from router.table import read_table
from router.table.addresses import Address
from router.tools.board import State
from router.tools.link_end import LinkEnd
from router.tools.links import board_end, boards_at, router_ends
from router.tools.simulator import Simulator, parse_silence
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.tables import PROTOS
from tests.tools.test_links import EMPTY_PLAIN, EVERY_KIND, verb

Tables = Callable[[str], Path]


def taken(end: LinkEnd, count: int) -> list[Frame]:
    """Return frames that arrive, on however many connections."""
    frames: list[Frame] = []

    def are_there() -> bool:
        if end.is_open:
            try:
                frames.extend(end.receive())
            except OSError:
                assert not end.fileno() >= 0
        return len(frames) >= count

    wait_until(are_there)
    return frames


def await_open(*ends: LinkEnd) -> None:
    def are_open() -> bool:
        opened = [end.is_open for end in ends]  # each has to do its part
        return all(opened)

    wait_until(are_open)


def boards_of(path: Path) -> list[LinkEnd]:
    table = read_table(path)
    return [board_end(table.links[0], board) for board in boards_at(table.links[0], table)]


@contextmanager
def ends(path: Path, role: str) -> Iterator[list[LinkEnd]]:
    """The ends of the boards, or those of the router."""
    table = read_table(path)
    link = table.links[0]
    boards = boards_at(link, table)
    with ExitStack() as opened:
        found = router_ends(link, boards) if role == "router" else boards_of(path)
        yield [opened.enter_context(closing(end)) for end in found]


@pytest.mark.parametrize("way", ["connect", "accept", "connect IPv6", "accept IPv6"])
def test_frames_go_from_one_end_to_the_other_and_connections_begin_again(tcp_path: Tables, way: str) -> None:
    path = tcp_path(way)
    with ends(path, "board") as boards:
        for _ in range(2):
            with ends(path, "router") as routers:
                for board, router in zip(boards, routers, strict=True):
                    await_open(board, router)
                    board.send(EVERY_KIND)
                    board.send(EMPTY_PLAIN)
                    assert taken(router, 2) == [Frame(EVERY_KIND), Frame(EMPTY_PLAIN)]
                    router.send(EMPTY_PLAIN)
                    assert taken(board, 1) == [Frame(EMPTY_PLAIN)]
            for board in boards:
                with pytest.raises(ConnectionResetError):
                    board.receive()
                with pytest.raises(OSError, match="not connected"):
                    board.send(EMPTY_PLAIN)


def test_a_server_takes_the_newest_connection_of_a_board_and_no_strangers(tcp_path: Tables) -> None:
    path = tcp_path("accept")
    with ends(path, "router") as (router, _), ends(path, "board") as (old, _), ends(path, "board") as (new, _):
        address = read_table(path).links[0].address.value
        with socket.create_connection(address, 5) as stranger:
            wait_until(lambda: old.is_open and router.is_open)
            assert stranger.recv(1) == b""
        wait_until(lambda: new.is_open)
        new.send(EVERY_KIND)
        assert taken(router, 1) == [Frame(EVERY_KIND)]
        with pytest.raises(ConnectionResetError):
            old.receive()


def test_addresses_that_cannot_be_bound_are_told(tcp_path: Tables) -> None:
    path = tcp_path("connect")
    with ends(path, "board"), pytest.raises(UsageError, match=r"'tcp': cannot bind 127.*: another process"):
        boards_of(path)
    path.write_text(path.read_text().replace('connect: "127.0.0.1', 'connect: "[fe80::1%nowhere0]'))
    with pytest.raises(UsageError, match=r"cannot bind \[fe80::1%nowhere0\]"):
        boards_of(path)
    path.write_text(path.read_text().replace('connect: "[fe80::1%nowhere0]', 'connect: "127.0.0.1'))
    path.write_text(path.read_text().replace('connect: "127.0.0.1', 'connect: "192.0.2.1'))
    program = check_table(path, {}).program
    assert program is not None
    with pytest.raises(UsageError, match=r"cannot bind 192\.0\.2\.1") as raised:
        Simulator(Wire(program.envelopes), program.table, 1)
    assert "addresses of this computer" in raised.value.hint


@pytest.mark.parametrize(("way", "origin"), [("connect", ()), ("accept", ("--from", "board"))])
def test_send_plays_the_board_for_the_router(tcp_path: Tables, way: str, origin: tuple[str, ...]) -> None:
    path = tcp_path(way)
    words = ["send", "every_kind", "i32=5", "--to", "tcp", "--count", "3", *origin]
    with verb(*words, "-t", path) as sender, ends(path, "router") as (router, *_):
        assert taken(router, 3) == [Frame(EVERY_KIND)] * 3
        out, err = sender.communicate(timeout=30)
    assert out.startswith("sent every_kind to tcp 3 times")
    assert err.startswith("waiting for the router to ")


@pytest.mark.parametrize("way", ["connect", "accept"])
def test_send_sends_to_the_board_as_the_router_does(tcp_path: Tables, way: str) -> None:
    path = tcp_path(way)
    with ends(path, "board") as (board, *_), verb("send", "plain", "--to", "board", "-t", path) as sender:
        assert taken(board, 1) == [Frame(EMPTY_PLAIN)]
        assert sender.communicate(timeout=30)[0] == "sent plain to board: 2 bytes 1200\n"


def test_send_says_what_is_wrong(tcp_path: Tables, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["send", "plain", "--to", "board", "-t", str(tcp_path("connect"))]) == 1
    assert "'tcp' is closed: nothing listens there" in capsys.readouterr().err
    path = str(tcp_path("accept"))
    assert main(["send", "plain", "--to", "tcp", "-t", path]) == 2
    assert "several boards connect to 'tcp'" in capsys.readouterr().err
    assert main(["send", "plain", "--to", "tcp", "--from", "station", "-t", path]) == 2
    assert "what is sent to 'tcp' is not from station" in capsys.readouterr().err


@pytest.mark.parametrize("way", ["connect", "accept"])
def test_listen_shows_what_the_board_gets(tcp_path: Tables, way: str) -> None:
    path = tcp_path(way)
    with verb("listen", "envelope://board", "--count", "1", "-t", path) as tap, ends(path, "router") as (router, *_):
        wait_until(lambda: router.is_open)
        router.send(EMPTY_PLAIN)
        out, _ = tap.communicate(timeout=30)
    assert out.split(" ", 1)[1] == "tcp plain (all default)\n"


@pytest.mark.parametrize("way", ["connect", "accept", "accept IPv6"])
def test_listen_shows_what_all_boards_send(tcp_path: Tables, way: str) -> None:
    path = tcp_path(way)
    with ends(path, "board") as boards:
        names = ["board", "other"][: len(boards)]
        with verb("listen", "envelope://tcp", "--count", str(len(boards)), "-t", path) as tap:
            for board in boards:
                await_open(board)
                board.send(EMPTY_PLAIN)
            out, _ = tap.communicate(timeout=30)
    assert sorted(line.split(" ", 1)[1] for line in out.splitlines()) == [
        f"{name} plain (all default)" for name in names
    ]


@pytest.mark.parametrize("way", ["connect", "accept", "connect IPv6", "accept IPv6"])
def test_a_router_and_a_simulated_board_on_one_machine(tmp_path: Path, way: str) -> None:
    """The board sends and obeys, and halts when the commands stop. What the router receives can be sent again."""
    way, _, is_ipv6 = way.partition(" ")
    host, board = ("::1", "::1") if is_ipv6 else ("127.0.0.1", "127.0.6.30")
    server = Address(host, free_port(host, socket.SOCK_STREAM))
    address = f', address: "{board}"' if way == "accept" else ""
    (tmp_path / "table.yaml").write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen:
  rover: {{address: "127.0.0.1:{free_port()}"}}
  tcp: {{{way}: "{server}", framing: varint}}
endpoints:
  operator: {{address: "127.0.6.10:{free_port("127.0.6.10")}", kind: tool}}
  lander: {{listener: tcp, kind: board{address}}}
routes:
  ph_info: {{source: lander, destinations: [operator]}}
  manual_drive:
    source: operator
    destinations: [lander]
    deadman: {{timeout: 200ms, repeat: 50ms, send: {{manual_brake: {{brake: true}}}}, to: [lander]}}
""")
    program = check_table(tmp_path / "table.yaml", {}).program
    assert program is not None
    wire, silence = Wire(program.envelopes), parse_silence("operator:2-30")
    simulator = Simulator(wire, program.table, 1, deadmen=program.deadmen, silences=[silence])
    inboxes, mirrored = simulator.statistics.inboxes, list[Mirrored]()

    def look(_: float) -> None:
        states = [change.state for change in simulator.statistics.changes]
        if inboxes["operator"].arrivals and State.OBEYING in states and states[-1] is State.HALTED:
            simulator.stop()

    with closing(simulator), Router(program) as router:
        detach = router.mirror.attach(mirrored.extend)
        assert simulator.run(20, 0.05, look) < 20
        detach()
    assert ("tcp", "lander") in {
        (datagram.listener, datagram.endpoint) for datagram in map(MirroredDatagram._make, mirrored)
    }
    assert inboxes["lander"].undecodable == 0


@pytest.mark.parametrize("way", ["connect", "accept"])
def test_a_router_gets_all_that_is_sent_before_the_end(tcp_path: Tables, way: str) -> None:
    path = tcp_path(way)
    origin = ["--from", "board"] if way == "accept" else []
    program = check_table(path, {}).program
    assert program is not None
    mirrored = list[Mirrored]()
    with Router(program) as router:
        detach = router.mirror.attach(mirrored.extend)
        assert main(["send", "every_kind", "i32=5", "--to", "tcp", "--count", "50", *origin, "-t", str(path)]) == 0
        wait_until(lambda: len(mirrored) >= 50)
        detach()
    assert {MirroredDatagram._make(each).endpoint for each in mirrored} == {"board"}
