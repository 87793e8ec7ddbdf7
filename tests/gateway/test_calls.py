"""Clients of a websocket gateway that call services of servers in other processes."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from websockets.sync.client import ClientConnection, connect

from router.compiler.metrics import CALL_OUTCOMES, Report
from router.gateway import calls, encoding
from router.gateway.clients import ClientQueue
from router.gateway.thread import GatewayThread
from router.library import load
from tests.acceptance.service_clients import ARM, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.gateway.stage import program
from tests.ports import free_port
from tests.ros.opening import open_ros
from tests.ros.peers import wait_until

TYPE = "std_srvs/srv/SetBool"
ON = {"data": True}
GATEWAY = f"""it: {{transport: {{websocket: "127.0.0.1:PORT"}}, discovery_period: 10s, inbound: [
  {{topic: /light, type: std_msgs/msg/String}},
  {{service: arm, type: {TYPE}, timeout: 20s}},
  {{service: /slow, type: {TYPE}, timeout: 200ms}},
  {{service: /rare, type: {TYPE}, timeout: 20s, max_rate: 0.01}},
  {{service: fresh, type: {TYPE}, timeout: 20s, ttl: 300ms}},
  {{service: nobody, type: std_srvs/srv/Trigger, timeout: 20s}}]}}"""


class Gateway:
    """The gateway `it`, and what it counts and reports."""

    def __init__(self, folder: Path, opened: ExitStack) -> None:
        self.port = free_port(kind=socket.SOCK_STREAM)
        self.reports: list[Report] = []
        self.faults: list[Exception] = []
        self.table = GATEWAY.replace("PORT", str(self.port))
        self.made = program(folder, self.table)
        self.counts = self.made.counters.fresh_counts()
        ros = open_ros()
        opened.callback(ros.close)
        self.thread = GatewayThread(
            ros, load(), self.counts, self.reports.append, self.faults.append, Counter(), lambda: None
        )
        self._stop = opened.enter_context(ExitStack())
        self._stop.callback(self.thread.stop)
        self.thread.finish(self.thread.prepare(self.made, {}))

    def reload(self, folder: Path, table: str) -> None:
        change = self.thread.prepare(program(folder, table), {})
        self.thread.adopt(change)
        self.thread.finish(change)

    def count(self, metric: str, *labels: str) -> int:
        return self.counts[self.made.counters.index(metric, *labels)]

    def outcomes(self, service: str) -> dict[str, int]:
        """How calls of the service have ended, and how many are open."""
        ended = {outcome: self.count("service_calls", f"it:{service}", outcome) for outcome in CALL_OUTCOMES}
        return {"open": self.count("service_calls_open", f"it:{service}"), **ended}

    @contextmanager
    def client(self) -> Iterator[Client]:
        with connect(f"ws://127.0.0.1:{self.port}", proxy=None) as connection:
            yield Client(connection)

    def stop(self) -> None:
        self._stop.close()


class Client:
    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._documents: list[dict[str, Any]] = []

    def call(self, service: str, number: int, request: object, **more: object) -> None:
        document = {"op": "call", "service": service, "id": number, "request": request, **more}
        self._connection.send(json.dumps(document))

    def send(self, text: str) -> None:
        self._connection.send(text)

    def next(self, kind: str) -> dict[str, Any]:
        """The next document of this kind, without `op`."""
        while True:
            while not self._documents:
                self._documents = [json.loads(line) for line in str(self._connection.recv(20)).splitlines()]
            document = self._documents.pop(0)
            if document.pop("op") == kind:
                return document

    def asked(self, service: str, number: int, request: object, **more: object) -> dict[str, Any]:
        """The response to a call."""
        self.call(service, number, request, **more)
        return self.next("response")


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Gateway]:
    with ExitStack() as opened:
        gateway = Gateway(tmp_path, opened)
        yield gateway
        assert gateway.faults == []


@contextmanager
def served(name: str, client: Client) -> Iterator[ServiceServer]:
    """A server that the gateway has discovered."""
    with ServiceServer(name) as server:
        wait_until(lambda: "response" in client.asked(name, 0, ON))
        assert server.request() == "True"
        yield server


def test_each_client_gets_the_responses_to_its_own_calls(gateway: Gateway) -> None:
    with gateway.client() as one, gateway.client() as other, served("/arm", one):
        answered = gateway.outcomes("/arm")["answered"]
        one.call("/arm", 7, ON)
        other.call("/arm", 7, {"data": False}, type=TYPE)
        assert one.next("response") == {"id": 7, "response": {"success": True, "message": "here"}}
        assert other.next("response") == {"id": 7, "response": {"success": False, "message": "here"}}
        outcomes = gateway.outcomes("/arm")
        assert outcomes["answered"] == answered + 2
        assert outcomes["open"] == 0
        assert outcomes["unsent"] + outcomes["answered"] == sum(outcomes.values())


def test_wrong_calls_are_rejected_with_their_number(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.asked("/disarm", 1, ON) == {"id": 1, "reason": "clients may not call '/disarm'"}
        assert client.asked("/light", 2, ON) == {"id": 2, "reason": "clients may not call '/light'"}
        trigger = client.asked("/arm", -3, ON, type="std_srvs/srv/Trigger")
        assert trigger == {"id": -3, "reason": f"/arm has the type {TYPE}"}
        assert client.asked("/arm", 4, {"data": 1})["reason"].startswith("Expected `bool`")
        client.send('{"op": "call", "service": "/arm", "id": 1e99, "request": {}}')
        assert client.next("rejected")["reason"] == "malformed"
        client.send('{"op": "call", "service": "/arm", "id": 9007199254740993, "request": {}}')
        assert client.next("rejected")["reason"] == "malformed"
    rejected = {reason: gateway.count("datagrams_rejected", "it", reason) for reason in ("not_allowed", "wrong_type")}
    assert rejected == {"not_allowed": 2, "wrong_type": 1}
    assert gateway.count("datagrams_rejected", "it", "invalid") == 1
    assert sum(gateway.outcomes("/arm").values()) == 0


def test_a_service_without_a_server_and_a_request_without_fields(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.asked("/nobody", 1, {}) == {"id": 1, "reason": "there is no server of /nobody"}
    assert gateway.outcomes("/nobody")["unsent"] == 1
    assert [(report.kind, report.place, report.target, report.reason) for report in gateway.reports] == [
        ("call", "it:/nobody", "/nobody", "unsent")
    ]


def test_responses_to_clients_of_ros_delay_none(gateway: Gateway) -> None:
    with gateway.client() as client, served("/arm", client), ServiceClients() as others:
        for number in range(1, 50):
            responses = [others.begin(ARM, {"data": False}) for _ in range(8)]
            assert all(response.get(timeout=20)["message"] == "here" for response in responses)
            assert client.asked("/arm", number, ON)["response"]["success"]


def test_a_late_response_is_ignored(gateway: Gateway) -> None:
    with gateway.client() as client, served("/slow", client) as server:
        server.wait(0.6)
        late = {"id": 1, "reason": "/slow did not respond within 200 ms"}
        assert client.asked("/slow", 1, ON) == late
        assert server.request() == "True"
        server.wait(0)
        while "reason" in (document := client.asked("/slow", 2, {"data": False})):
            assert document == {**late, "id": 2}
        assert document == {"id": 2, "response": {"success": False, "message": "here"}}
        assert gateway.outcomes("/slow")["open"] == 0


def test_calls_that_are_old_or_from_the_future_or_without_a_time(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.asked("/fresh", 1, ON, time=time.time())["reason"] == "there is no server of /fresh"
        old = client.asked("/fresh", 2, ON, time=time.time() - 60)["reason"]
        assert re.fullmatch(r"60\.\d+ s old, and older than 0\.3 s; are both clocks right\?", old)
        assert " s in the future, " in client.asked("/fresh", 3, ON, time=time.time() + 60)["reason"]
        assert client.asked("/fresh", 4, ON)["reason"] == "/fresh requires `time`, the time of sending"
    outcomes = gateway.outcomes("/fresh")
    assert (outcomes["unsent"], outcomes["refused"]) == (1, 1)
    assert gateway.count("datagrams_rejected", "it", "premature") == 1
    assert gateway.count("datagrams_rejected", "it", "invalid") == 1


def test_calls_beyond_the_largest_rate_are_refused(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.asked("/rare", 1, ON)["reason"] == "there is no server of /rare"
        assert client.asked("/rare", 2, ON)["reason"] == "called more often than 0.01 Hz"
    assert gateway.outcomes("/rare")["refused"] == 1


def test_a_client_that_does_not_read_cannot_call(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> None:
    with gateway.client() as client:
        client.next("inbound")
        monkeypatch.setattr(ClientQueue, "keeps_up", property(lambda _: False))
        client.call("/arm", 1, ON)
        wait_until(lambda: gateway.count("datagrams_rejected", "it", "rate_limited") == 1)
    assert sum(gateway.outcomes("/arm").values()) == 0


def test_a_reload_that_changes_the_gateway_answers_open_calls(gateway: Gateway, tmp_path: Path) -> None:
    with gateway.client() as client, served("/arm", client) as server:
        server.wait(1)
        client.call("/arm", 1, ON)
        assert server.request() == "True"
        gateway.reload(tmp_path, gateway.table)  # the gateway keeps its clients and calls
        assert client.next("response") == {"id": 1, "response": {"success": True, "message": "here"}}
        client.call("/arm", 2, ON)
        assert server.request() == "True"
        gateway.reload(tmp_path, gateway.table.replace("/rare", "/rarer"))
        assert client.next("response") == {"id": 2, "reason": "the router has reloaded its table, or stops"}
        with gateway.client() as again:
            wait_until(lambda: "response" in again.asked("/arm", 3, {"data": False}))


def test_too_many_open_calls(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calls, "MOST_OPEN", 2)
    with gateway.client() as one, gateway.client() as other, served("/arm", one) as server:
        server.wait(1)
        for number in (1, 2):
            one.call("/arm", number, ON)
        wait_until(lambda: gateway.outcomes("/arm")["open"] == 2)
        assert other.asked("/arm", 3, ON) == {"id": 3, "reason": "too many calls of /arm are open"}
        assert [one.next("response")["id"] for _ in range(2)] == [1, 2]
        assert "response" in other.asked("/arm", 4, ON)


def test_the_calls_of_a_client_that_leaves_end(gateway: Gateway) -> None:
    with gateway.client() as stays, served("/arm", stays) as server:
        server.wait(1)
        with gateway.client() as leaves:
            leaves.call("/arm", 1, ON)
            assert server.request() == "True"
            assert gateway.outcomes("/arm")["open"] == 1
        wait_until(lambda: gateway.outcomes("/arm")["cancelled"] == 1)
        assert gateway.outcomes("/arm")["open"] == 0
        assert stays.asked("/arm", 2, {"data": False})["response"]["success"] is False


@pytest.mark.parametrize("dies", [False, True])
def test_a_stop_answers_open_calls(gateway: Gateway, dies: bool) -> None:
    with gateway.client() as client, served("/arm", client) as server:
        server.wait(30)
        client.call("/arm", 1, ON)
        assert server.request() == "True"
        if dies:
            server.kill()
        gateway.stop()
        assert client.next("response") == {"id": 1, "reason": "the router has reloaded its table, or stops"}
        assert gateway.outcomes("/arm")["cancelled"] == 1
        server.kill()


def test_the_program_of_the_guide(gateway: Gateway, tmp_path: Path) -> None:
    guide = (Path(__file__).parents[2] / "docs/guides/gateways.md").read_text(encoding="utf-8")
    [text] = re.findall(r"^```python\n(# call\.py: .*?)^```", guide, re.DOTALL | re.MULTILINE)
    (tmp_path / "call.py").write_text(text)

    def said(service: str) -> tuple[str, str, int]:
        words = [sys.executable, "call.py", f"ws://127.0.0.1:{gateway.port}/", service]
        ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
        return ended.stdout, ended.stderr, ended.returncode

    with gateway.client() as client, served("/arm", client):
        assert said("/arm") == ("{'message': 'here', 'success': True}\n", "", 0)
    assert said("/disarm") == ("", "clients may not call '/disarm'\n", 1)


@pytest.mark.parametrize("limit", [encoding.LARGE, 0])
def test_large_responses_are_converted_beside_the_loop(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch, limit: int
) -> None:
    monkeypatch.setattr(calls, "LARGE", limit)
    with gateway.client() as client, served("/arm", client):
        assert client.asked("/arm", 5, ON) == {"id": 5, "response": {"success": True, "message": "here"}}
