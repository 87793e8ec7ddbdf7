"""QoS: a plan as rclpy's profile, and what becomes of peers whose QoS or type does not go with ours."""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)

from router.compiler.metrics import QOS_POLICIES
from router.compiler.program import QosPlan, TopicPlan
from router.log import logger
from router.ros.node import RCL

if TYPE_CHECKING:
    from router.ros.opened import Publication, Subscription


def qos_profile(plan: QosPlan) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy[plan.reliability.upper()],
        durability=DurabilityPolicy[plan.durability.upper()],
        history=HistoryPolicy[plan.history.upper()],
        depth=plan.depth,
        deadline=_duration(plan.deadline),
        lifespan=_duration(plan.lifespan),
        liveliness=LivelinessPolicy[plan.liveliness.upper()],
        liveliness_lease_duration=_duration(plan.liveliness_lease_duration),
    )


def _duration(nanoseconds: int | None) -> Duration:
    return Infinite if nanoseconds is None else Duration(nanoseconds=nanoseconds)


class OpenQos(NamedTuple):
    """The policies of an open publisher or subscription that decide whom it goes with. Times in ns."""

    reliability: int
    durability: int
    deadline: int
    liveliness: int
    lease: int


class _Time(ctypes.Structure):
    _fields_ = (("sec", ctypes.c_uint64), ("nsec", ctypes.c_uint64))

    def in_ns(self) -> int:
        return int(self.sec) * 1_000_000_000 + int(self.nsec)


class _Profile(ctypes.Structure):
    """rmw_qos_profile_t, as far as it is read."""

    _fields_ = (
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline", _Time),
        ("lifespan", _Time),
        ("liveliness", ctypes.c_int),
        ("lease", _Time),
    )


for _actual_qos in (RCL.rcl_publisher_get_actual_qos, RCL.rcl_subscription_get_actual_qos):
    _actual_qos.argtypes, _actual_qos.restype = (ctypes.c_void_p,), ctypes.POINTER(_Profile)


def publisher_qos(pointer: int) -> OpenQos:
    """What the middleware made of `system_default` and `best_available`. `pointer` is that of an open handle."""
    return _open_qos(RCL.rcl_publisher_get_actual_qos(pointer).contents)


def subscription_qos(pointer: int) -> OpenQos:
    """As `publisher_qos`."""
    return _open_qos(RCL.rcl_subscription_get_actual_qos(pointer).contents)


def _open_qos(qos: Any) -> OpenQos:
    return OpenQos(qos.reliability, qos.durability, qos.deadline.in_ns(), qos.liveliness, qos.lease.in_ns())


Incompatible = Callable[[str, str, int], None]
"""Called as `incompatible(topic, policy, peers)`: one of QOS_POLICIES, and how many peers it keeps away now."""

_EMPTY_LOOKS = 10
"""A topic is looked at so often after the last incompatible peer: not every middleware has a peer in its graph before
it reports the event."""

Met = Callable[[str], None]


class PeerEvents:
    """The callbacks with which publishers and subscriptions tell of their peers. For one thread.

    `subscribed` has the topics that somebody subscribes to; other threads may look whether it is empty. `met(topic)` is
    called when somebody new subscribes.
    """

    def __init__(self, incompatible: Incompatible, met: Met) -> None:
        self.subscribed: set[str] = set()
        self._met = met
        self._incompatible = incompatible
        self._looks: dict[str, int] = {}  # topics with incompatible peers: how often to look until none counts as gone

    def of_publisher(self, plan: TopicPlan, wanted: list[bool]) -> PublisherEventCallbacks:
        """They keep `wanted` up to date as well: whether anybody listens."""

        def on_matched(status: Any) -> None:
            (self.subscribed.add if status.current_count else self.subscribed.discard)(plan.label)
            wanted[0] = plan.qos.serves_late_joiners or status.current_count > 0
            if status.total_count_change > 0:
                self._met(plan.label)

        def on_incompatible_qos(status: Any) -> None:
            sentence = "a subscriber asks for a QoS that the table does not offer, and gets nothing"
            self._on_incompatible_qos(sentence, plan, status)

        def on_incompatible_type(_: Any) -> None:
            logger.warning("a subscriber expects another type, and gets nothing", topic=plan.label, type=plan.type_name)

        return PublisherEventCallbacks(
            matched=on_matched, incompatible_qos=on_incompatible_qos, incompatible_type=on_incompatible_type
        )

    def forget_all_but(self, published: Collection[str]) -> None:
        """Nobody subscribes to what is not published any more. To be called while no thread calls the callbacks."""
        self.subscribed.intersection_update(published)

    def look(
        self, node: Node, publishers: Mapping[str, Publication], subscriptions: Mapping[str, Subscription]
    ) -> None:
        """Reports how many incompatible peers each topic has now, where an event has named one. Both are by topic.

        Events tell of peers that come, and none of those that go; the graph has those that are there.
        """
        for topic, looks in list(self._looks.items()):
            del self._looks[topic]  # what `incompatible` raises ends the looking until the next event
            apart = Counter(_apart(node, publishers.get(topic), subscriptions.get(topic)))
            for policy in QOS_POLICIES:
                self._incompatible(topic, policy, apart[policy])
            if apart or looks > 1:
                self._looks[topic] = _EMPTY_LOOKS if apart else looks - 1

    def of_subscription(self, plan: TopicPlan) -> SubscriptionEventCallbacks:
        def on_incompatible_qos(status: Any) -> None:
            sentence = "a publisher offers less than the QoS that the table asks for, and is not heard"
            self._on_incompatible_qos(sentence, plan, status)

        def on_incompatible_type(_: Any) -> None:
            logger.warning("a publisher has another type, and is not heard", topic=plan.label, type=plan.type_name)

        return SubscriptionEventCallbacks(incompatible_qos=on_incompatible_qos, incompatible_type=on_incompatible_type)

    def _on_incompatible_qos(self, sentence: str, plan: TopicPlan, status: Any) -> None:
        """The middleware names one policy: the last one of the last peer."""
        policy = qos_policy_name_from_kind(status.last_policy_kind).lower()
        self._looks[plan.label] = _EMPTY_LOOKS
        logger.warning(sentence, topic=plan.label, policy=policy)


def _apart(node: Node, publisher: Publication | None, subscription: Subscription | None) -> Iterator[str]:
    """The policies that keep each peer away that is in the graph now."""
    if publisher:
        for qos in _peers(node, publisher, rclpy_implementation.rclpy_get_subscriptions_info_by_topic):
            yield from incompatible_policies(publisher.qos, qos)
    if subscription:
        for qos in _peers(node, subscription, rclpy_implementation.rclpy_get_publishers_info_by_topic):
            yield from incompatible_policies(qos, subscription.qos)


def _peers(
    node: Node, ours: Publication | Subscription, ask: Callable[[Any, str, bool], Iterable[dict[str, Any]]]
) -> Iterator[OpenQos]:
    with node.handle:
        peers = ask(node.handle, ours.topic, False)
    for qos in (peer["qos_profile"] for peer in peers if peer["topic_type"] == ours.plan.type_name):
        yield OpenQos(
            qos["reliability"],
            qos["durability"],
            qos["deadline"].nanoseconds,
            qos["liveliness"],
            qos["liveliness_lease_duration"].nanoseconds,
        )


def incompatible_policies(offered: OpenQos, requested: OpenQos) -> Iterator[str]:
    """Those of QOS_POLICIES for which DDS does not match a publisher that offers with a subscriber that requests."""
    if (offered.reliability, requested.reliability) == (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        yield "reliability"
    if (offered.durability, requested.durability) == (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL):
        yield "durability"
    if offered.deadline > requested.deadline:
        yield "deadline"
    automatic_for_manual = LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC
    if offered.lease > requested.lease or (offered.liveliness, requested.liveliness) == automatic_for_manual:
        yield "liveliness"
