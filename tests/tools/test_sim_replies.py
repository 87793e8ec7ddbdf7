"""Simulated boards reply to requests with their number, each from its own address."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from router.compiler import check_table
from router.datagrams import Wire
from router.errors import UsageError
from router.table.addresses import Address
from router.tools.simulator import Silence, Simulator
from router.tools.udp import open_udp
from tests.ports import free_port

BOARD, LOGGER = "127.0.6.30", "127.0.6.31"
HOSTS = {"ROUTER": "127.0.6.1", "BOARD": BOARD, "LOGGER": LOGGER}
TABLE = f"""\
version: 1
envelope: {{protos: {Path(__file__).parents[1]}/bad_tables/protos/calls, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: "ROUTER", framing: exact}}}}
endpoints:
  arm_board: {{address: "BOARD", kind: board, set: {{req_id: sequence}}}}
  logger_board: {{address: "LOGGER", kind: board}}
services:
  arm:
    type: std_srvs/srv/SetBool
    request: {{case: arm_request, to: arm_board, fields: {{armed: data}}, ttl: 1s}}
    reply: {{case: arm_reply, match: envelope.req_id, fields: {{success: ok}}}}
    timeout: 1s
    on_timeout: {{}}
  arm_too:
    type: std_srvs/srv/SetBool
    request: {{case: arm_request, to: arm_board, fields: {{armed: data}}, ttl: 1s}}
    reply: {{case: arm_reply, match: envelope.req_id, fields: {{success: ok}}}}
    timeout: 1s
    on_timeout: {{}}
  home:
    type: std_srvs/srv/Trigger
    request: {{case: home_reply, to: arm_board, fields: {{id: sequence}}, ttl: 1s}}
    reply: {{case: home_request, match: id, fields: {{success: fast}}}}
    timeout: 1s
    on_timeout: {{}}
  drive:
    type: std_srvs/srv/Trigger
    request: {{case: drive, to: arm_board, fields: {{speed: "1"}}, ttl: 1s}}
    reply: {{case: log, from: logger_board, fields: {{success: number > 0}}}}
    timeout: 1s
    on_timeout: {{}}
routes: {{}}
"""
Send = Callable[..., None]


@contextmanager
def played(folder: Path, *silences: Silence) -> Iterator[tuple[Simulator, Send, Callable[[], tuple[str, Any]]]]:
    """The simulator, and the router: how it sends an envelope to a board, and what it receives, with the sender."""
    text = TABLE
    addresses = {name: Address(host, free_port(host)) for name, host in HOSTS.items()}
    for name, address in addresses.items():
        text = text.replace(f'"{name}"', f'"{address.host}:{address.port}"')
    path = folder / "table.yaml"
    path.write_text(text)
    checked = check_table(path, {})
    program = checked.program
    assert program is not None, "\n".join(map(str, checked.diagnostics))
    wire = Wire(program.envelopes)
    envelope: Any = program.envelopes.first.message_class
    simulator = Simulator(wire, program.table, 1, services=program.services, silences=silences)

    def send(to: str, **fields: object) -> None:
        opened.sendto(envelope(**fields).SerializeToString(), addresses[to])

    def receive() -> tuple[str, Any]:
        simulator.run(0.3, 1, lambda _: None)
        data, (host, _) = opened.recvfrom(2000)
        return host, envelope.FromString(data)

    with open_udp(addresses["ROUTER"], "router") as opened:
        try:
            yield simulator, send, receive
        finally:
            simulator.close()


def test_a_request_gets_one_reply_with_its_number(tmp_path: Path) -> None:
    with played(tmp_path) as (simulator, send, receive):
        assert simulator.summary.endswith(", and replies to arm_request, drive and home_reply")
        send("BOARD", req_id=77, arm_request={"armed": True})
        host, reply = receive()
        assert (host, reply.WhichOneof("payload"), reply.req_id) == (BOARD, "arm_reply", 77)
        send("BOARD", home_reply={"id": 78})
        host, reply = receive()
        assert (host, reply.WhichOneof("payload"), reply.home_request.id) == (BOARD, "home_request", 78)
        send("BOARD", drive={"speed": 1})
        host, reply = receive()
        assert (host, reply.WhichOneof("payload")) == (LOGGER, "log")
        sent = simulator.statistics.sent
        assert sent == {"arm_board": {"arm_reply": 1, "home_request": 1}, "logger_board": {"log": 1}}


def test_what_is_no_request_gets_no_reply(tmp_path: Path) -> None:
    with played(tmp_path) as (simulator, send, receive):
        send("LOGGER", arm_request={"armed": True})
        send("BOARD", arm_reply={"ok": True})
        with pytest.raises(BlockingIOError):
            receive()
        inboxes = simulator.statistics.inboxes
        assert [*inboxes["logger_board"].arrivals, *inboxes["arm_board"].arrivals] == ["arm_request", "arm_reply"]


@pytest.mark.parametrize("name", ["arm_board", "arm_reply"])
def test_a_silent_board_does_not_reply(tmp_path: Path, name: str) -> None:
    with played(tmp_path, Silence(name, 0, 60)) as (simulator, send, receive):
        send("BOARD", arm_request={"armed": True})
        with pytest.raises(BlockingIOError):
            receive()
        assert simulator.statistics.inboxes["arm_board"].arrivals["arm_request"].count == 1


def test_only_what_replies_can_be_silent(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'arm_request'"), played(tmp_path, Silence("arm_request", 0, 60)):
        pass
