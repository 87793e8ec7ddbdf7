"""Events of publishers and subscriptions (new subscribers, incompatible peers), and the threads that wait for them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import EventHandler, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import qos_policy_name_from_kind

from router.compiler.compiled_table import TopicPlan
from router.compiler.metrics import QOS_POLICIES
from router.log import fault, logger
from router.ros.qos import ActualQos, incompatible_policies
from router.threads import Thread, join_or_abandon

if TYPE_CHECKING:
    from router.ros.endpoints import Publication, Subscription

CHECK_INTERVAL_NS = 1_000_000_000
"""The longest delay of changes that are polled: events of subscriptions, incompatible peers that leave, and a shutdown
of ROS from outside."""

FOREVER = -1

Incompatible = Callable[[str, str, int], None]
"""Called as `incompatible(topic, policy, peers)`: one of QOS_POLICIES, and the number of peers that mismatch."""

SubscriberJoined = Callable[[str], None]

_MORE_CHECKS = 10
"""Checks of a topic after its last incompatible peer: a middleware may report the event before the peer is in its
graph."""


class PeerEvents:
    """Event callbacks of publishers and subscriptions about their peers, to be called one at a time.

    `subscriber_joined(topic)` is called for each new subscriber.
    """

    def __init__(self, incompatible: Incompatible, subscriber_joined: SubscriberJoined) -> None:
        self._subscriber_joined = subscriber_joined
        self._incompatible = incompatible
        self._checks: dict[str, int] = {}  # by topic that has or had incompatible peers: remaining checks

    def of_publisher(self, plan: TopicPlan, matched: Callable[[int], None]) -> PublisherEventCallbacks:
        """Return callbacks; `matched` is called with each new number of subscribers."""

        def on_matched(status: Any) -> None:
            matched(status.current_count)
            if status.total_count_change > 0:
                self._subscriber_joined(plan.label)

        def on_incompatible_qos(status: Any) -> None:
            problem = "a subscriber requests a QoS that the table does not offer: it receives nothing"
            self._on_incompatible_qos(problem, plan, status)

        return PublisherEventCallbacks(
            matched=on_matched, incompatible_qos=on_incompatible_qos, use_default_callbacks=False
        )

    def check(
        self, node: Node, publishers: Mapping[str, Publication], subscriptions: Mapping[str, Subscription]
    ) -> None:
        """Report the number of incompatible peers of each topic that had such an event. Arguments by topic.

        Events report peers that join, but not those that leave; the graph has the present ones.
        """
        for topic, checks in list(self._checks.items()):
            del self._checks[topic]  # if `incompatible` raises, checks stop until the next event
            mismatches = Counter(_mismatches(node, publishers.get(topic), subscriptions.get(topic)))
            for policy in QOS_POLICIES:
                self._incompatible(topic, policy, mismatches[policy])
            if mismatches or checks > 1:
                self._checks[topic] = _MORE_CHECKS if mismatches else checks - 1

    def of_subscription(self, plan: TopicPlan) -> SubscriptionEventCallbacks:
        def on_incompatible_qos(status: Any) -> None:
            problem = "a publisher offers a weaker QoS than the table requests: its messages are not received"
            self._on_incompatible_qos(problem, plan, status)

        return SubscriptionEventCallbacks(incompatible_qos=on_incompatible_qos, use_default_callbacks=False)

    def _on_incompatible_qos(self, problem: str, plan: TopicPlan, status: Any) -> None:
        """Log the problem. The middleware names only the last policy of the last peer."""
        policy = qos_policy_name_from_kind(status.last_policy_kind).lower()
        self._checks[plan.label] = _MORE_CHECKS
        logger.warning(problem, topic=plan.label, policy=policy)


def _mismatches(node: Node, publisher: Publication | None, subscription: Subscription | None) -> Iterator[str]:
    """Yield the incompatible policies of each peer in the graph."""
    if publisher:
        for qos in _peers(node, publisher, rclpy_implementation.rclpy_get_subscriptions_info_by_topic):
            yield from incompatible_policies(publisher.qos, qos)
    if subscription:
        for qos in _peers(node, subscription, rclpy_implementation.rclpy_get_publishers_info_by_topic):
            yield from incompatible_policies(qos, subscription.qos)


def _peers(
    node: Node, ours: Publication | Subscription, ask: Callable[[Any, str, bool], Iterable[dict[str, Any]]]
) -> Iterator[ActualQos]:
    with node.handle:
        peers = ask(node.handle, ours.topic, False)
    for qos in (peer["qos_profile"] for peer in peers if peer["topic_type"] == ours.plan.type_name):
        yield ActualQos(
            qos["reliability"],
            qos["durability"],
            qos["deadline"].nanoseconds,
            qos["liveliness"],
            qos["liveliness_lease_duration"].nanoseconds,
        )


class WaitSet:
    """Waits until one of the events happens. For one thread; others may call `wake`.

    Unlike the wait set of rclpy's executor, it is made only once.
    """

    def __init__(self, node: Node, events: Sequence[EventHandler]) -> None:
        self._events = events
        self._guard_condition = GuardCondition(None, None, node.context)
        self._set = rclpy_implementation.WaitSet(0, 1, 0, 0, 0, len(events), node.context.handle)

    def wait(self, timeout_ns: int) -> None:
        """Wait until an event happens or `wake` is called, at most `timeout_ns` or FOREVER.

        No signal handler runs meanwhile.
        """
        waiting = self._set
        waiting.clear_entities()  # waiting removes the entities that are not ready
        waiting.add_guard_condition(self._guard_condition.handle)
        for event in self._events:
            event.add_to_wait_set(waiting)
        waiting.wait(timeout_ns)

    def happened(self) -> Iterator[tuple[EventHandler, Any]]:
        """Yield the events that had happened when `wait` returned, each with its status."""
        for event in self._events:
            if event.is_ready(self._set):
                yield event, event.take_data()

    def wake(self) -> None:
        """End the current wait, or the next one."""
        self._guard_condition.trigger()

    def close(self) -> None:
        self._set.destroy_when_not_in_use()
        self._guard_condition.destroy()


class EventThread:
    """Calls the callbacks of events, one at a time: those of publishers when they happen, others at most 1 s later.

    The thread `ros events` waits for those of publishers without a timeout, because each wait for 900 topics takes
    10 ms. `ros checks` polls those of subscriptions: in Fast DDS every message ends a wait for them, and an untaken one
    ends it at once, so a waiting thread would compete with the receiving one for the interpreter. They start once and
    stop once.
    """

    def __init__(
        self,
        node: Node,
        of_publishers: Sequence[EventHandler],
        of_subscriptions: Sequence[EventHandler],
        check: Callable[[], None],
    ) -> None:
        """`check` is called once per second, after the callbacks."""
        self._waited_for = WaitSet(node, of_publishers)
        self._polled = WaitSet(node, of_subscriptions)
        self._context = node.context
        self._check = check
        self._calling = threading.Lock()
        self._stopping = threading.Event()
        self._threads = Thread(self._wait, "ros events"), Thread(self._poll, "ros checks")

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._waited_for.wake()
        have_ended = [join_or_abandon(thread) for thread in self._threads]
        if all(have_ended):
            self._waited_for.close()
            self._polled.close()

    def _wait(self) -> None:
        while not self._stopping.is_set():
            self._waited_for.wait(FOREVER)
            self._serve(self._waited_for)

    def _poll(self) -> None:
        while self._context.ok():
            self._polled.wait(0)
            self._serve(self._polled)
            self._call(self._check)
            if self._stopping.wait(CHECK_INTERVAL_NS / 1e9):
                return
        logger.critical("ROS was shut down from outside the router: restart the router to publish again")

    def _serve(self, wait_set: WaitSet) -> None:
        for event, status in wait_set.happened():
            self._call(partial(event.callback, status))

    def _call(self, callback: Callable[[], None]) -> None:
        try:
            with self._calling:
                callback()
        except Exception as error:  # noqa: BLE001 a bug is logged; later events are still handled
            fault(error, "lost an event").log()
