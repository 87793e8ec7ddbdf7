"""QoS: a plan as rclpy's profile, and what becomes of peers whose QoS or type does not go with ours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)

from router.compiler.books import QOS_POLICIES
from router.compiler.program import QosPlan, TopicPlan
from router.edges.log import logger


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


Incompatible = Callable[[str, str, int], None]
"""Called as `incompatible(topic, policy, peers)`: one of QOS_POLICIES, and how many peers it kept away so far."""

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
        self._peers: Counter[tuple[str, str]] = Counter()

    def of_publisher(self, plan: TopicPlan, wanted: list[bool]) -> PublisherEventCallbacks:
        """They keep `wanted` up to date as well: whether anybody listens."""

        def on_matched(status: Any) -> None:
            (self.subscribed.add if status.current_count else self.subscribed.discard)(plan.topic)
            wanted[0] = plan.qos.serves_late_joiners or status.current_count > 0
            if status.total_count_change > 0:
                self._met(plan.topic)

        def on_incompatible_qos(status: Any) -> None:
            sentence = "a subscriber asks for a QoS that the table does not offer, and gets nothing"
            self._on_incompatible_qos(sentence, plan, status)

        def on_incompatible_type(_: Any) -> None:
            logger.warning("a subscriber expects another type, and gets nothing", topic=plan.topic, type=plan.type_name)

        return PublisherEventCallbacks(
            matched=on_matched, incompatible_qos=on_incompatible_qos, incompatible_type=on_incompatible_type
        )

    def forget_all_but(self, published: Collection[str]) -> None:
        """Nobody subscribes to what is not published any more. To be called while no thread calls the callbacks."""
        self.subscribed.intersection_update(published)

    def tell(self) -> None:
        """All peers that were kept away so far, once more: for books in which their topics are new."""
        for (topic, policy), peers in list(self._peers.items()):
            if policy in QOS_POLICIES:
                self._incompatible(topic, policy, peers)

    def of_subscription(self, plan: TopicPlan) -> SubscriptionEventCallbacks:
        def on_incompatible_qos(status: Any) -> None:
            sentence = "a publisher offers less than the QoS that the table asks for, and is not heard"
            self._on_incompatible_qos(sentence, plan, status)

        def on_incompatible_type(_: Any) -> None:
            logger.warning("a publisher has another type, and is not heard", topic=plan.topic, type=plan.type_name)

        return SubscriptionEventCallbacks(incompatible_qos=on_incompatible_qos, incompatible_type=on_incompatible_type)

    def _on_incompatible_qos(self, sentence: str, plan: TopicPlan, status: Any) -> None:
        """The middleware names one policy: the last one of the last peer."""
        policy = qos_policy_name_from_kind(status.last_policy_kind).lower()
        self._peers[plan.topic, policy] += status.total_count_change
        logger.warning(sentence, topic=plan.topic, policy=policy)
        if policy in QOS_POLICIES:
            self._incompatible(plan.topic, policy, self._peers[plan.topic, policy])
