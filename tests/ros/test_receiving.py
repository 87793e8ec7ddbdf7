"""Receiving from ROS, with real publishers in processes of their own."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from time import sleep

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.event_handler import EventHandler
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from router.clock import wall_ns
from router.compiler.compiled_table import QosPlan, TopicPlan
from router.errors import StartError
from router.ros.events import WaitSet
from router.ros.node import RCL_ERRORS, close_node, open_node
from router.ros.receiving import RawSubscription
from tests.ros.opening import HELLO, SPAN, STRING, cdr, open_ros, string_topic
from tests.ros.peers import Publisher, wait_until

BEST_EFFORT = QosPlan("best_effort", "volatile", "keep_last", 1000)
DEEP = QosPlan("reliable", "volatile", "keep_last", 1000)

Publish = Callable[..., Publisher]


@pytest.fixture
def publisher() -> Iterator[Publish]:
    """Opens `Publisher(topic, STRING, *options)`, and waits until a subscriber is there."""
    with ExitStack() as peers:

        def opened(topic: str, *options: str) -> Publisher:
            peer = peers.enter_context(closing(Publisher(topic, STRING, *options)))
            assert peer.line() == "matched"
            return peer

        yield opened


class Receiver:
    """Takes the messages of a subscription; `stamps` has when each set out."""

    def __init__(self, plan: TopicPlan, *args: str) -> None:
        self.ros = open_ros(subscriptions=[plan], args=args)
        change = self.ros.prepare([], [plan], {plan.label: SPAN})
        self.raw = change.subscriptions[plan.label].raw
        self.stamps: list[int] = []
        self._messages: list[bytes] = []

    def messages(self) -> list[bytes]:
        for data, stamp in self.raw.take_all():
            self._messages.append(data)
            self.stamps.append(stamp)
        return self._messages

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.ros.close()


@pytest.mark.parametrize(("qos", "options"), [(DEEP, ()), (BEST_EFFORT, ()), (BEST_EFFORT, ("--best-effort",))])
def test_bytes_arrive_as_they_were_sent(publisher: Publish, qos: QosPlan, options: tuple[str, ...]) -> None:
    texts = [cdr(text) for text in ("", "a", "ünïcode", "x" * 60_000, "last")]
    with Receiver(string_topic(qos)) as receiver:
        before = wall_ns()
        publisher("greeting", *options).publish(texts)
        wait_until(lambda: receiver.messages() == texts)
    assert before < receiver.stamps[0] <= receiver.stamps[-1] <= wall_ns()


def test_late_joining_gets_what_was_kept_and_it_is_as_old_as_it_is() -> None:
    with closing(Publisher("greeting", STRING, "--transient-local")) as peer:
        peer.publish([HELLO])
        peer.await_receipt()
        sent_before = wall_ns()
        with Receiver(string_topic(QosPlan("reliable", "transient_local", "keep_last", 10))) as receiver:
            wait_until(lambda: receiver.messages() == [HELLO])
        assert receiver.stamps[0] < sent_before


def test_messages_that_nobody_has_taken_yet_leave_the_thread_of_events_asleep(
    publisher: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Awake, it would fight for the interpreter with the thread that is behind with taking them."""
    turns, happened = 0, WaitSet.happened

    def counted(wait_set: WaitSet) -> Iterator[tuple[EventHandler, object]]:
        nonlocal turns
        turns += 1
        return happened(wait_set)

    with Receiver(string_topic()):  # which takes nothing
        peer = publisher("greeting")
        peer.publish([HELLO])
        peer.await_receipt()
        monkeypatch.setattr(WaitSet, "happened", counted)
        sleep(0.5)
    assert turns < 10


def test_a_topic_may_be_published_and_subscribed_to() -> None:
    both = string_topic()
    with closing(open_ros(both)) as ros, Receiver(both) as receiver:
        wait_until(lambda: ros.demands["greeting"].wanted)
        ros.publish["greeting"](HELLO)
        wait_until(lambda: receiver.messages() == [HELLO])


def test_ros_arguments_rename_subscribed_topics(publisher: Publish) -> None:
    with Receiver(string_topic(), "--ros-args", "-r", "greeting:=salute") as receiver:
        publisher("salute").publish([HELLO])
        wait_until(lambda: receiver.messages() == [HELLO])


def test_a_middleware_that_does_not_tell_of_new_messages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("router.ros.receiving._set_callback", lambda *_: 1)
    with Receiver(string_topic()) as receiver, pytest.raises(RCL_ERRORS, match="does not report new messages"):
        receiver.raw.announce_to(1)


def test_messages_are_announced_to_an_eventfd_until_there_is_none(publisher: Publish) -> None:
    eventfd = os.eventfd(0)
    node = open_node("receiver")
    try:
        subscription = RawSubscription(node, String, "greeting", QoSProfile(depth=10))
        subscription.announce_to(eventfd)
        peer = publisher("greeting")
        peer.publish([HELLO])
        assert os.eventfd_read(eventfd) == 1
        subscription.announce_to(None)
        peer.publish([HELLO])
        peer.await_receipt()
        assert [subscription.take() is not None for _ in range(3)] == [True, True, False]
        os.set_blocking(eventfd, False)
        with pytest.raises(BlockingIOError):
            os.eventfd_read(eventfd)
    finally:
        close_node(node)
        os.close(eventfd)


def test_a_topic_that_cannot_be_subscribed_to_is_refused() -> None:
    with pytest.raises(StartError, match=r"rover.yaml:40:16: topic '2bad' cannot be subscribed to"):
        open_ros(subscriptions=[string_topic(topic="2bad")])
