"""The router's surroundings in the graph: peers of another type and other routers, in processes of their own."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from time import sleep
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))  # sys.path of a script lacks the repository's root

pytest.importorskip("rclpy", reason="needs ROS 2")

from structlog.testing import capture_logs

from router.compiler.metrics import PUBLISHER, SUBSCRIBER
from router.ros import events, graph
from router.ros.graph import Mistyped, Surroundings, look
from router.ros.marks import marks, this_router
from router.ros.node import close_node, open_node
from router.ros.router_node import RouterNode
from tests.ros.opening import SPAN, STRING, open_ros, string_topic
from tests.ros.peers import Publisher, Subscriber, wait_until
from tests.ros_child import RosProcess, own_stdout

INT32 = "std_msgs/msg/Int32"


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """The graph is looked at ten times as often."""
    monkeypatch.setattr(events, "CHECK_INTERVAL_NS", 100_000_000)


class OtherRouter(RosProcess):
    """`OtherRouter("--ros-args", ...)`: a router that subscribes to `greeting`."""

    def __init__(self, *ros_args: str) -> None:
        super().__init__(__file__, *ros_args)
        assert self.line() == "open"


@pytest.fixture
def opened() -> Iterator[Callable[..., RosProcess]]:
    """Opens a peer: `opened(Publisher, "greeting", STRING)`."""
    with ExitStack() as peers:
        yield lambda kind, *arguments: peers.enter_context(closing(kind(*arguments)))


def counted(ros: RouterNode) -> dict[Mistyped, int]:
    return {found: len(nodes) for found, nodes in ros.surroundings.mistyped.items()}


def shared(ros: RouterNode) -> set[tuple[str, int, str]]:
    found = ros.surroundings.shared
    assert {each.router.host for each in found} <= {this_router().host}
    return {("node" if each.is_node else "topic", each.router.process, each.name) for each in found}


def test_peers_of_another_type_are_counted_and_named_until_they_have_gone(opened: Callable[..., RosProcess]) -> None:
    from_publisher = Mistyped("greeting", PUBLISHER, INT32, STRING)
    to_subscriber = Mistyped("farewell", SUBSCRIBER, INT32, STRING)
    args = ("--ros-args", "-r", "greeting:=salute")
    with closing(open_ros(string_topic(topic="farewell"), subscriptions=[string_topic()], args=args)) as ros:
        with capture_logs() as logs:
            opened(Publisher, "salute", STRING)
            one, other = opened(Publisher, "salute", INT32), opened(Publisher, "salute", INT32)
            late = opened(Subscriber, "farewell", INT32)
            opened(Publisher, "farewell", INT32)  # nothing of ours is lost
            opened(Subscriber, "salute", INT32)
            wait_until(lambda: counted(ros) == {from_publisher: 2, to_subscriber: 1})
            other.close()
            late.close()
            wait_until(lambda: counted(ros) == {from_publisher: 1})
            one.close()
            wait_until(lambda: counted(ros) == {})
        assert sorted((line["event"], line["topic"]) for line in logs) == [
            (f"farewell has a subscriber of {INT32}; only {STRING} is published", "farewell"),
            (f"greeting has a publisher of {INT32}; only {STRING} is received", "greeting"),
        ]


def test_two_routers_notice_what_they_share(opened: Callable[..., RosProcess]) -> None:
    with closing(open_ros(string_topic(topic="own"), subscriptions=[string_topic()])) as ros, capture_logs() as logs:
        other = opened(OtherRouter)
        wait_until(lambda: len(shared(ros)) == 2)
        assert shared(ros) == {("node", other.process.pid, "/router_test"), ("topic", other.process.pid, "greeting")}
        assert ros.surroundings.namesakes == 0
        other.close()
        wait_until(lambda: not shared(ros))
        opened(OtherRouter, "--ros-args", "-r", "__node:=another", "-r", "greeting:=salute")
        named = opened(OtherRouter, "--ros-args", "-r", "__ns:=/elsewhere", "-r", "greeting:=/greeting")
        wait_until(lambda: shared(ros) == {("topic", named.process.pid, "greeting")})
    what = "another router has the name of this one or takes messages from the same topics"
    assert {line["event"] for line in logs} == {what}


def test_a_reload_marks_new_topics_and_no_longer_those_that_it_removes(opened: Callable[..., RosProcess]) -> None:
    opened(OtherRouter, "--ros-args", "-r", "__node:=another")
    with closing(open_ros(subscriptions=[string_topic(topic="old")])) as ros:
        change = ros.prepare([], [string_topic()], {"greeting": SPAN})
        ros.adopt(change)
        ros.finish(change)
        wait_until(lambda: [name for _, _, name in shared(ros)] == ["greeting"])
        ours = {name for name, router in marks(ros.topics.names()) if router == this_router()}
        assert ours == {"/router_test", "/greeting"}


def test_a_router_that_was_killed_does_not_count_while_dds_remembers_it() -> None:
    with closing(open_ros(subscriptions=[string_topic()])) as ros:
        other = OtherRouter()
        wait_until(lambda: len(shared(ros)) == 2)
        other.kill()
        remembered = [router.process for _, router in marks(ros.topics.names())]
        assert remembered.count(other.process.pid) == 2
        assert look(ros._node, ros._ours) == Surroundings()


def test_a_graph_that_does_not_change_is_not_queried_again(
    monkeypatch: pytest.MonkeyPatch, opened: Callable[..., RosProcess]
) -> None:
    looks: list[Surroundings] = []

    def counted_look(*arguments: Any) -> Surroundings:
        looks.append(look(*arguments))
        return looks[-1]

    monkeypatch.setattr(graph, "look", counted_look)
    with closing(open_ros(subscriptions=[string_topic()])) as ros:
        wait_until(lambda: bool(looks))

        def rests() -> bool:
            before = len(looks)
            sleep(10 * events.CHECK_INTERVAL_NS / 1e9)
            return len(looks) == before

        wait_until(rests)
        opened(Publisher, "greeting", INT32)
        wait_until(lambda: len(counted(ros)) == 1)
        before = len(looks)
        wait_until(lambda: len(looks) > before + 2)  # until the publisher has gone


def test_a_node_with_the_name_of_the_router_counts_if_it_is_no_router() -> None:
    with closing(open_ros()) as ros:
        node = open_node("router_test")
        wait_until(lambda: ros.surroundings.namesakes == 1)
        close_node(node)
        wait_until(lambda: ros.surroundings.namesakes == 0)


def main() -> None:
    lines = own_stdout()
    with closing(open_ros(subscriptions=[string_topic()], args=sys.argv[1:])):
        print("open", file=lines)
        sys.stdin.read()


if __name__ == "__main__":
    main()
