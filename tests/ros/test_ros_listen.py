"""Listening to one topic for a person, with the publisher in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.serialization import serialize_message
from std_msgs.msg import String

from router.errors import StartError
from router.ros.topics import TopicListener
from tests.ros.ros_publisher import Publisher

HELLO, WORLD = (bytes(serialize_message(String(data=text))) for text in ("hello, rover...", "hello, world..."))


@pytest.fixture
def publisher() -> Iterator[Callable[..., Publisher]]:
    with ExitStack() as peers:
        yield lambda *options: peers.enter_context(closing(Publisher("greeting", "std_msgs/msg/String", *options)))


def first(listener: TopicListener) -> bytes:
    while not (taken := listener.take(timeout=20)):
        pass
    return taken[0][0]


@pytest.mark.parametrize("quality", ["--best-effort", "--flood"])
def test_it_hears_whatever_a_publisher_offers(publisher: Callable[..., Publisher], quality: str) -> None:
    peer = publisher(quality)
    with closing(TopicListener("greeting", "std_msgs/msg/String")) as listener:
        assert peer.line() == "matched"
        peer.publish([HELLO])
        assert first(listener) == HELLO


def test_the_type_is_the_publishers(publisher: Callable[..., Publisher]) -> None:
    peer = publisher()
    with closing(TopicListener("greeting")) as listener:
        assert listener.type_name == "std_msgs/msg/String"
        assert peer.line() == "matched"
        peer.publish([WORLD])
        assert listener.message(first(listener)).data == "hello, world..."


def test_what_was_kept_for_late_joiners_is_heard(publisher: Callable[..., Publisher]) -> None:
    publisher("--transient-local").publish([HELLO])
    with closing(TopicListener("greeting")) as listener:
        assert first(listener) == HELLO


def test_nothing_comes_when_nobody_publishes() -> None:
    with closing(TopicListener("greeting", "std_msgs/msg/String")) as listener:
        assert listener.take(timeout=0.01) == []


@pytest.mark.parametrize(
    ("topic", "type_name", "complaint"),
    [
        ("2bad", "std_msgs/msg/String", "topic '2bad' cannot be listened to"),
        ("2bad", None, "topic '2bad' cannot be listened to"),
        ("greeting", "std_msgs", "'std_msgs' is no message type"),
        ("greeting", "std_msgs/msg/NoSuch", "std_msgs/msg/NoSuch is not installed"),
    ],
)
def test_what_cannot_be_listened_to_is_refused(topic: str, type_name: str | None, complaint: str) -> None:
    with pytest.raises(StartError, match=complaint):
        TopicListener(topic, type_name)
