"""A running router and what does not fit it in its ROS domain: types of other nodes, and a second router."""

from __future__ import annotations

import json
import socket
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import BARE, RouterProcess, Site, key, udp, wait_until
from tests.ports import free_port
from tests.ros.peers import Publisher, Subscriber

TWIST, OURS = "geometry_msgs/msg/Twist", "comms/msg/DrivingBoardMotorMessage"
TABLE = (
    BARE
    + """
gateways:
  dashboard: {{transport: {{websocket: "127.0.0.1:${{PAGE}}"}}, discovery_period: 200ms}}
routes:
  imu_info:
    source: basestation
    topic: {{topic: imu_data, type: comms/msg/ImuSensorInformation, fields: auto, qos: {{durability: transient_local}}}}
  drive_motor:
    source: {{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}}
    fields: auto
    destinations: driving_board
    deadman: {{none: nothing is driven}}
"""
)


@dataclass(frozen=True)
class Rover:
    site: Site
    router: RouterProcess

    def problems(self) -> dict[str, dict[str, Any]]:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.site.metrics}/health.json", timeout=PATIENCE) as answer:
            return {each["kind"]: each for each in json.load(answer)["problems"] if each["level"] != "info"}

    def reports(self, kind: str, more: str) -> bool:
        return kind in (found := self.problems()) and found[kind]["more"] == more

    def topics(self, state: str) -> float:
        return self.site.samples()[key("gateway_topics", route="dashboard", state=state)]


def started(opening: ExitStack, folder: Path) -> Rover:
    folder.mkdir()
    hosts = {"driving_board": "127.0.0.31", "basestation": "127.0.0.10"}
    endpoints = {name: opening.enter_context(udp(host)) for name, host in hosts.items()}
    site = Site(folder, endpoints, free_port("127.0.0.5"), free_port(kind=socket.SOCK_STREAM))
    page = str(free_port(kind=socket.SOCK_STREAM))
    return Rover(site, opening.enter_context(RouterProcess(folder, site.table(TABLE), PAGE=page)))


@pytest.fixture
def rover(tmp_path: Path) -> Iterator[Rover]:
    with ExitStack() as opening:
        yield started(opening, tmp_path / "one")


def test_commands_of_another_type_are_a_critical_problem_and_no_type_is_said_to_be_missing(rover: Rover) -> None:
    series = key("type_incompatible", peer="publisher", route="drive_motor", topic="drive_motor", type=TWIST)
    with closing(Publisher("drive_motor", TWIST)):
        wait_until(lambda: rover.site.samples().get(series) == 1, "the publisher")
        wait_until(lambda: rover.topics("refused") == 1, "the gateway's discovery")
        assert rover.topics("not_installed") == 0
        [(kind, problem)] = rover.problems().items()
        assert (kind, problem["level"], problem["routes"]) == ("CommandsMistyped", "critical", ["drive_motor"])
        words = f"commands on drive_motor are lost: it has a publisher of {TWIST}"
        assert (problem["words"], problem["more"]) == (words, f"; only {OURS} is received")
        with closing(Publisher("drive_motor", OURS)):
            wait_until(lambda: rover.topics("several_types") == 1, "the type of the route")
            assert rover.topics("refused") == 0
    wait_until(lambda: not rover.problems(), "the publishers to have gone")
    [line] = rover.router.events(f"drive_motor has a publisher of {TWIST}; only {OURS} is received")
    assert (line["level"], line["topic"]) == ("warning", "drive_motor")


def test_subscribers_are_counted_also_of_a_topic_that_serves_late_joiners(rover: Rover) -> None:
    def subscribers() -> float:
        return rover.site.samples()[key("topic_subscribers", topic="imu_data")]

    assert subscribers() == 0
    with closing(Subscriber("imu_data", "comms/msg/ImuSensorInformation")):
        wait_until(lambda: subscribers() == 1, "the subscriber")
        with closing(Subscriber("imu_data", "sensor_msgs/msg/Imu")):
            wait_until(lambda: "TypeIncompatible" in rover.problems(), "the problem")
            assert subscribers() == 1
    wait_until(lambda: subscribers() == 0, "the subscriber to have gone")


def test_two_routers_of_one_table_name_each_other(rover: Rover, tmp_path: Path) -> None:
    assert rover.problems() == {}
    twice = "; boards of both get messages on drive_motor twice; both are called /rover_router"
    with ExitStack() as opening:
        other = started(opening, tmp_path / "two")
        for one, second in ((rover, other), (other, rover)):
            wait_until(partial(one.reports, "OtherRouter", twice), "the other router's marks")
            [problem] = one.problems().values()
            assert problem["labels"]["process"] == str(second.router.process.pid)
            assert (problem["level"], problem["routes"]) == ("warning", ["drive_motor"])
    wait_until(lambda: not rover.problems(), "the other router to have gone")
