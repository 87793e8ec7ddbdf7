"""Topics of a running node are replaced: what is the same stays, and no message is lost or taken twice."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.errors import StartError
from router.ros.receiving import RawSubscription
from router.ros.router_node import RouterNode
from tests.ros.opening import RELIABLE, SPAN, cdr, open_ros, string_topic
from tests.ros.peers import wait_until

DEEP = replace(RELIABLE, depth=1000)
SPANS = {"greeting": SPAN, "farewell": SPAN}
Take = Callable[[bytes, int, bool], None]


@pytest.fixture
def speaker() -> Iterator[RouterNode]:
    with closing(open_ros(string_topic(DEEP))) as edge:
        yield edge


def change(ros: RouterNode, receive: dict[str, Take], *plans: object, published: object = ()) -> None:
    made = ros.prepare(published, plans, SPANS)  # type: ignore[arg-type]
    with ros.paused():
        ros.apply(made, receive)
    ros.watch(made)
    ros.finish(made)


@pytest.mark.parametrize("depths", [(1000, 1000), (1000, 2000)], ids=["kept", "opened anew"])
def test_each_message_is_taken_once_and_in_order(speaker: RouterNode, depths: tuple[int, int]) -> None:
    got: list[bytes] = []
    ended = threading.Event()
    sent: list[bytes] = []

    def speak() -> None:
        while not ended.wait(0.001):
            sent.append(cdr(f"{len(sent):06}"))
            speaker.publish["greeting"](sent[-1])

    plans = [string_topic(replace(RELIABLE, depth=depth)) for depth in depths]
    with closing(open_ros(subscriptions=plans[:1])) as ros:
        receive: dict[str, Take] = {"greeting": lambda data, *_: got.append(data)}
        ros.start(receive, print)
        wait_until(lambda: speaker.wanted["greeting"][0])
        thread = threading.Thread(target=speak)
        thread.start()
        for number in range(10):
            time.sleep(0.05)
            change(ros, receive, plans[(number + 1) % 2])
        ended.set()
        thread.join()
        wait_until(lambda: len(got) >= len(sent))
        time.sleep(0.05)
    assert got == sent


def test_what_is_the_same_stays_open_and_what_is_not_wanted_closes() -> None:
    with closing(open_ros(string_topic())) as ros:
        kept = ros.publish["greeting"]
        change(ros, {}, published=[string_topic(), string_topic(topic="farewell")])
        assert ros.publish["greeting"] is kept
        assert set(ros.wanted) == {"greeting", "farewell"}
        change(ros, {}, published=[string_topic(topic="farewell")])
        assert list(ros.publish) == list(ros.wanted) == ["farewell"]
        wait_until(lambda: not ros.topics.publishers("/greeting"))


def test_a_topic_keeps_its_type(speaker: RouterNode) -> None:
    other = replace(
        string_topic(), type_name="std_msgs/msg/Bool", definitions={"std_msgs/msg/Bool": (("data", "boolean"),)}
    )
    with pytest.raises(StartError, match=r"rover.yaml:40.*cannot become std_msgs/msg/Bool while it runs; restart it"):
        speaker.prepare([other], [], SPANS)
    assert list(speaker.publish) == ["greeting"]


def test_what_was_prepared_can_be_abandoned(speaker: RouterNode) -> None:
    made = speaker.prepare([string_topic(DEEP), string_topic(topic="farewell")], [], SPANS)
    speaker.abandon(made)
    assert list(speaker.publish) == ["greeting"]
    wait_until(lambda: not speaker.topics.publishers("/farewell"))


def test_a_change_that_fails_at_last_leaves_the_topics_as_they_were(
    speaker: RouterNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[bytes] = []
    receive: dict[str, Take] = {"greeting": lambda data, *_: got.append(data), "farewell": lambda *_: None}
    announce = RawSubscription.announce_to

    def fail(subscription: RawSubscription, eventfd: int | None) -> None:
        if eventfd is not None and subscription is made.subscriptions["farewell"].raw:
            raise OSError(24, "Too many open files")
        announce(subscription, eventfd)

    with closing(open_ros(subscriptions=[string_topic()])) as ros:
        ros.start(receive, print)
        made = ros.prepare([], [string_topic(), string_topic(topic="farewell")], SPANS)
        monkeypatch.setattr(RawSubscription, "announce_to", fail)
        with ros.paused(), pytest.raises(StartError, match="Too many open files"):
            ros.apply(made, receive)
        ros.abandon(made)
        wait_until(lambda: speaker.wanted["greeting"][0])
        speaker.publish["greeting"](cdr("still there"))
        wait_until(lambda: got == [cdr("still there")])
