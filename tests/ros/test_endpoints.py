"""Topics of a running node are replaced: what is the same stays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.compiler.compiled_table import TopicPlan
from router.errors import StartError
from router.ros.router_node import RouterNode
from tests.ros.opening import RELIABLE, SPAN, open_ros, string_topic
from tests.ros.peers import wait_until

DEEP = replace(RELIABLE, depth=1000)
SPANS = {"greeting": SPAN, "farewell": SPAN}


@pytest.fixture
def speaker() -> Iterator[RouterNode]:
    with closing(open_ros(string_topic(DEEP))) as edge:
        yield edge


def publish(ros: RouterNode, *plans: TopicPlan) -> None:
    """In place of what it publishes now."""
    made = ros.prepare(plans, [], SPANS)
    ros.adopt(made)
    ros.finish(made)


def test_what_is_the_same_stays_open_and_what_is_not_wanted_closes() -> None:
    with closing(open_ros(string_topic())) as ros:
        kept = ros.publish["greeting"]
        publish(ros, string_topic(), string_topic(topic="farewell"))
        assert ros.publish["greeting"] is kept
        assert set(ros.demands) == {"greeting", "farewell"}
        publish(ros, string_topic(topic="farewell"))
        assert list(ros.publish) == list(ros.demands) == ["farewell"]
        wait_until(lambda: not ros.topics.publishers("/greeting"))


def test_a_topic_keeps_its_type(speaker: RouterNode) -> None:
    other = replace(
        string_topic(), type_name="std_msgs/msg/Bool", definitions={"std_msgs/msg/Bool": (("data", "boolean"),)}
    )
    with pytest.raises(
        StartError, match=r"rover.yaml:40.*cannot change to std_msgs/msg/Bool while the router runs; restart it"
    ):
        speaker.prepare([other], [], SPANS)
    assert list(speaker.publish) == ["greeting"]


def test_what_was_prepared_can_be_abandoned(speaker: RouterNode) -> None:
    made = speaker.prepare([string_topic(DEEP), string_topic(topic="farewell")], [], SPANS)
    speaker.undo(made)
    assert list(speaker.publish) == ["greeting"]
    wait_until(lambda: not speaker.topics.publishers("/farewell"))
