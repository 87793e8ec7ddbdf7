from __future__ import annotations

import io
import json
import math
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.table import Table

from router.datagrams import Wire
from router.errors import UsageError
from router.hosts import LOOPBACK, loopback_of
from router.table import read_table
from router.table.addresses import Address
from router.table.model import RouteTable
from router.tools.board import Arrivals, Board, Change, Frames, Inbox, State
from router.tools.links import Device
from router.tools.sim_view import SimView
from router.tools.simulator import (
    STRANGER,
    Silence,
    Simulator,
    Statistics,
    Stream,
    parse_obedience,
    parse_silence,
    streams,
)
from router.tools.udp import open_udp, reachable
from router.types.table_envelopes import Envelopes
from tests.compiler.payloads import wire_of
from tests.ports import free_port
from tests.rehearsal.test_tables import TABLES

FAST = 100.0
EMPTY_PLAIN = bytes.fromhex("1200")


def simulate(simulator: Simulator, until: Callable[[], bool]) -> None:
    """Runs until the condition holds; a simulator that never gets there is stopped after 10 s."""

    def look(_: float) -> None:
        if until():
            simulator.stop()

    simulator.run(10, 0.01, look)
    assert until()


@contextmanager
def played(wire: Wire, table: RouteTable, **options: Any) -> Iterator[tuple[Simulator, socket.socket]]:
    """A fast simulator, and the socket that its endpoints send to."""
    with (
        open_udp(reachable(table.listeners["rover"].address.value), "router") as router,
        closing(Simulator(wire, table, seed=1, speed=FAST, **options)) as simulator,
    ):
        yield simulator, router


def received(router: socket.socket, wire: Wire) -> dict[str, set[str]]:
    """Payload cases by the host that sent them."""
    cases: dict[str, set[str]] = {}
    while True:
        try:
            data, peer = router.recvfrom(2000)
        except BlockingIOError:
            return cases
        cases.setdefault(peer[0], set()).add(wire.decode(data).case.name)


@pytest.mark.parametrize("source", ["board", "any"])
def test_each_endpoint_sends_its_cases_from_its_own_address(
    wire: Wire, table_path: Callable[..., Path], source: str
) -> None:
    with played(wire, read_table(table_path(source=source))) as (simulator, router):
        simulate(simulator, lambda: len(simulator.statistics.sent) == 2)
        sender = "127.0.6.30" if source == "board" else LOOPBACK
        assert received(router, wire) == {sender: {"every_kind"}, "127.0.6.10": {"plain"}}


def test_an_endpoint_sends_to_the_listener_that_believes_it(wire: Wire, table_path: Callable[..., Path]) -> None:
    path = table_path()
    radio = open_udp(Address(LOOPBACK, 0), "radio")
    listen = f"  radio: {{address: '{Address(*radio.getsockname())}', interface: lo}}\nendpoints:"
    text = path.read_text().replace("endpoints:", listen)
    path.write_text(text.replace("kind: basestation", "kind: basestation, listener: radio"))
    with radio, played(wire, read_table(path)) as (simulator, _):
        simulate(simulator, lambda: len(simulator.statistics.sent) == 2)
        assert received(radio, wire) == {"127.0.6.10": {"plain"}}


def test_endpoints_of_both_kinds_of_address_send_to_a_listener_of_their_kind(
    wire: Wire, table_path: Callable[..., Path]
) -> None:
    """The board's address is an IPv6 one, the station's an IPv4 one."""
    path, port, board = table_path(), free_port("::1"), free_port("::1")
    text = re.sub(r"127\.0\.6\.30:\d+", f'"[::1]:{board}", source_port: {board}', path.read_text())
    path.write_text(text.replace("endpoints:", f'  six: {{address: "[::1]:{port}"}}\nendpoints:', 1))
    with (
        open_udp(Address("::1", port), "six") as six,
        played(wire, read_table(path)) as (simulator, router),
        open_udp(Address("::1", 0), "peer") as peer,
    ):
        peer.sendto(EMPTY_PLAIN, ("::1", board))
        found = simulator.statistics
        simulate(simulator, lambda: len(found.sent) == 2 and bool(found.inboxes["board"].arrivals))
        assert received(six, wire) == {"::1": {"every_kind"}}
        assert received(router, wire) == {"127.0.6.10": {"plain"}}


@pytest.mark.parametrize("hosts", [["::1"], ["::1", "0.0.0.0"], ["0.0.0.0", "::1"]])
def test_what_anybody_may_send_goes_to_the_first_listener(
    wire: Wire, table_path: Callable[..., Path], hosts: list[str]
) -> None:
    path, port = table_path(source="any"), free_port("0.0.0.0")
    listeners = "".join(f"  l{at}: {{address: '{Address(host, port)}'}}\n" for at, host in enumerate(hosts))
    path.write_text(re.sub(r"  rover: .*\n", listeners, path.read_text()))
    with (
        open_udp(Address("::1", port), "six") as six,
        open_udp(Address("0.0.0.0", port), "four") as four,
        closing(Simulator(wire, read_table(path), seed=1, speed=FAST)) as simulator,
    ):
        simulate(simulator, lambda: bool(simulator.statistics.sent[STRANGER]))
        first, _ = (six, four) if hosts[0] == "::1" else (four, six)
        assert received(first, wire)[loopback_of(hosts[0])] == {"every_kind"}


def test_an_endpoint_that_is_learned_at_an_ipv6_listener_is_at_its_loopback(
    wire: Wire, table_path: Callable[..., Path]
) -> None:
    path, port = table_path(), free_port("::1")
    text = re.sub(r"127\.0\.6\.30:\d+, kind: board", "learned, kind: tool, listener: six", path.read_text())
    path.write_text(text.replace("endpoints:", f'  six: {{address: "[::1]:{port}"}}\nendpoints:', 1))
    with open_udp(Address("::1", port), "six") as six, played(wire, read_table(path)) as (simulator, _):
        simulate(simulator, lambda: len(simulator.statistics.sent) == 2)
        assert received(six, wire) == {"::1": {"every_kind"}}


def test_what_comes_back_is_counted_by_endpoint_and_case(wire: Wire, table: RouteTable) -> None:
    station = table.endpoints["station"].address.value
    with (
        closing(Simulator(wire, table, seed=1)) as simulator,
        open_udp(reachable(station)._replace(port=0), "x") as peer,
    ):
        for data in (bytes.fromhex("0a021005"), bytes.fromhex("0a021006"), b"\xff"):
            peer.sendto(data, station)
        inbox = simulator.statistics.inboxes["station"]
        simulate(simulator, lambda: bool(inbox.undecodable))
        assert {case: arrivals.count for case, arrivals in inbox.arrivals.items()} == {"every_kind": 2}
        said = json.loads(json.dumps(SimView(wire, simulator.statistics).as_json(1.0, final=True)))
        assert list(said["received"]) == ["station"]
        every_kind = said["received"]["station"]["every_kind"]
        assert (every_kind["count"], every_kind["last"]) == (2, {"i32": 6})
        assert said["undecodable"] == {"station": 1}


def test_an_endpoint_with_a_source_port_sends_from_it(wire: Wire, table_path: Callable[..., Path]) -> None:
    table = read_table(table_path(source_port=True))
    station = table.endpoints["station"]
    assert station.source_port is not None
    with played(wire, table) as (simulator, router):
        simulate(simulator, lambda: simulator.statistics.sent["station"]["plain"] > 0)
        peers = set()
        while ("127.0.6.10", station.source_port.value) not in peers:
            peers.add(router.recvfrom(2000)[1])


@pytest.mark.parametrize(("networks", "host"), [("", LOOPBACK), (", networks: [127.0.6.8/29]", "127.0.6.9")])
def test_an_endpoint_whose_address_is_learned_sends_from_where_it_can_be_learned(
    wire: Wire, table_path: Callable[..., Path], networks: str, host: str
) -> None:
    path = table_path(source_port=True)
    path.write_text(re.sub(r"127\.0\.6\.10:\d+", f"learned{networks}", path.read_text()))
    table = read_table(path)
    station = table.endpoints["station"]
    assert station.source_port is not None
    with played(wire, table) as (simulator, router):
        place, inbox = (host, station.source_port.value), simulator.statistics.inboxes["station"]

        def is_answered() -> bool:
            with suppress(BlockingIOError):
                data, peer = router.recvfrom(2000)
                if peer == place:
                    router.sendto(data, peer)
            return bool(inbox.arrivals)

        simulate(simulator, is_answered)


def test_rates_and_offsets_follow_from_seed_and_scale(wire: Wire, table: RouteTable) -> None:
    first, again = list(streams(wire, table, 5, 2.0)), list(streams(wire, table, 5, 2.0))
    assert first == again
    assert first != list(streams(wire, table, 6, 2.0))
    assert [stream.rate for stream in first] == [4.0, 4.0]


def test_a_command_is_sent_often_enough_for_its_deadman(wire: Wire, table_path: Callable[..., Path]) -> None:
    path = table_path()
    deadman = "deadman: {timeout: 200ms, send: {plain: {}}, to: [board]}"
    path.write_text(path.read_text().replace("plain: {source: station,", f"plain: {{source: station, {deadman},"))
    rates = {stream.case.name: stream.rate for stream in streams(wire, read_table(path), 5, 2.0)}
    assert rates == {"every_kind": 4.0, "plain": 50.0}


def test_a_silent_endpoint_sends_nothing_and_others_go_on(wire: Wire, table: RouteTable) -> None:
    silences = [Silence("station", 0.0, math.inf)]
    with played(wire, table, silences=silences) as (simulator, _):
        simulate(simulator, lambda: simulator.statistics.sent["board"]["every_kind"] > 5)
        assert simulator.statistics.sent["station"]["plain"] == 0


def test_a_board_tells_of_a_router_that_died(wire: Wire, table: RouteTable) -> None:
    board = table.endpoints["board"].address.value
    with (
        closing(Simulator(wire, table, seed=1)) as simulator,
        open_udp(reachable(board)._replace(port=0), "x") as router,
    ):
        router.sendto(bytes.fromhex("1200"), board)
        changes = simulator.statistics.changes
        simulate(simulator, lambda: len(changes) == 2)
        assert [change.state for change in changes] == [State.OBEYING, State.STOPPED]


def test_a_board_on_a_serial_line_is_at_a_pty(wire: Wire, line_path: Path) -> None:
    """Frames go both ways once the line is open, and when it is opened again."""
    table = read_table(line_path)
    (line,) = table.lines

    def router_opens_it(simulator: Simulator) -> Iterator[None]:
        arrivals = simulator.statistics.inboxes["board"].arrivals
        while not simulator.statistics.unsent:
            yield
        for _ in range(2):
            with closing(Device(line)) as device:
                found: set[str] = set()
                while not (found and arrivals):
                    found |= {wire.decode(frame.data).case.name for frame in device.receive()}
                    device.send(EMPTY_PLAIN)
                    yield
                assert (found, {*arrivals}) == ({"every_kind"}, {"plain"})
                arrivals.clear()
        simulator.stop()

    with played(wire, table) as (simulator, router):
        assert simulator.summary.endswith(f":{router.getsockname()[1]} and the pty {line_path.parent}/uart")
        steps = router_opens_it(simulator)
        simulator.run(10, 0.01, lambda _: next(steps, None))
        assert next(steps, "all done") == "all done"
        assert simulator.statistics.inboxes["board"].undecodable == 0
        assert {*received(router, wire)} == {"127.0.6.10"}
    assert not (line_path.parent / "uart").is_symlink()


def test_bad_frames_are_undecodable(wire: Wire, line_path: Path) -> None:
    table = read_table(line_path)
    with played(wire, table) as (simulator, _), (line_path.parent / "uart").open("wb", buffering=0) as device:
        device.write(b"\x05\x01\x00")
        simulate(simulator, lambda: simulator.statistics.inboxes["board"].undecodable == 1)


def test_a_device_that_is_there_is_not_simulated(wire: Wire, line_path: Path) -> None:
    (line_path.parent / "uart").touch()
    with pytest.raises(UsageError, match="uart is there already, so the other end of 'uart' cannot be played"):
        Simulator(wire, read_table(line_path), seed=1)


def test_names_of_nobody_are_told(wire: Wire, table_path: Callable[..., Path]) -> None:
    with pytest.raises(
        UsageError, match=r"no endpoint or payload case that is sent is called 'statoin'; did you mean 'station'\?"
    ):
        Simulator(wire, read_table(table_path()), seed=1, silences=[Silence("statoin", 0.0, 1.0)])
    with pytest.raises(UsageError, match=r"table.yaml:\d+:\d+: there is no endpoint 'bord'; did you mean 'board'\?"):
        Simulator(wire, read_table(table_path(source="bord")), seed=1)


def test_a_board_ignores_what_it_was_not_told_to_obey(wire: Wire, table: RouteTable) -> None:
    board = table.endpoints["board"].address.value
    with (
        closing(Simulator(wire, table, seed=1, obeys={"board": {"plain"}})) as simulator,
        open_udp(reachable(board)._replace(port=0), "x") as router,
    ):
        router.sendto(wire.encode(wire.case("every_kind"), wire.case("every_kind").message_class()), board)
        router.sendto(bytes.fromhex("1200"), board)
        played = simulator.statistics.inboxes["board"].board
        assert played is not None
        simulate(simulator, lambda: played.state is State.OBEYING)
        assert played.ignored == {"every_kind": 1}


def test_obedience_is_a_board_and_payload_cases_sent_to_it(wire: Wire, table: RouteTable) -> None:
    assert parse_obedience(["drive:a,b", "arm:a", "drive:c"]) == {"drive": {"a", "b", "c"}, "arm": {"a"}}
    with pytest.raises(UsageError, match="'drive' is not NAME:CASE, such as driving_board:manual_drive,drive_motor"):
        parse_obedience(["drive"])
    with pytest.raises(UsageError, match="no board that gets commands is called 'bord'; did you mean 'board'"):
        Simulator(wire, table, seed=1, obeys={"bord": {"plain"}})
    with pytest.raises(UsageError, match="nothing sends 'plian' to board; did you mean 'plain'"):
        Simulator(wire, table, seed=1, obeys={"board": {"plian"}})


def test_a_taken_address_is_named_and_leaves_nothing_open(wire: Wire, table: RouteTable) -> None:
    with (
        open_udp(table.endpoints["station"].address.value, "other"),
        pytest.raises(UsageError, match=r"station: cannot bind 127\.0\.6\.10:"),
    ):
        Simulator(wire, table, seed=1)
    with closing(Simulator(wire, table, seed=1)):
        pass


def test_stop_ends_a_run_from_another_thread(wire: Wire, table: RouteTable) -> None:
    with closing(Simulator(wire, table, seed=1)) as simulator:
        running = threading.Thread(target=simulator.run, args=(None, 1.0, lambda _: None))
        running.start()
        simulator.stop()
        running.join(10)
        assert not running.is_alive()


def test_a_silence_is_a_name_and_a_time() -> None:
    assert parse_silence("basestation:5-8") == Silence("basestation", 5.0, 8.0)
    assert parse_silence("manual_drive:0.5-") == Silence("manual_drive", 0.5, math.inf)


def test_a_silence_covers_an_endpoint_or_a_case_from_its_start_until_before_its_end(wire: Wire) -> None:
    stream = Stream("station", wire.case("plain"), rate=1.0, offset=0.0)
    for name in ("station", "plain"):
        covered = [at for at in (4.9, 5.0, 7.9, 8.0) if Silence(name, 5.0, 8.0).covers(stream, at)]
        assert covered == [5.0, 7.9]
    assert not Silence("board", 5.0, 8.0).covers(stream, 6.0)


def some_statistics(wire: Wire) -> Statistics:
    statistics = Statistics()
    board = Board("board", {"plain"}, [], statistics.changes.append)
    statistics.inboxes = {"station": Inbox(wire, "station", None), "board": Inbox(wire, "board", board)}
    statistics.sent["board"]["every_kind"] = 7
    message = wire.case("every_kind").message_class(i32=5)
    statistics.inboxes["station"].arrivals["every_kind"] = Arrivals(message, at=1.5, count=4)
    statistics.inboxes["board"].arrivals["plain"] = Arrivals(wire.case("plain").message_class(value=1.5), 2.0, 2)
    return statistics


def shown(table: Table) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=70).print(table)
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


def test_each_endpoint_and_case_has_a_line_with_its_last_value_and_boards_and_frames_one_more(wire: Wire) -> None:
    statistics = some_statistics(wire)
    frames = statistics.inboxes["station"].frames["every_kind"] = Frames()
    frames.complete, frames.incomplete = 3, 1
    statistics.inboxes["board"].undecodable = 2
    board = statistics.inboxes["board"].board
    assert board is not None
    board.ignored.update({"every_kind": 12, "plain": 1})
    view = SimView(wire, statistics)
    view.update(2.0)
    assert shown(view.table(10)) == [
        "endpoint received count /s age last value",
        "board plain 2 1.0 0.0 value=1.5",
        "station every_kind 4 2.0 0.5 i32=5",
    ]
    assert shown(view.table(2))[1:] == ["and 2 more"]
    assert shown(view.statuses()) == [
        "station every_kind: 3 frames complete, 1 incomplete",
        "board no commands yet",
        "board ignored what it does not obey: 12 every_kind, 1 plain",
        "board 2 undecodable datagrams",
    ]


def test_rates_are_those_of_the_last_seconds(wire: Wire) -> None:
    statistics = some_statistics(wire)
    view = SimView(wire, statistics)
    for second in range(1, 10):
        view.update(float(second))
    statistics.inboxes["board"].arrivals["plain"].count += 6
    view.update(10.0)
    assert view.line() == ("10 s: sent 7, received 12; board 8 (2.0/s), station 4 (0/s), board no commands yet")


def test_changes_are_told_since_a_time(wire: Wire) -> None:
    statistics = some_statistics(wire)
    statistics.changes += [Change(at, "board", State.OBEYING, "obeys commands") for at in (1.0, 2.5)]
    assert list(map(str, SimView(wire, statistics).changes(since=1.0))) == ["2.5 s: board obeys commands"]


def test_silence_hints_at_a_missing_router(wire: Wire) -> None:
    statistics = Statistics()
    statistics.sent["board"]["plain"] = 7
    view = SimView(wire, statistics)
    view.update(5.0)
    assert view.headline() == "5 s: sent 7, received 0 (is the router running with this table?)"


def test_silence_hints_at_nothing_while_nothing_is_sent(wire: Wire) -> None:
    view = SimView(wire, Statistics())
    view.update(5.0)
    assert view.headline() == "5 s: sent 0, received 0"


def test_silence_hints_at_nothing_while_only_ros_could_send(wire: Wire, table_path: Callable[..., Path]) -> None:
    path = table_path()
    text = path.read_text().replace(
        "every_kind: {source: board, destinations: [station]}", "every_kind: {source: board}"
    )
    path.write_text(text.replace("plain: {source: station,", "plain: {source: {topic: plain},"))
    with played(wire, read_table(path)) as (simulator, _):
        simulate(simulator, lambda: len(simulator.statistics.sent) == 1)
        view = SimView(wire, simulator.statistics)
        view.update(5.0)
        assert "router running" not in view.headline()


ORDERED = """
version: 1
envelope: {protos: PROTOS, message: Frame, oneof: payload}
listen: {rover: {address: "127.0.6.1:ROVER"}}
endpoints:
  board: {address: "127.0.6.30:BOARD", kind: tool}
  base: {address: "127.0.6.10:BASE", kind: tool}
routes:
  speed: {source: board, destinations: base, order: envelope.header.seq % 256}
  labelled: {source: board, destinations: base, order: message.envelope}
  nested: {source: base, destinations: board, order: envelope.seq}
  part: {source: base, destinations: board, order: round(value)}
"""


def test_what_order_compares_grows_from_message_to_message(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    text = ORDERED.replace("PROTOS", str(TABLES / "beside"))
    for name, host in (("ROVER", "127.0.6.1"), ("BOARD", "127.0.6.30"), ("BASE", "127.0.6.10")):
        text = text.replace(name, str(free_port(host)))
    path.write_text(text)
    table, frames = read_table(path), Wire(Envelopes({"": wire_of(TABLES / "beside", "Frame")[1]}))
    reads: dict[str, Callable[[Any], int]] = {
        "speed": lambda frame: frame.header.seq,
        "labelled": lambda frame: frame.labelled.envelope,
        "nested": lambda frame: frame.nested.envelope.seq,
    }
    made = {stream.case.name: stream.numbered for stream in streams(frames, table, 1, FAST)}
    assert made.pop("part") is None
    for name, numbered in made.items():
        assert numbered is not None
        frame: Any = frames.envelopes.first.message_class()
        for number, expected in ((7, 7), (numbered.type.high + 1, 0)):
            numbered.set(frame if numbered.is_beside else getattr(frame, name), number)
            assert reads[name](frame) == expected
    with played(frames, table) as (simulator, router):
        simulate(simulator, lambda: all(sum(sent.values()) > 5 for sent in simulator.statistics.sent.values()))
        found = [frames.envelopes.first.message_class.FromString(router.recv(2000)) for _ in range(12)]
    for name, read in reads.items():
        counted = [read(frame) for frame in found if frame.WhichOneof("payload") == name]
        assert counted == [*range(1, len(counted) + 1)]
