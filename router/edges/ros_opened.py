"""What is open on the node for one plan: a publisher, or a subscription. Knows no thread that serves it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import sleep

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.node import Node

from router.compiler.program import TopicPlan
from router.edges.ros_arrivals import RawSubscription
from router.edges.ros_node import RCL_ERRORS
from router.edges.ros_qos import PeerEvents, publisher_qos, qos_profile, subscription_qos
from router.errors import SourceSpan, StartError

_MEET_S, _LOOK_S, _OTHERS_S = 0.5, 0.005, 0.1


class Publication:
    """A publisher. `publish` takes CDR bytes; `wanted` is one boolean: whether anybody listens, or may later."""

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Raises StartError."""
        self.plan = plan
        self.wanted = [plan.qos.serves_late_joiners]
        with _refusing(f"{span}: topic '{plan.topic}' cannot be published"), ExitStack() as opening:
            self._publisher = node.create_publisher(
                message,
                plan.topic,
                qos_profile(plan.qos),
                event_callbacks=peers.of_publisher(plan, self.wanted),
                callback_group=ReentrantCallbackGroup(),  # the node's own keeps a little of each publisher for ever
            )
            opening.callback(node.destroy_publisher, self._publisher)
            # Publisher.publish() enters the handle and looks at the message's type each time, which doubles its cost.
            handle = self._publisher.handle
            opening.enter_context(handle)
            self._open = opening.pop_all()
        self.publish: Callable[[bytes], None] = handle.publish_raw
        self.topic: str = handle.get_topic_name()
        self.qos = publisher_qos(handle.pointer)
        self.events: Sequence[EventHandler] = self._publisher.event_handlers

    def meet(self) -> None:
        """Waits a moment for those who listened to an earlier publisher of the topic: they find this one by and by."""
        for _ in range(int(_MEET_S / _LOOK_S)):
            if self._publisher.get_subscription_count():
                self.wanted[0] = True
                return
            sleep(_LOOK_S)

    def close(self) -> None:
        """Nobody may publish any more, and nobody waits for its events."""
        self._open.close()


class Subscription:
    """A subscription. Nothing is taken from it before somebody does."""

    def __init__(self, node: Node, peers: PeerEvents, plan: TopicPlan, message: type, span: SourceSpan) -> None:
        """Raises StartError."""
        self.plan = plan
        with _refusing(f"{span}: topic '{plan.topic}' cannot be subscribed to"):
            self.raw = RawSubscription(node, message, plan.topic, qos_profile(plan.qos), peers.of_subscription(plan))
        self.events: Sequence[EventHandler] = self.raw.events
        self.topic: str = self.raw.handle.get_topic_name()
        self.qos = subscription_qos(self.raw.handle.pointer)

    def meet(self) -> None:
        """Waits a moment for the publishers, who find this one by and by; an earlier subscription hears them meanwhile.

        They are there when the first of them is heard, or soon after that; who says nothing has time enough.
        """
        for _ in range(int(_MEET_S / _LOOK_S)):
            sleep(_LOOK_S)
            if self.raw.take():
                sleep(_OTHERS_S)
                return

    def close(self) -> None:
        """Nobody may take from it any more, and nobody waits for its events."""
        self.raw.close()


@contextmanager
def _refusing(problem: str) -> Iterator[None]:
    try:
        yield
    except RCL_ERRORS as error:
        raise StartError(f"{problem}: {error}") from error
