from __future__ import annotations

from types import SimpleNamespace

import pytest

from router.compiler.compiled_table import DeadmanPlan
from router.datagrams import Decoded, Wire, wire_of_protos
from router.table.model import RouteTable
from router.tools.board import FRAME_TIMEOUT, Board, Change, Frames, State, Stop, boards, is_part
from router.values.reading import payload
from tests.tables import PROTOS


def decoded(wire: Wire, case: str, *words: str) -> Decoded:
    return Decoded(wire.case(case), payload(wire.case(case), words), 0)


@pytest.fixture
def changes() -> list[Change]:
    return []


@pytest.fixture
def board(wire: Wire, changes: list[Change]) -> Board:
    """Commands are `plain`; the deadman's `every_kind` with `i32` 1 holds for 0.3 s."""
    stop = Stop("every_kind", payload(wire.case("every_kind"), ["i32=1"]), hold=0.3, text="every_kind i32=1")
    return Board("board", {"plain"}, [stop], changes.append)


def test_a_board_without_commands_waits_for_ever(board: Board, changes: list[Change]) -> None:
    board.advance(1000.0)
    assert (board.status(1000.0), changes) == ("no commands yet", [])


def test_a_board_obeys_as_long_as_commands_come(wire: Wire, board: Board) -> None:
    for tenth in range(0, 50, 9):
        board.take(tenth / 10, decoded(wire, "plain"))
        board.advance(tenth / 10)
    assert board.status(5.0) == "obeys commands"


def test_a_board_left_alone_for_a_second_stops(wire: Wire, board: Board, changes: list[Change]) -> None:
    board.take(2.0, decoded(wire, "plain"))
    board.advance(2.99)
    assert board.state is State.OBEYING
    board.advance(3.0)
    assert board.status(3.2) == "no commands for 1.2 s: stopped"
    board.take(4.5, decoded(wire, "plain"))
    assert [str(change) for change in changes] == [
        "2.0 s: board obeys commands",
        "3.0 s: board no commands for 1.0 s: stopped",
        "4.5 s: board obeys commands again, after 1.5 s",
    ]


def test_a_deadman_halts_until_it_lets_go_and_a_command_comes(wire: Wire, board: Board) -> None:
    stop, command = decoded(wire, "every_kind", "i32=1"), decoded(wire, "plain")
    board.take(1.0, stop)
    board.take(1.1, command)
    assert board.status(1.2) == "halted by a deadman for 0.2 s: every_kind i32=1"
    board.take(1.25, stop)
    board.take(1.5, command)
    assert board.status(1.9).startswith("halted by a deadman for 0.9 s")
    board.take(2.1, command)
    assert board.status(2.2) == "obeys commands"


def test_a_deadman_that_dies_and_what_is_neither_command_nor_stop_keep_no_board_going(wire: Wire, board: Board) -> None:
    board.take(1.0, decoded(wire, "every_kind", "i32=1"))
    board.take(1.9, decoded(wire, "every_kind", "i32=2"))
    board.advance(2.0)
    assert board.state is State.STOPPED


def test_a_board_that_does_not_obey_the_brake_continues_its_last_command(wire: Wire, changes: list[Change]) -> None:
    stop = Stop("every_kind", payload(wire.case("every_kind"), ["i32=1"]), hold=0.3, text="every_kind i32=1")
    board = Board("board", {"plain"}, [stop], changes.append, obeys={"plain"})
    board.take(1.0, decoded(wire, "plain"))
    for tenth in range(15, 30, 5):
        board.take(tenth / 10, decoded(wire, "every_kind", "i32=1"))
        board.advance(tenth / 10)
    assert board.ignored == {"every_kind": 3}
    assert board.status(60.0) == "no commands for 59.0 s: continues the last one"
    board.take(60.0, decoded(wire, "plain"))
    assert [str(change) for change in changes] == [
        "1.0 s: board obeys commands",
        "1.5 s: board ignores every_kind, which it does not obey",
        "2.0 s: board no commands for 1.0 s: continues the last one",
        "60.0 s: board obeys commands again, after 58.0 s",
    ]


def test_a_board_without_a_timeout_stays_halted_by_a_brake_that_it_obeys(wire: Wire, changes: list[Change]) -> None:
    stop = Stop("every_kind", payload(wire.case("every_kind"), ["i32=1"]), hold=0.3, text="every_kind i32=1")
    board = Board("board", {"plain"}, [stop], changes.append, obeys={"every_kind"})
    board.take(1.0, decoded(wire, "plain"))
    board.take(1.5, decoded(wire, "every_kind", "i32=1"))
    board.advance(60.0)
    assert (board.state, board.ignored) == (State.HALTED, {"plain": 1})


def test_only_boards_that_are_told_something_play_one_and_know_what_deadmen_send(
    wire: Wire, table: RouteTable, changes: list[Change]
) -> None:
    case = wire.case("every_kind")
    datagrams = tuple(wire.encode(case, payload(case, words)) for words in ([], ["i32=1"]))
    plan = DeadmanPlan("plain", timeout=500_000_000, repeat=100_000_000, datagrams=(("board", datagrams),))
    [board] = boards(wire, table, [plan], changes.append, {}).values()
    board.take(0.0, decoded(wire, "every_kind", "i32=1"))
    board.take(0.31, decoded(wire, "plain"))
    assert [(change.board, change.state) for change in changes] == [("board", State.HALTED), ("board", State.OBEYING)]
    assert changes[0].text == "halted by a deadman: every_kind (all default), every_kind i32=1"


def part(frame_id: int, total_count: int, index: int) -> SimpleNamespace:
    return SimpleNamespace(frame_id=frame_id, total_count=total_count, index=index)


def counts(frames: Frames) -> tuple[int, int, int]:
    return frames.complete, frames.incomplete, frames.astray


def test_copies_of_parts_make_no_frame() -> None:
    frames = Frames()
    for index in (0, 0, 1, 1, 0):
        frames.take(0, part(7, 2, index))
    frames.advance(FRAME_TIMEOUT)
    assert counts(frames) == (1, 0, 0)


def test_frames_are_counted_when_their_last_part_comes_or_it_is_too_late() -> None:
    frames = Frames()
    for index in (2, 0, 0, 1):
        frames.take(0, part(7, 3, index))
    assert counts(frames) == (1, 0, 0)
    frames.take(5, part(8, 2, 1))
    frames.advance(FRAME_TIMEOUT)
    assert counts(frames) == (1, 0, 0)
    frames.advance(5 + FRAME_TIMEOUT)
    assert counts(frames) == (1, 1, 0)
    for impossible in (part(9, 2, 2), part(9, 0, 0)):
        frames.take(0, impossible)
    assert counts(frames) == (1, 1, 2)


def test_parts_are_known_by_their_fields() -> None:
    cases = wire_of_protos(PROTOS).envelopes.first.cases
    assert [name for name, case in cases.items() if is_part(case.type)] == ["detected_object"]


def test_the_motors_turn_while_it_obeys_and_need_a_moment_to_stop(wire: Wire, board: Board) -> None:
    assert board.pace(0.0) == 0
    board.take(1.0, decoded(wire, "plain"))
    assert board.pace(1.5) == 1
    board.take(2.0, decoded(wire, "every_kind", "i32=1"))
    assert [round(board.pace(at), 3) for at in (2.0, 2.1, 2.4, 3.0)] == [1, 0.75, 0, 0]
    board.advance(3.0)
    assert (board.state, board.pace(3.1)) == (State.STOPPED, 0)
