"""A board in C with nanopb that answers clients in other processes, and calls a server, over a bad link."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from router.compiler.metrics import CALL_OUTCOMES
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.service_clients import ARM, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.acceptance.site import RouterProcess, Site, key, site, wait_until
from tests.boards.answering import AnsweringBoard
from tests.ports import free_port

BOARD = "127.0.0.50"
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/bad_tables/protos/calls, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}, framing: exact}}}}
endpoints:
  arm_board: {{address: 127.0.0.50:PORT, source_port: PORT, kind: board, set: {{req_id: sequence}}}}
services:
  arm:
    type: std_srvs/srv/SetBool
    request: {{case: arm_request, to: arm_board, fields: {{armed: data, id: sequence}}, ttl: 10s}}
    reply: {{case: arm_reply, match: envelope.req_id, fields: {{success: ok, message: str(id)}}}}
    timeout: 200ms
    retries: 2
    on_timeout: {{success: false, message: reason}}
  home:
    from: {{case: home_request, source: arm_board}}
    call: {{service: get_home, type: std_srvs/srv/SetBool, timeout: 10s, fields: {{data: fast}}}}
    reply:
      case: home_reply
      fields:
        id: request.id
        found: success
        axis: {{map: request.axis, 0: AXIS_X, else: AXIS_Y}}
        offset: request.offset
        fast: request.fast
    on_timeout: {{id: request.id, found: false, offset: len(reason)}}
routes: {{}}
"""
CLIENTS, CALLS = 3, 200
"""Processes with a client each, and calls of each that are open at the same time."""

LATE = "arm_board did not reply within 200 ms"


@dataclass
class Link:
    place: Site
    board: AnsweringBoard
    router: RouterProcess

    def outcomes(self, service: str) -> dict[str, float]:
        """How often each outcome has occurred, without those that have not."""
        return {name: count for name in CALL_OUTCOMES if (count := self.count("service_calls", service, outcome=name))}

    def count(self, metric: str, service: str, **labels: str) -> float:
        return self.place.samples()[key(f"{metric}_total", service=service, **labels)]

    def rejected(self, reason: str) -> float:
        return self.place.samples()[key("datagrams_rejected_total", listener="rover", reason=reason)]

    def held(self) -> tuple[int, int]:
        """The open descriptors and the threads of the router."""
        process = Path(f"/proc/{self.router.process.pid}")
        return len(list((process / "fd").iterdir())), len(list((process / "task").iterdir()))


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    port = free_port(BOARD)
    with site(tmp_path, {}) as place:
        table = place.table(TABLE.replace("PORT", str(port)))
        with (
            AnsweringBoard(tmp_path, (BOARD, port), (ROUTER, place.listen), seed=1) as board,
            RouterProcess(tmp_path, "-t", table) as router,
        ):
            yield Link(place, board, router)


def test_each_call_ends_once_with_its_own_answer(link: Link) -> None:
    with ExitStack() as opened:
        clients = [opened.enter_context(ServiceClients()) for _ in range(CLIENTS)]
        for each in clients:
            each.call(ARM, {"data": True})
        held = link.held()
        requests = [number % 2 == 0 for number in range(CALLS)]
        calls = [(is_on, each.begin(ARM, {"data": is_on})) for is_on in requests for each in clients]
        ended = [(is_on, response.get(timeout=PATIENCE)) for is_on, response in calls]
        assert all(response.empty() for _, response in calls)
        wait_until(lambda: not link.board.counts()["waiting"], "the replies that are too late")
        assert link.held() == held
    answers = [(is_on, each) for is_on, each in ended if each["message"] != LATE]
    assert all(each["success"] == is_on for is_on, each in answers)
    assert len({each["message"] for _, each in answers}) == len(answers)
    assert all(each == {"success": False, "message": LATE} for _, each in ended if each["message"] == LATE)


def test_counters_account_for_each_call_and_reply(link: Link) -> None:
    with ServiceClients() as clients:
        calls = [clients.begin(ARM, {"data": True}) for _ in range(CALLS)]
        ended = Counter(response.get(timeout=PATIENCE)["message"] == LATE for response in calls)
    wait_until(lambda: not link.board.counts()["waiting"], "the replies that are too late")
    board, replies = link.board.counts(), 0.0
    assert min(board["right"], board["misnumbered"], board["others"], board["parts"], ended[True]) > 0, board

    def all_taken() -> bool:
        nonlocal replies
        replies = ended[False] + link.count("service_replies_unmatched", "arm")
        return replies == board["right"] + board["misnumbered"] and link.rejected("malformed") == board["parts"]

    wait_until(all_taken, "the last reply")
    assert link.outcomes("arm") == {"answered": ended[False], "timed_out": ended[True]}
    assert (board["calls"], board["changed"], board["refused"]) == (CALLS, 0, 0)
    assert board["requests"] == CALLS + link.count("service_retries", "arm")
    assert link.rejected("unhandled") == board["others"]
    assert link.place.samples()[key("service_calls_open", service="arm")] == 0


def test_the_board_gets_one_reply_each_time_that_it_asks(link: Link) -> None:
    with ServiceServer("get_home"), ServiceClients() as clients:
        link.board.call(CALLS)
        calls = [clients.begin(ARM, {"data": True}) for _ in range(CALLS)]  # beside its own
        wait_until(lambda: link.board.counts()["called"] == CALLS, "the last call")
        wait_until(lambda: link.board.counts()["replied"] == link.board.counts()["asked"], "the last reply")
        for response in calls:
            response.get(timeout=PATIENCE)
    board, outcomes = link.board.counts(), link.outcomes("home")
    assert (board["wrong"], board["refused"]) == (0, 0)
    assert outcomes.pop("unsent", 0) == board["failed"]  # until the server is discovered
    assert outcomes == {"answered": board["asked"] - board["failed"]}
    assert board["asked"] > CALLS  # it has lost some replies
