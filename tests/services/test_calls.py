"""Which reply answers which call, and how calls end without one."""

from __future__ import annotations

import struct
from collections.abc import Mapping

import pytest

from router.compiler.compiled_table import CompiledTable, ServicePlan
from router.services.calls import NEVER, Calls
from tests.small_tables import MS

ARM, AGAIN, COUNT = "service.arm", "service.arm_again", "service.count"
HEADER = b"\x00\x01\x00\x00"
TRUE, REQUEST = HEADER + b"\x01", HEADER + b"\x00"
"""A response and a request, whose contents calls do not read."""


class Board:
    """The effects of calls: a board that keeps what it gets, and clients that keep what they get."""

    def __init__(self, program: CompiledTable) -> None:
        self.envelope = program.envelopes.first.message_class
        self.got: list[int] = []
        """The numbers of the requests."""
        self.refuses = ""
        self.answers: dict[str, bytes] = {}
        self.outcomes: list[tuple[str, str, int]] = []
        self.missed: list[tuple[str, int | None]] = []
        self._number = 0

    def send(self, plan: ServicePlan, request: bytes, called_at: int) -> bytes | str:
        if self.refuses:
            return self.refuses
        self._number += 1
        self.got.append(self._number)
        datagram: bytes = self.envelope(req_id=self._number, arm_request={}).SerializeToString()
        return datagram

    def send_again(self, plan: ServicePlan, datagram: bytes) -> str | None:
        if not self.refuses:
            self.got.append(self.envelope.FromString(datagram).req_id)  # type: ignore[attr-defined]
        return self.refuses or None

    def answer(self, plan: ServicePlan, caller: str, response: bytes) -> None:
        assert caller not in self.answers, f"{caller} is answered twice"
        self.answers[caller] = response

    def ended(self, plan: ServicePlan, outcome: str, duration: int) -> None:
        self.outcomes.append((plan.name, outcome, duration // MS))

    def unmatched(self, plan: ServicePlan, number: int | None) -> None:
        self.missed.append((plan.name, number))


def numbered(number: int) -> bytes:
    return HEADER + struct.pack("<Q", number) + TRUE[4:]


@pytest.fixture
def board(program: CompiledTable) -> Board:
    return Board(program)


@pytest.fixture
def calls(program: CompiledTable, board: Board) -> Calls[str]:
    return Calls(program.services, program.envelopes, board)


def responses(program: CompiledTable, name: str) -> Mapping[str, bytes]:
    return next(plan.responses for plan in program.services if plan.name == name)


def test_replies_answer_their_calls_in_any_order(calls: Calls[str], board: Board) -> None:
    for caller in "abc":
        calls.call(ARM, caller, REQUEST, 0, 0)
    assert board.got == [1, 2, 3]
    for number in (3, 1, 2):
        both(calls, number, 10 * MS)
    assert list(board.answers) == ["c", "a", "b"]
    assert set(board.answers.values()) == {TRUE}
    assert board.outcomes == [("arm", "answered", 10)] * 3
    assert not board.missed
    assert calls.due == NEVER


def both(calls: Calls[str], number: int, now: int) -> None:
    """A reply for both services that get the same replies."""
    calls.reply(ARM, numbered(number), now)
    calls.reply(AGAIN, numbered(number), now)


def test_a_reply_goes_to_the_service_whose_call_it_answers(calls: Calls[str], board: Board) -> None:
    calls.call(ARM, "a", REQUEST, 0, 0)
    calls.call(AGAIN, "b", REQUEST, 0, 0)
    both(calls, 2, 0)
    both(calls, 1, 0)
    assert [(name, outcome) for name, outcome, _ in board.outcomes] == [("arm_again", "answered"), ("arm", "answered")]
    assert not board.missed


@pytest.mark.parametrize("label", [ARM, AGAIN])
def test_a_second_reply_is_unmatched(calls: Calls[str], board: Board, label: str) -> None:
    calls.call(label, "a", REQUEST, 0, 0)
    both(calls, 1, 0)
    both(calls, 1, 0)
    assert board.answers == {"a": TRUE}
    assert board.missed == [("arm_again", 1)]


def test_the_same_request_is_sent_again_until_the_call_times_out(
    calls: Calls[str], board: Board, program: CompiledTable
) -> None:
    calls.call(ARM, "a", REQUEST, 0, 0)
    for now in (499, 500, 999, 1000, 1499):
        calls.serve(now * MS)
    assert board.got == [1, 1, 1]
    assert not board.answers
    assert calls.due == 1500 * MS
    calls.serve(1500 * MS)
    assert board.answers == {"a": responses(program, "arm")["timed_out"]}
    assert b"arm_board did not reply within 500 ms" in board.answers["a"]
    assert board.outcomes == [("arm", "timed_out", 1500)]
    both(calls, 1, 1501 * MS)
    assert board.missed == [("arm_again", 1)]


def test_a_reply_to_a_request_that_was_sent_again_answers(calls: Calls[str], board: Board) -> None:
    calls.call(ARM, "a", REQUEST, 0, 0)
    calls.serve(500 * MS)
    both(calls, 1, 600 * MS)
    assert board.outcomes == [("arm", "answered", 600)]
    both(calls, 1, 700 * MS)  # the board has answered both
    assert board.missed == [("arm_again", 1)]


@pytest.mark.parametrize(
    ("reason", "outcome"), [("send_error", "unsent"), ("send_buffer_full", "unsent"), ("stale", "refused")]
)
def test_a_call_that_cannot_be_sent_ends_at_once(
    calls: Calls[str], board: Board, program: CompiledTable, reason: str, outcome: str
) -> None:
    board.refuses = reason
    calls.call(ARM, "a", REQUEST, 0, 7)
    assert board.answers == {"a": responses(program, "arm")[outcome]}
    assert board.outcomes == [("arm", outcome, 0)]


def test_a_call_that_cannot_be_sent_again_ends(calls: Calls[str], board: Board) -> None:
    calls.call(ARM, "a", REQUEST, 0, 0)
    board.refuses = "send_error"
    calls.serve(500 * MS)
    assert board.outcomes == [("arm", "unsent", 500)]
    assert calls.due == NEVER


def test_without_match_there_is_one_call_at_a_time(calls: Calls[str], board: Board, program: CompiledTable) -> None:
    calls.call(COUNT, "a", REQUEST, 0, 0)
    calls.call(COUNT, "b", REQUEST, 0, 0)
    assert board.answers == {"b": responses(program, "count")["busy"]}
    assert b"arm_board has not replied to an earlier call" in board.answers["b"]
    calls.reply(COUNT, numbered(0), 1 * MS)
    calls.reply(COUNT, numbered(0), 2 * MS)
    assert board.answers["a"] == TRUE
    assert board.missed == [("count", None)]
    calls.call(COUNT, "c", REQUEST, 0, 3 * MS)
    calls.reply(COUNT, numbered(0), 4 * MS)
    assert board.answers["c"] == TRUE


def test_all_calls_can_be_ended(calls: Calls[str], board: Board, program: CompiledTable) -> None:
    for caller in "ab":
        calls.call(ARM, caller, REQUEST, 0, 0)
    calls.call(COUNT, "c", REQUEST, 0, 0)
    assert calls.open_calls() == {"arm": 2, "arm_again": 0, "test": 0, "count": 1}
    calls.end(5 * MS)
    assert board.answers["a"] == board.answers["b"] == responses(program, "arm")["cancelled"]
    assert [outcome for _, outcome, _ in board.outcomes] == ["cancelled"] * 3
    assert calls.open_calls() == {"arm": 0, "arm_again": 0, "test": 0, "count": 0}


def test_a_reply_for_a_service_of_an_earlier_table_is_ignored(calls: Calls[str], board: Board) -> None:
    calls.reply("service.gone", numbered(1), 0)
    assert not board.missed
