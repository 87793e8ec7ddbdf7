"""Clients of services that other clients call, too, and services that close while clients call."""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.serialization import serialize_message
from std_srvs.srv import SetBool  # type: ignore[import-untyped]

from router.compiler.compiled_table import CALL_FAILURES, CalledPlan
from router.ros import services
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.service_clients import ARM, Service, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.readable import readable
from tests.ros.opening import SPAN, open_ros
from tests.ros.peers import wait_until
from tests.services.conftest import PROTOS, compiled

LIGHT = Service("light", "std_srvs/srv/SetBool")
PLAN = CalledPlan("light", LIGHT.name, LIGHT.type, {}, 0, 0, {}, SPAN)
ON = serialize_message(SetBool.Request(data=True))


class Announced:
    """An eventfd to which a client's responses add."""

    def __init__(self, opened: ExitStack) -> None:
        self.eventfd = os.eventfd(0, os.EFD_NONBLOCK)
        opened.callback(os.close, self.eventfd)

    def wait_for(self, number: int) -> None:
        """Wait until so many have been added."""
        added = 0
        while added < number:
            assert readable(self.eventfd, PATIENCE)
            added += os.eventfd_read(self.eventfd)


def test_a_response_is_taken_that_waits_behind_those_to_other_clients() -> None:
    with ExitStack() as opened:
        announced, ros = Announced(opened), open_ros()
        opened.callback(ros.close)
        client = ros.open_client(PLAN, announced.eventfd)
        opened.callback(client.close)
        opened.enter_context(ServiceServer(LIGHT.name))
        others = opened.enter_context(ServiceClients())
        wait_until(lambda: client.ask(ON) is not None)
        announced.wait_for(1)
        assert [response.number for response in client.take_all(1)] == [1]
        for _ in range(5):
            others.call(LIGHT, {"data": False})
        assert client.ask(ON) == 2
        announced.wait_for(6)
        assert [response.number for response in client.take_all(6)] == [2]
        assert list(client.take_all(6)) == []


def test_calls_are_cancelled_that_come_while_their_service_closes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stays open for a moment after its last response."""
    monkeypatch.setattr(services, "LINGER_S", 3.0)
    plan = compiled(tmp_path, PROTOS).services[0]
    with ExitStack() as opened:
        announced, ros = Announced(opened), open_ros()
        opened.callback(ros.close)
        served = ros.open_service(plan, announced.eventfd)
        clients = opened.enter_context(ServiceClients())
        first = clients.begin(ARM, {"data": True})
        announced.wait_for(1)
        closing = threading.Thread(target=ros.close_services, args=([served],))
        closing.start()
        assert first.get(timeout=PATIENCE)["message"] == CALL_FAILURES["cancelled"]
        assert clients.call(ARM, {"data": True})["message"] == CALL_FAILURES["cancelled"]
        closing.join()
