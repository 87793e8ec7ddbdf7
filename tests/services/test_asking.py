"""What endpoints get that call a service."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import pytest

from router.compiler.compiled_table import CalledPlan
from router.services.asking import MOST_OPEN, Asking
from router.services.calls import NEVER
from tests.small_tables import MS

HEADER = b"\x00\x01\x00\x00"
KEPT = struct.pack("<Q", 77)
REQUEST, RESPONSE = HEADER + KEPT + b"\x01", HEADER + b"\x02"
PLAN = CalledPlan(
    name="home",
    service="get_home",
    type_name="std_srvs/srv/SetBool",
    definitions={},
    kept=8,
    timeout=500 * MS,
    reasons={outcome: outcome for outcome in ("timed_out", "busy", "unsent", "cancelled")},
    span=SimpleNamespace(),  # type: ignore[arg-type]
)
HOME = "service.home"


class World:
    """The effects: a server that may be missing, and an endpoint."""

    def __init__(self) -> None:
        self.is_there = self.is_reachable = True
        self.asked: list[bytes] = []
        self.replies: list[tuple[bool, bytes]] = []
        self.outcomes: list[tuple[str, int]] = []

    def ask(self, plan: CalledPlan, request: bytes) -> int | None:
        if not self.is_there:
            return None
        self.asked.append(request)
        return len(self.asked)

    def reply(self, plan: CalledPlan, message: bytes, *, is_response: bool) -> bool:
        self.replies.append((is_response, message))
        return self.is_reachable

    def finished(self, plan: CalledPlan, outcome: str, duration: int) -> None:
        self.outcomes.append((outcome, duration // MS))


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def asking(world: World) -> Asking:
    return Asking([PLAN], world)


def failed(why: str) -> tuple[bool, bytes]:
    return False, HEADER + KEPT + struct.pack("<I", len(why) + 1) + why.encode() + b"\0"


def test_a_response_goes_back_with_what_was_kept_of_the_request(asking: Asking, world: World) -> None:
    asking.request(HOME, REQUEST, 0)
    assert world.asked == [HEADER + b"\x01"]
    assert asking.open_requests() == {"home": 1}
    asking.response(HOME, 1, RESPONSE, 20 * MS)
    assert world.replies == [(True, HEADER + KEPT + b"\x02")]
    assert world.outcomes == [("answered", 20)]
    asking.response(HOME, 1, RESPONSE, 30 * MS)  # a second one
    assert len(world.replies) == 1


def test_without_a_server_the_reply_comes_at_once(asking: Asking, world: World) -> None:
    world.is_there = False
    asking.request(HOME, REQUEST, 0)
    assert world.replies == [failed("unsent")]
    assert asking.due == NEVER


def test_a_late_response_is_ignored(asking: Asking, world: World) -> None:
    asking.request(HOME, REQUEST, 0)
    assert asking.due == 500 * MS
    asking.serve(499 * MS)
    assert not world.replies
    asking.serve(500 * MS)
    asking.response(HOME, 1, RESPONSE, 501 * MS)
    assert world.replies == [failed("timed_out")]
    assert world.outcomes == [("timed_out", 500)]


def test_open_requests_are_bounded(asking: Asking, world: World) -> None:
    for _ in range(MOST_OPEN + 1):
        asking.request(HOME, REQUEST, 0)
    assert len(world.asked) == MOST_OPEN
    assert world.replies == [failed("busy")]


def test_a_reply_that_does_not_fit_the_endpoint_is_told_from_others(asking: Asking, world: World) -> None:
    world.is_reachable = False
    asking.request(HOME, REQUEST, 0)
    asking.response(HOME, 1, RESPONSE, 0)
    assert world.outcomes == [("refused", 0)]


def test_all_requests_can_be_ended(asking: Asking, world: World) -> None:
    asking.request(HOME, REQUEST, 0)
    asking.end(0)
    asking.end(0)
    assert world.replies == [failed("cancelled")]


def test_requests_of_an_earlier_table_are_ignored(asking: Asking, world: World) -> None:
    asking.request("service.gone", REQUEST, 0)
    assert not world.asked
