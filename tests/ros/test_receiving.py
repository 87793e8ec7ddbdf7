"""Receiving from ROS, with real publishers in processes of their own."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from time import sleep

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rclpy.event_handler import EventHandler
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from structlog.testing import capture_logs

from router.clock import wall_ns
from router.compiler.program import QosPlan, TopicPlan
from router.errors import StartError
from router.ros.events import WaitSet
from router.ros.node import close_node, open_node
from router.ros.receiving import TURN, RawSubscription
from tests.ros.opening import HELLO, RELIABLE, STRING, cdr, open_ros, string_topic
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


def raising(error: Exception) -> None:
    raise error


class Receiver:
    """Receives on `subscriptions`; `messages` has what came, each with its topic, and `stamps` their times."""

    def __init__(self, *subscriptions: TopicPlan) -> None:
        self.messages: list[tuple[str, bytes]] = []
        self.stamps: list[int] = []
        self.failures: list[Exception] = []
        self.ros = open_ros(subscriptions=subscriptions)
        self._topics = [plan.label for plan in subscriptions]

    def start(self) -> None:
        self.ros.start({topic: self._receiver(topic) for topic in self._topics}, self.failures.append)

    def _receiver(self, topic: str) -> Callable[[bytes, int, bool], None]:
        def receive(data: bytes, stamp: int, _: bool) -> None:
            self.stamps.append(stamp)
            self.messages.append((topic, data))

        return receive

    def of(self, topic: str) -> list[bytes]:
        return [data for name, data in self.messages if name == topic]

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.ros.close()
        assert self.failures == []


@pytest.mark.parametrize(("qos", "options"), [(DEEP, ()), (BEST_EFFORT, ()), (BEST_EFFORT, ("--best-effort",))])
def test_bytes_arrive_as_they_were_sent(publisher: Publish, qos: QosPlan, options: tuple[str, ...]) -> None:
    texts = [cdr(text) for text in ("", "a", "ünïcode", "x" * 60_000, "last")]
    with Receiver(string_topic(qos)) as receiver:
        receiver.start()
        before = wall_ns()
        publisher("greeting", *options).publish(texts)
        wait_until(lambda: len(receiver.messages) == len(texts))
    assert receiver.of("greeting") == texts
    assert before < receiver.stamps[0] <= receiver.stamps[-1] <= wall_ns()


def test_a_burst_as_long_as_the_queue_arrives_whole_and_in_order(publisher: Publish) -> None:
    burst = [cdr(f"number {number}") for number in range(DEEP.depth)]
    with Receiver(string_topic(DEEP)) as receiver:
        receiver.start()
        publisher("greeting").publish(burst)
        wait_until(lambda: len(receiver.messages) == len(burst))
    assert receiver.of("greeting") == burst


def test_late_joining_gets_what_was_kept_and_it_is_as_old_as_it_is() -> None:
    with closing(Publisher("greeting", STRING, "--transient-local")) as peer:
        peer.publish([HELLO])
        peer.await_receipt()
        sent_before = wall_ns()
        with Receiver(string_topic(QosPlan("reliable", "transient_local", "keep_last", 10))) as receiver:
            receiver.start()
            wait_until(lambda: receiver.of("greeting") == [HELLO])
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

    with Receiver(string_topic()):  # which is not started
        peer = publisher("greeting")
        peer.publish([HELLO])
        peer.await_receipt()
        monkeypatch.setattr(WaitSet, "happened", counted)
        sleep(0.5)
    assert turns < 10


def test_nothing_is_received_before_the_start_and_nothing_is_lost(publisher: Publish) -> None:
    with Receiver(string_topic()) as receiver:
        peer = publisher("greeting")
        peer.publish([HELLO])
        peer.await_receipt()
        assert receiver.messages == []
        receiver.start()
        wait_until(lambda: receiver.of("greeting") == [HELLO])


def test_a_start_that_is_slow_loses_nothing_that_waits_for_it(
    publisher: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    announce = RawSubscription.announce_to

    def slowly(subscription: RawSubscription, eventfd: int | None) -> None:
        announce(subscription, eventfd)
        sleep(0.1)  # a thread that looked already would be told of a subscription that it does not know yet

    monkeypatch.setattr(RawSubscription, "announce_to", slowly)
    with Receiver(string_topic()) as receiver:
        peer = publisher("greeting")
        peer.publish([HELLO])
        peer.await_receipt()
        receiver.start()
        wait_until(lambda: receiver.of("greeting") == [HELLO])


@pytest.mark.slow
def test_a_long_queue_keeps_other_topics_waiting_for_one_turn_only(publisher: Publish) -> None:
    with Receiver(string_topic(DEEP, "many"), string_topic(RELIABLE, "few")) as receiver:
        many, few = publisher("many"), publisher("few")
        many.publish([HELLO] * DEEP.depth)
        few.publish([HELLO])
        many.await_receipt()
        few.await_receipt()
        receiver.start()
        wait_until(lambda: len(receiver.messages) == DEEP.depth + 1)
    assert receiver.messages.index(("few", HELLO)) <= TURN


def test_what_has_arrived_is_received_before_receiving_stops(publisher: Publish) -> None:
    first, go_on = threading.Event(), threading.Event()
    messages: list[bytes] = []

    def receive(data: bytes, *_: object) -> None:
        messages.append(data)
        first.set()
        go_on.wait()

    burst = [cdr(str(number)) for number in range(DEEP.depth)]
    with closing(open_ros(subscriptions=[string_topic(DEEP)])) as ros:
        ros.start({"greeting": receive}, raising)
        peer = publisher("greeting")
        peer.publish(burst[:1])
        first.wait()
        peer.publish(burst[1:])
        peer.await_receipt()
        stopping = threading.Thread(target=ros.stop_receiving)
        stopping.start()
        go_on.set()
        stopping.join()
        assert messages == burst


@pytest.mark.parametrize("history", ["keep_last", "keep_all"])
def test_a_flood_cannot_keep_receiving_from_stopping(publisher: Publish, history: str) -> None:
    with Receiver(string_topic(QosPlan("reliable", "volatile", history, 10))) as receiver:
        receiver.start()
        publisher("greeting", "--flood").publish([HELLO])
        wait_until(lambda: len(receiver.messages) > 2 * TURN)
        receiver.ros.stop_receiving()
        stopped_at = len(receiver.messages)
    assert len(receiver.messages) == stopped_at


def test_a_topic_may_be_published_and_subscribed_to_and_publishing_outlives_receiving() -> None:
    received: list[bytes] = []
    both = string_topic()
    with closing(open_ros(both, subscriptions=[both])) as ros, Receiver(both) as other:
        ros.start({"greeting": lambda data, *_: received.append(data)}, raising)
        wait_until(lambda: ros.wanted["greeting"][0])
        ros.publish["greeting"](HELLO)
        wait_until(lambda: received == [HELLO])
        ros.stop_receiving()
        other.start()
        while not other.messages:
            ros.publish["greeting"](HELLO)
    assert received == [HELLO]


def test_what_a_receiver_raises_is_told_and_receiving_goes_on(publisher: Publish) -> None:
    received: list[bytes] = []
    failures: list[Exception] = []

    def receive(data: bytes, *_: object) -> None:
        received.append(data)
        raise KeyError(len(received))

    with closing(open_ros(subscriptions=[string_topic()])) as ros:
        ros.start({"greeting": receive}, failures.append)
        publisher("greeting").publish([HELLO, HELLO, HELLO])
        wait_until(lambda: len(failures) == 3)
    assert received == [HELLO] * 3
    assert [error.args for error in failures] == [(1,), (2,), (3,)]


def test_a_publisher_that_was_killed_is_heard_again_when_it_is_back(publisher: Publish) -> None:
    with Receiver(string_topic()) as receiver:
        receiver.start()
        killed = Publisher("greeting", STRING)
        assert killed.line() == "matched"
        killed.publish([cdr("first")])
        wait_until(lambda: receiver.of("greeting") == [cdr("first")])
        killed.kill()
        publisher("greeting").publish([cdr("second")])
        wait_until(lambda: receiver.of("greeting") == [cdr("first"), cdr("second")])


def test_a_publisher_with_incompatible_qos_is_warned_about() -> None:
    told: list[tuple[str, str, int]] = []
    asked = string_topic(RELIABLE)
    with (
        capture_logs() as logged,
        closing(open_ros(subscriptions=[asked], incompatible=lambda *peers: told.append(peers))),
        closing(Publisher("greeting", STRING, "--best-effort")),
    ):
        wait_until(lambda: ("greeting", "reliability", 1) in told)
    assert [(line["log_level"], line["topic"], line["policy"]) for line in logged] == [
        ("warning", "greeting", "reliability")
    ]


def test_ros_arguments_rename_subscribed_topics(publisher: Publish) -> None:
    received: list[bytes] = []
    renaming = ("--ros-args", "-r", "greeting:=salute")
    with closing(open_ros(subscriptions=[string_topic()], args=renaming)) as ros:
        ros.start({"greeting": lambda data, *_: received.append(data)}, raising)
        publisher("salute").publish([HELLO])
        wait_until(lambda: received == [HELLO])


def test_a_middleware_that_does_not_tell_of_new_messages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("router.ros.receiving._set_callback", lambda *_: 1)
    with (
        closing(open_ros(subscriptions=[string_topic()])) as ros,
        pytest.raises(StartError, match=r"ROS messages cannot be received: .* does not tell of new messages"),
    ):
        ros.start({"greeting": lambda *_: None}, raising)


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
