"""Clients of services that other clients call, too."""

from __future__ import annotations

import os
from contextlib import ExitStack

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.serialization import serialize_message
from std_srvs.srv import SetBool  # type: ignore[import-untyped]

from router.compiler.compiled_table import CalledPlan
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.service_clients import Service, ServiceClients
from tests.acceptance.service_server import ServiceServer
from tests.readable import readable
from tests.ros.opening import SPAN, open_ros
from tests.ros.peers import wait_until

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
