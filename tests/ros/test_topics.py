"""Discovered topics, taps and the listener of `router tap`, with publishers in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import count

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.serialization import serialize_message
from std_msgs.msg import String

from router.declared import Wanted
from router.errors import StartError
from router.ros import receiving
from router.ros.router_node import RouterNode
from router.ros.topics import DiscoveredPublisher, TopicListener, TopicTap
from tests.ros.opening import STRING, cdr, open_ros, string_topic
from tests.ros.peers import Publisher, Subscriber, wait_until

Publish = Callable[..., Publisher]


@pytest.fixture
def publisher() -> Iterator[Publish]:
    """Opens `Publisher("greeting", type, *options)`."""
    with ExitStack() as peers:
        yield lambda *arguments: peers.enter_context(closing(Publisher("greeting", *arguments)))


@pytest.fixture
def ros() -> Iterator[RouterNode]:
    """Without topics of its own."""
    with closing(open_ros()) as edge:
        yield edge


def tapped(ros: RouterNode, topic: str = "/greeting", *, keeps: bool = False, depth: int = 1) -> TopicTap:
    message_class = ros.topics.load(STRING, {STRING: (("data", "string"),)})
    return ros.topics.tap(topic, message_class, is_reliable=True, keeps=keeps, depth=depth)


def test_publishers_are_seen_with_type_and_qos(ros: RouterNode, publisher: Publish) -> None:
    publisher(STRING)
    publisher(STRING, "--transient-local")
    publisher(STRING, "--best-effort")
    wait_until(lambda: len(ros.topics.publishers("/greeting")) == 3)
    found = sorted(ros.topics.publishers("/greeting"))
    assert found == [
        DiscoveredPublisher(STRING, is_reliable=False, keeps=False, is_ours=False, gid=found[0].gid),
        DiscoveredPublisher(STRING, is_reliable=True, keeps=False, is_ours=False, gid=found[1].gid),
        DiscoveredPublisher(STRING, is_reliable=True, keeps=True, is_ours=False, gid=found[2].gid),
    ]
    assert len({each.gid for each in found}) == 3
    assert "/greeting" in ros.topics.names()


def test_a_message_is_counted_that_comes_while_the_middleware_begins_to_tell_of_them(
    ros: RouterNode, publisher: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counts what is there, and listens some microseconds later; here nothing is told of the first time."""
    publisher(STRING, "--transient-local").publish([cdr("kept")])
    wait_until(lambda: bool(ros.topics.publishers("/greeting")))
    set_callback, calls = receiving._set_callback, count(1)

    def too_early(*arguments: object) -> int:
        return 0 if next(calls) == 1 else int(set_callback(*arguments))

    monkeypatch.setattr(receiving, "_set_callback", too_early)
    with closing(tapped(ros, keeps=True)) as tap:
        wait_until(lambda: tap.arrived() == 1)
        assert tap.take()


def test_a_closed_tap_leaves_nothing_open(ros: RouterNode) -> None:
    tap = tapped(ros, topic="/nobody")
    assert "/nobody" in ros.topics.names()
    tap.close()
    wait_until(lambda: "/nobody" not in ros.topics.names())
    with closing(tapped(ros, topic="/nobody")) as again:
        assert again.fd == tap.fd  # the kernel gives the lowest that is free


@pytest.mark.parametrize(
    ("type_name", "definition", "complaint"),
    [
        ("std_msgs/msg/NoSuch", {}, "std_msgs/msg/NoSuch is not installed"),
        ("no_such_package/msg/NoSuch", {}, "no_such_package/msg/NoSuch is not installed"),
        (STRING, {STRING: (("data", "int32"),)}, "String is not the one the table was compiled for"),
    ],
)
def test_a_type_that_is_not_installed_like_that_is_refused(
    ros: RouterNode, type_name: str, definition: dict[str, tuple[tuple[str, str], ...]], complaint: str
) -> None:
    with pytest.raises(StartError, match=complaint):
        ros.topics.load(type_name, definition)


def test_a_name_that_is_none_is_refused(ros: RouterNode) -> None:
    with pytest.raises(StartError, match="topic '/2bad' cannot be subscribed to"):
        tapped(ros, topic="/2bad")


GREETING, WORLD = (bytes(serialize_message(String(data=text))) for text in ("hello, rover...", "hello, world..."))


def first(listener: TopicListener) -> bytes:
    while not (taken := listener.take(timeout=20)):
        pass
    return taken[0][0]


@pytest.mark.parametrize("quality", ["--best-effort", "--flood"])
def test_it_hears_whatever_a_publisher_offers(publisher: Publish, quality: str) -> None:
    peer = publisher(STRING, quality)
    with closing(TopicListener("greeting", "std_msgs/msg/String")) as listener:
        assert peer.line() == "matched"
        peer.publish([GREETING])
        assert first(listener) == GREETING


def test_the_type_is_the_publishers(publisher: Publish) -> None:
    peer = publisher(STRING)
    with closing(TopicListener("greeting")) as listener:
        assert listener.type_name == "std_msgs/msg/String"
        assert peer.line() == "matched"
        peer.publish([WORLD])
        assert listener.message(first(listener)).data == "hello, world..."


def test_what_was_kept_for_late_joiners_is_heard(publisher: Publish) -> None:
    publisher(STRING, "--transient-local").publish([GREETING])
    with closing(TopicListener("greeting")) as listener:
        assert first(listener) == GREETING


def test_nothing_comes_when_nobody_publishes() -> None:
    with closing(TopicListener("greeting", "std_msgs/msg/String")) as listener:
        assert listener.take(timeout=0.01) == []


@pytest.mark.parametrize(
    ("topic", "type_name", "complaint"),
    [
        ("2bad", "std_msgs/msg/String", "topic '2bad' cannot be listened to"),
        ("2bad", None, "topic '2bad' cannot be listened to"),
        ("greeting", "std_msgs", "'std_msgs' is not a message type"),
        ("greeting", "std_msgs/msg/NoSuch", "std_msgs/msg/NoSuch is not installed"),
    ],
)
def test_what_cannot_be_listened_to_is_refused(topic: str, type_name: str | None, complaint: str) -> None:
    with pytest.raises(StartError, match=complaint):
        TopicListener(topic, type_name)


def test_a_topic_that_is_only_tapped_for_its_newest_message_is_published_when_asked() -> None:
    with closing(open_ros(string_topic())) as ros:
        demand = ros.demands["greeting"]
        with closing(tapped(ros)) as tap:
            assert demand.wanted == Wanted.NEWEST_MESSAGE
            assert tap.ask()
            assert demand.is_due
            demand.replaced += 5
            assert (tap.arrived(), tap.arrived()) == (5, 0)
            with closing(Subscriber("greeting", STRING)):
                wait_until(lambda: demand.wanted == Wanted.EVERY_MESSAGE)
                assert not tap.ask()
            wait_until(lambda: demand.wanted == Wanted.NEWEST_MESSAGE)
            with closing(tapped(ros, depth=100)):
                wait_until(lambda: demand.wanted == Wanted.EVERY_MESSAGE)
            wait_until(lambda: demand.wanted == Wanted.NEWEST_MESSAGE)
        wait_until(lambda: demand.wanted == Wanted.NOTHING)
