from __future__ import annotations

import io

from rich.console import Console
from rich.table import Table

from router.engine.wire import Wire
from router.tools.board import Board, Change, State
from router.tools.frames import Frames
from router.tools.inbox import Arrivals, Inbox
from router.tools.sim_view import SimView
from router.tools.simulator import Statistics


def some_statistics(wire: Wire) -> Statistics:
    statistics = Statistics()
    board = Board("board", {"plain"}, [], statistics.changes.append)
    statistics.inboxes = {"station": Inbox(wire, None), "board": Inbox(wire, board)}
    statistics.sent["board", "every_kind"] = 7
    message = wire.case("every_kind").message_class(i32=5)
    statistics.inboxes["station"].arrivals["every_kind"] = Arrivals(message, at=1.5, count=4)
    statistics.inboxes["board"].arrivals["plain"] = Arrivals(wire.case("plain").message_class(value=1.5), 2.0, 2)
    return statistics


def shown(table: Table) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=70).print(table)
    return [" ".join(line.split()) for line in out.getvalue().splitlines()]


def test_each_endpoint_and_case_has_a_line_with_its_last_value(wire: Wire) -> None:
    view = SimView(wire, some_statistics(wire))
    view.look(2.0)
    assert shown(view.table(10)) == [
        "endpoint received count /s age last value",
        "board plain 2 1.0 0.0 value=1.5",
        "station every_kind 4 2.0 0.5 i32=5",
    ]
    assert shown(view.table(2))[1:] == ["and 2 more"]


def test_rates_are_those_of_the_last_seconds(wire: Wire) -> None:
    statistics = some_statistics(wire)
    view = SimView(wire, statistics)
    for second in range(1, 10):
        view.look(float(second))
    statistics.inboxes["board"].arrivals["plain"].count += 6
    view.look(10.0)
    assert view.line() == ("10 s: sent 7, received 12; board 8 (2.0/s), station 4 (0/s), board no commands yet")


def test_boards_frames_and_undecodable_datagrams_have_a_line_each(wire: Wire) -> None:
    statistics = some_statistics(wire)
    frames = statistics.inboxes["station"].frames["every_kind"] = Frames()
    frames.complete, frames.incomplete = 3, 1
    statistics.inboxes["board"].undecodable = 2
    view = SimView(wire, statistics)
    view.look(2.0)
    assert shown(view.conditions()) == [
        "station every_kind: 3 frames complete, 1 incomplete",
        "board no commands yet",
        "board 2 undecodable datagrams",
    ]


def test_changes_are_told_since_a_time(wire: Wire) -> None:
    statistics = some_statistics(wire)
    statistics.changes += [Change(at, "board", State.OBEYING, "obeys commands") for at in (1.0, 2.5)]
    assert list(map(str, SimView(wire, statistics).changes(since=1.0))) == ["2.5 s: board obeys commands"]


def test_silence_hints_at_a_missing_router(wire: Wire) -> None:
    view = SimView(wire, Statistics())
    view.look(5.0)
    assert view.headline() == "5 s: sent 0, received 0 (is the router running with this table?)"
