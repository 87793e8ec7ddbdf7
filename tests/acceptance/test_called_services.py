"""Services that a board calls, with servers in another process."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from socket import socket
from time import monotonic
from typing import Any

import pytest

from router.compiler import check_table
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import ROUTER
from tests.acceptance.service_clients import Service, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.acceptance.site import RouterProcess, Site, site, udp, wait_until

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/bad_tables/protos/calls, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
  nav_board: {{address: BOARD, source_port: PORT, kind: board, set: {{req_id: sequence}}}}
services:
  home:
    from: {{case: home_request, source: nav_board}}
    call: {{service: get_home, type: std_srvs/srv/SetBool, timeout: 700ms, fields: {{data: fast}}}}
    reply:
      case: home_reply
      fields:
        id: request.id
        found: success
        speed: float32(request.speed)
        axis: {{map: request.axis, 0: AXIS_X, else: AXIS_Y}}
        offset: request.offset
        fast: request.fast
    on_timeout: {{id: request.id, found: false, offset: len(reason)}}
routes: {{}}
"""
HOME = Service("get_home", "std_srvs/srv/SetBool")
REQUEST = {"id": 4_000_000_000, "fast": True, "axis": 1, "speed": 1.5, "name": "a", "offset": -(1 << 40)}
MISSING, LATE = "there is no server of get_home", "get_home did not respond within 700 ms"
CANCELLED = "the router has reloaded its table, or stops"


@dataclass
class Link:
    place: Site
    opened: socket
    envelope: Any
    router: RouterProcess
    table: Path

    def ask(self, **fields: object) -> None:
        datagram = self.envelope(home_request=fields).SerializeToString()
        self.opened.sendto(datagram, (ROUTER, self.place.listen))

    def reply(self) -> Any:
        return self.envelope.FromString(self.opened.recv(2048)).home_reply

    def failed(self, number: int, why: str) -> Any:
        return self.envelope(home_reply={"id": number, "offset": len(why)}).home_reply

    def outcome(self, name: str) -> float:
        return self.place.samples()[f'service_calls_total{{outcome="{name}",service="home"}}']

    def is_there(self, server: ServiceServer) -> None:
        """Ask until the router has discovered the server."""
        until = monotonic() + PATIENCE
        self.ask(id=0, fast=True)
        while not self.reply().found:
            assert monotonic() < until, "the server is not found"
            self.ask(id=0, fast=True)
        server.request()


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    with site(tmp_path, {}) as place, udp("127.0.0.50") as opened:
        host, port = opened.getsockname()
        table = place.table(TABLE.replace("BOARD", f"{host}:{port}").replace("PORT", str(port)))
        checked = check_table(table, {})
        assert checked.envelopes is not None, checked.diagnostics
        with RouterProcess(tmp_path, "-t", table) as router:
            yield Link(place, opened, checked.envelopes.first.message_class, router, table)


def test_a_board_gets_the_response_with_what_it_asked(link: Link) -> None:
    with ServiceServer("get_home") as server:
        link.is_there(server)
        link.ask(**REQUEST)
        assert server.request() == "True"
        expected = {"id": REQUEST["id"], "found": True, "speed": 1.5, "axis": 1, "offset": -(1 << 40), "fast": True}
        assert link.reply() == link.envelope(home_reply=expected).home_reply
        link.ask(id=2)
        assert link.reply() == link.envelope(home_reply={"id": 2}).home_reply
        assert link.outcome("answered") == 3


def test_without_a_server_the_board_is_told_at_once(link: Link) -> None:
    began = monotonic()
    link.ask(id=3)
    assert link.reply() == link.failed(3, MISSING)
    assert monotonic() - began < 0.6
    assert link.outcome("unsent") == 1


def test_a_server_that_is_late(link: Link) -> None:
    with ServiceServer("get_home") as server:
        link.is_there(server)
        server.wait(1)
        link.ask(id=4, fast=True)
        assert link.reply() == link.failed(4, LATE)
        assert link.outcome("timed_out") == 1
        server.wait(0)  # after the late response, which nobody gets
        link.ask(id=5, fast=True)
        assert link.reply().id == 5


def test_a_server_that_dies_in_a_call(link: Link) -> None:
    with ServiceServer("get_home") as server:
        link.is_there(server)
        server.wait(30)
        link.ask(id=6, fast=True)
        server.request()
        server.kill()
        assert link.reply() == link.failed(6, LATE)


def test_responses_to_other_clients_delay_none(link: Link) -> None:
    with ServiceServer("get_home") as server, ServiceClients() as others:
        link.is_there(server)
        with link.router.standing_still():
            for _ in range(50):
                assert others.call(HOME, {"data": False})["message"] == "here"
        link.ask(id=8, fast=True)
        assert link.reply().found
        assert link.outcome("timed_out") == 0


def test_many_requests_are_bounded(link: Link) -> None:
    with ServiceServer("get_home") as server:
        link.is_there(server)
        server.wait(0.5)
        for number in range(1, 71):
            link.ask(id=number)
        replies = [link.reply() for _ in range(70)]
        assert {reply.id for reply in replies} == set(range(1, 71))
        busy = "too many calls of get_home are open"
        assert sum(reply.offset == len(busy) for reply in replies) == 6
        assert link.outcome("busy") == 6
        server.wait(0)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_reload_or_stop_ends_open_calls(link: Link, number: signal.Signals) -> None:
    with ServiceServer("get_home") as server:
        link.is_there(server)
        server.wait(0.6)
        link.ask(id=7, fast=True)
        server.request()
        link.table.write_text(link.table.read_text().replace("timeout: 700ms", "timeout: 600ms"))
        link.router.process.send_signal(number)
        assert link.reply() == link.failed(7, CANCELLED)
        if number == signal.SIGHUP:
            wait_until(lambda: bool(link.router.events("table reloaded")), "the reload")
            link.ask(id=8, fast=True)
            assert link.reply().id == 8
