"""Peers whose QoS does not go with the rover's: they get or give nothing, and that is told."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import pytest

from tests.acceptance.conftest import Rover
from tests.acceptance.rover_map import TOPICS, TOPICS_FROM_ROS
from tests.acceptance.site import key, wait_until
from tests.ros.publisher import Publisher
from tests.ros.subscriber import Subscriber


@pytest.mark.parametrize(
    ("route", "topic", "policy", "peer"),
    [
        ("drive_motor", "drive_motor", "reliability", (Publisher, "--best-effort")),
        ("detected_object_from_ros_2", "detected_objects", "reliability", (Publisher, "--best-effort")),
        ("imu_info", "imu/mag", "reliability", (Subscriber,)),
        ("imu_info", "imu_data", "durability", (Subscriber, "--transient-local")),
    ],
)
def test_a_peer_that_cannot_be_served_is_told_and_counted(
    rover: Rover, route: str, topic: str, policy: str, peer: tuple[Any, ...]
) -> None:
    kind, *options = peer
    series = key("qos_incompatible", policy=policy, route=route, topic=topic)
    assert rover.site.samples()[series] == 0
    with closing(kind(topic, {**TOPICS, **TOPICS_FROM_ROS}[topic], *options)):
        wait_until(lambda: rover.site.samples()[series] == 1, "the event")
    wait_until(lambda: rover.site.samples()[series] == 0, "the peer to have gone")
    lines = [line for line in rover.router.log() if (line.get("topic"), line.get("policy")) == (topic, policy)]
    assert [line["level"] for line in lines] == ["warning"]
