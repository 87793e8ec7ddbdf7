"""Services that a board answers, called by clients in another process."""

from __future__ import annotations

import re
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest

from router.cli import OK, main
from router.compiler import check_table
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.service_clients import ARM, Service, ServiceClients
from tests.acceptance.site import RouterProcess, Site, site, udp, wait_until

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/bad_tables/protos/calls, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
  arm_board: {{address: BOARD, source_port: PORT, kind: board, set: {{req_id: sequence}}}}
  base: {{address: BASE, kind: basestation}}
services:
  arm:
    type: std_srvs/srv/SetBool
    request: {{case: arm_request, to: arm_board, fields: {{armed: data, id: sequence}}, ttl: 10s}}
    reply: {{case: arm_reply, match: envelope.req_id, fields: {{success: ok, message: str(id)}}}}
    timeout: 400ms
    retries: 2
    on_timeout: {{success: false, message: reason}}
  single:
    type: std_srvs/srv/Trigger
    request: {{case: drive, to: arm_board, fields: {{speed: "1"}}, ttl: 10s}}
    reply: {{case: log, fields: {{success: number == 7}}}}
    timeout: 60s
    on_timeout: {{success: false, message: reason}}
  nothing:
    type: std_srvs/srv/Empty
    request: {{case: drive, to: arm_board, fields: {{}}, ttl: 10s}}
    reply: {{case: drive}}
    timeout: 400ms
    on_timeout: {{}}
routes:
  arm_reply: {{source: arm_board, destinations: base}}
"""
SINGLE = Service("single", "std_srvs/srv/Trigger")
NOTHING = Service("nothing", "std_srvs/srv/Empty")
ON, OFF = {"data": True}, {"data": False}
TYPICAL = 50
"""Calls that are open at the same time."""


@dataclass
class Board:
    """A board that answers requests as `behave` says: with the replies to send."""

    opened: socket.socket
    router: tuple[str, int]
    envelope: Any
    behave: Callable[[Any], Sequence[Any]]
    requests: list[Any] = field(default_factory=list)

    def run(self) -> None:
        with suppress(OSError):  # closed
            while datagram := self.opened.recv(2048):
                request = self.envelope.FromString(datagram)
                self.requests.append(request)
                self.send(*self.behave(request))

    def send(self, *replies: Any) -> None:
        for reply in replies:
            self.opened.sendto(reply.SerializeToString(), self.router)

    def reply(self, request: Any) -> Any:
        if request.WhichOneof("payload") == "arm_request":
            arm = {"ok": request.arm_request.armed, "id": request.arm_request.id}
            return self.envelope(req_id=request.req_id, arm_reply=arm)
        return self.envelope(log={"number": 7})

    def answers(self, request: Any) -> Sequence[Any]:
        return [self.reply(request)]


@dataclass
class Link:
    place: Site
    board: Board
    router: RouterProcess
    clients: ServiceClients
    table: Path

    def outcome(self, name: str, service: str = "arm") -> float:
        return self.place.samples()[f'service_calls_total{{outcome="{name}",service="{service}"}}']

    def numbers(self) -> list[int]:
        """The number of each request that the board has got."""
        return [request.arm_request.id for request in self.board.requests]

    def unmatched(self) -> float:
        return self.place.samples()['service_replies_unmatched_total{service="arm"}']


@pytest.fixture(scope="module")
def clients() -> Iterator[ServiceClients]:
    with ServiceClients() as started:
        yield started


@pytest.fixture
def link(tmp_path: Path, clients: ServiceClients) -> Iterator[Link]:
    with site(tmp_path, {"base": "127.0.0.51"}) as place, udp("127.0.0.50") as opened:
        host, port = opened.getsockname()
        base = "{}:{}".format(*place.endpoints["base"].getsockname())
        text = TABLE.replace("BOARD", f"{host}:{port}").replace("PORT", str(port)).replace("BASE", base)
        table = place.table(text)
        checked = check_table(table, {})
        assert checked.envelopes is not None, checked.diagnostics
        board = Board(opened, (ROUTER, place.listen), checked.envelopes.first.message_class, lambda _: ())
        board.behave = board.answers
        opened.settimeout(None)
        thread = threading.Thread(target=board.run, daemon=True)
        thread.start()
        with RouterProcess(tmp_path, "-t", table) as router:
            yield Link(place, board, router, clients, table)


def test_a_board_answers_a_call(link: Link) -> None:
    answers = link.clients.call(ARM, ON), link.clients.call(ARM, OFF)
    first, second = link.numbers()
    assert answers == ({"success": True, "message": str(first)}, {"success": False, "message": str(second)})
    assert second == first + 1
    assert [request.req_id for request in link.board.requests] == [1, 2]
    assert link.clients.call(SINGLE) == {"success": True, "message": ""}
    assert link.outcome("answered") == 2
    for number in (first, second):  # the route gets them, too
        assert link.board.envelope.FromString(link.place.receive("base")).arm_reply.id == number


def test_the_verb_call_prints_what_the_board_answers(link: Link, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["call", "arm", "data=true", "-t", str(link.table)]) == OK
    said = rf"/arm responded in [0-9.]+ ms: success=true message={link.numbers()[0]}\n"
    assert re.fullmatch(said, capsys.readouterr().out)
    link.board.behave = lambda _: []
    assert main(["call", "nothing", "-t", str(link.table)]) == OK
    assert re.fullmatch(r"/nothing responded in [0-9.]+ ms: \(no fields\)\n", capsys.readouterr().out)


def test_types_without_fields(link: Link) -> None:
    link.board.behave = lambda _: [link.board.envelope(drive={})]
    assert link.clients.call(NOTHING) == {}
    assert link.outcome("answered", "nothing") == 1
    link.board.behave = lambda _: []
    assert link.clients.call(NOTHING) == {}
    assert link.outcome("timed_out", "nothing") == 1


def test_many_calls_end_although_the_board_loses_doubles_delays_and_reorders(link: Link) -> None:
    seen: dict[int, int] = {}
    kept: list[Any] = []

    def behave(request: Any) -> Sequence[Any]:
        number = request.req_id
        seen[number] = seen.get(number, 0) + 1
        reply = link.board.reply(request)
        match number % 5:
            case 0:  # lost once
                return [reply] if seen[number] > 1 else []
            case 1:  # doubled
                return [reply, reply]
            case 2:  # sent after the next one
                kept.append(reply)
                return []
            case 3:
                return [reply, *(kept.pop() for _ in range(len(kept)))]
            case _:
                return [reply]

    link.board.behave = behave
    responses = [link.clients.begin(ARM, ON) for _ in range(TYPICAL)]
    answers = [response.get(timeout=30) for response in responses]
    assert all(answer["success"] for answer in answers)
    assert {int(answer["message"]) for answer in answers} == set(link.numbers())
    assert len(set(link.numbers())) == TYPICAL
    assert link.outcome("answered") == TYPICAL
    wait_until(lambda: link.unmatched() >= TYPICAL // 5, "the second replies")
    assert link.router.events("reply for a service was dropped")


def test_a_board_that_never_answers(link: Link) -> None:
    link.board.behave = lambda _: []
    began = monotonic()
    responses = [link.clients.begin(ARM, ON) for _ in range(TYPICAL)]
    answers = [response.get(timeout=30) for response in responses]
    assert monotonic() - began >= 1.2
    text = "arm_board did not reply within 400 ms"
    assert answers == [{"success": False, "message": text}] * TYPICAL
    numbers = [request.req_id for request in link.board.requests]
    assert sorted(numbers) == sorted([*range(1, TYPICAL + 1)] * 3)
    assert link.outcome("timed_out") == TYPICAL
    assert link.place.samples()['service_calls_open{service="arm"}'] == 0
    link.board.send(link.board.reply(link.board.requests[0]))
    wait_until(lambda: link.unmatched() == 1, "the late reply")
    assert link.router.events("reply for a service was dropped")[0]["detail"] == "number 1"


def test_replies_of_another_kind_or_sender_end_no_call(link: Link) -> None:
    link.board.behave = lambda _: []
    response = link.clients.begin(ARM, ON)
    wait_until(lambda: bool(link.board.requests), "the request")
    request = link.board.requests[0]
    with udp("127.0.0.50") as other, udp("127.0.0.60") as stranger:
        for sender in (other, stranger, link.place.endpoints["base"]):
            sender.sendto(link.board.reply(request).SerializeToString(), link.board.router)
    link.board.send(link.board.envelope(req_id=request.req_id, log={"number": 1}))  # of another service
    link.board.send(link.board.envelope(req_id=99, arm_reply={"ok": True}))
    mismatch = 'datagrams_rejected_total{listener="rover",reason="source_mismatch"}'
    wait_until(lambda: link.place.samples()[mismatch] == 3, "the replies of strangers")
    wait_until(lambda: link.unmatched() == 1, "the reply with another number")
    assert response.empty()
    link.board.send(link.board.reply(request))
    assert response.get(timeout=30)["success"]


def test_without_match_others_are_busy(link: Link) -> None:
    link.board.behave = lambda _: []
    first = link.clients.begin(SINGLE)
    wait_until(lambda: bool(link.board.requests), "the request")
    assert link.clients.call(SINGLE) == {
        "success": False,
        "message": "arm_board has not replied to an earlier call",
    }
    assert link.outcome("busy", "single") == 1
    link.board.send(link.board.reply(link.board.requests[0]))
    assert first.get(timeout=30)["success"]


def test_a_reload_ends_open_calls_and_the_next_are_answered(link: Link) -> None:
    link.board.behave = lambda _: []
    response = link.clients.begin(SINGLE)
    wait_until(lambda: bool(link.board.requests), "the request")
    link.table.write_text(link.table.read_text().replace("timeout: 60s", "timeout: 59s"))
    link.router.process.send_signal(signal.SIGHUP)
    assert response.get(timeout=30) == {
        "success": False,
        "message": "the router has reloaded its table, or stops",
    }
    wait_until(lambda: bool(link.router.events("table reloaded")), "the reload")
    assert link.outcome("cancelled", "single") == 1
    link.board.behave = link.board.answers
    assert link.clients.call(SINGLE)["success"]
    assert link.clients.call(ARM, ON)["success"]


def test_numbers_go_on_after_a_reload(link: Link) -> None:
    """So a late reply to a call that the reload has ended answers no other call."""
    link.clients.call(ARM, ON)
    link.table.write_text(link.table.read_text().replace("timeout: 60s", "timeout: 59s"))
    link.router.process.send_signal(signal.SIGHUP)
    wait_until(lambda: bool(link.router.events("table reloaded")), "the reload")
    link.clients.call(ARM, ON)
    first, second = link.numbers()
    assert second == first + 1
    assert [request.req_id for request in link.board.requests] == [1, 2]


def test_a_restart_begins_with_other_numbers(link: Link) -> None:
    """So a board takes no call for a retry of one before the restart, and a late reply to that one answers no other."""
    link.clients.call(ARM, ON)
    assert link.router.stop(signal.SIGTERM) == 0
    with RouterProcess(link.place.folder, "-t", link.table):
        link.clients.call(ARM, ON)
    first, second = link.numbers()
    assert second > first + 100  # ms, until it has started


def test_a_reload_removes_and_adds_services(link: Link) -> None:
    text = link.table.read_text()
    assert link.clients.call(ARM, ON)["success"]
    without = text.replace("  arm:\n", "  other:\n")
    link.table.write_text(without)
    link.router.process.send_signal(signal.SIGHUP)
    assert link.clients.call(Service("other", ARM.type), ON)["success"]
    link.table.write_text(text)
    link.router.process.send_signal(signal.SIGHUP)
    wait_until(lambda: len(link.router.events("table reloaded")) == 2, "the reload")
    assert link.clients.call(ARM, ON)["success"]


def test_a_stop_ends_open_calls(link: Link) -> None:
    link.board.behave = lambda _: []
    response = link.clients.begin(SINGLE)
    wait_until(lambda: bool(link.board.requests), "the request")
    assert link.router.stop(signal.SIGTERM) == 0
    assert response.get(timeout=30)["message"] == "the router has reloaded its table, or stops"


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP])
def test_calls_that_wait_when_their_service_ends_are_answered(link: Link, how: signal.Signals) -> None:
    link.board.behave = lambda _: []
    link.clients.call(ARM, ON)
    link.table.write_text(link.table.read_text().replace("  arm:\n", "  other:\n"))
    with link.router.standing_still():
        responses = [link.clients.begin(ARM, ON) for _ in range(4 * TYPICAL)]
        sleep(1)  # until the calls are in the router's queue
        link.router.process.send_signal(how)
    text = "the router has reloaded its table, or stops"
    assert [response.get(timeout=30)["message"] for response in responses] == [text] * (4 * TYPICAL)
    if how == signal.SIGTERM:
        assert link.router.wait() == 0


def test_a_board_that_is_gone_ends_calls_at_once(link: Link) -> None:
    link.board.opened.close()
    while link.clients.call(ARM, ON)["message"] != "arm_board cannot be sent to":
        sleep(0.01)  # the first datagram is refused only after it was sent
    assert link.outcome("unsent") >= 1
