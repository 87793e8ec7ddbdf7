"""ROS 2: one node with the program's publishers and subscriptions. Together with `ros_*` the only importer of rclpy.

Knows bytes and topics; what the bytes mean and why they are published is the engine's business.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager

from rclpy.event_handler import EventHandler
from rclpy.impl.implementation_singleton import rclpy_implementation

from router.compiler.program import TopicPlan
from router.edges.ros_arrivals import RawSubscription
from router.edges.ros_node import RCL_ERRORS, close_node, open_node
from router.edges.ros_qos import Incompatible, PeerEvents, qos_profile
from router.edges.ros_threads import EventThread, MessageThread, Receive
from router.edges.ros_topics import RosTopics
from router.edges.ros_types import checked_class
from router.errors import SourceSpan, StartError
from router.table.model import NodeSettings


class RosEdge:
    """The node, its publishers and subscriptions, and the threads that serve them. Opening raises StartError.

    `publish[topic]` takes CDR bytes. `wanted[topic]` is one boolean in a list, kept up to date in place: whether
    anybody listens, or may want it later. `subscribed` has the topics with a subscriber now.
    `incompatible(topic, policy, peers)` is called by a thread of events, from opening on: peers whose QoS does not go
    with ours, so far. Nothing is received before `start`. `topics` are those that the node sees.
    """

    publish_errors = (rclpy_implementation.RCLError,)
    """What `publish[topic]` may raise."""

    def __init__(
        self,
        node: NodeSettings,
        publishers: Sequence[TopicPlan],
        subscriptions: Sequence[TopicPlan],
        spans: Mapping[str, SourceSpan],
        ros_args: Sequence[str],
        incompatible: Incompatible,
    ) -> None:
        self.publish: dict[str, Callable[[bytes], None]] = {}
        self.wanted: dict[str, list[bool]] = {}
        self._subscriptions: dict[str, RawSubscription] = {}
        self._messages: MessageThread | None = None
        classes = {
            plan.topic: checked_class(plan.type_name, plan.definitions, spans[plan.topic])
            for plan in (*publishers, *subscriptions)
        }
        peers = PeerEvents(incompatible)
        self.subscribed: Collection[str] = peers.subscribed
        of_publishers: list[EventHandler] = []
        of_subscriptions: list[EventHandler] = []
        with ExitStack() as opening:
            self._node = open_node(node.name, node.namespace, ros_args)
            opening.callback(close_node, self._node)
            self.topics = RosTopics(self._node)
            for plan in publishers:
                with _refusing(f"{spans[plan.topic]}: topic '{plan.topic}' cannot be published"):
                    of_publishers += self._open_publisher(plan, classes[plan.topic], peers, opening)
            for plan in subscriptions:
                with _refusing(f"{spans[plan.topic]}: topic '{plan.topic}' cannot be subscribed to"):
                    of_subscriptions += self._open_subscription(plan, classes[plan.topic], peers)
            thread = EventThread(self._node, of_publishers, of_subscriptions)
            thread.start()
            opening.callback(thread.stop)
            self._open = opening.pop_all()

    def _open_publisher(
        self, plan: TopicPlan, message: type, peers: PeerEvents, opening: ExitStack
    ) -> list[EventHandler]:
        wanted = [plan.qos.serves_late_joiners]
        callbacks = peers.of_publisher(plan, wanted)
        publisher = self._node.create_publisher(message, plan.topic, qos_profile(plan.qos), event_callbacks=callbacks)
        # Publisher.publish() enters the handle and looks at the message's type each time, which doubles its cost.
        handle = publisher.handle
        opening.enter_context(handle)
        self.publish[plan.topic] = handle.publish_raw
        self.wanted[plan.topic] = wanted
        return publisher.event_handlers  # type: ignore[no-any-return]

    def _open_subscription(self, plan: TopicPlan, message: type, peers: PeerEvents) -> list[EventHandler]:
        callbacks = peers.of_subscription(plan)
        subscription = RawSubscription(self._node, message, plan.topic, qos_profile(plan.qos), callbacks)
        self._subscriptions[plan.topic] = subscription
        return subscription.events

    def start(self, receive: Mapping[str, Receive], failed: Callable[[Exception], None]) -> None:
        """Calls `receive[topic]` with each message's CDR bytes and the wall clock ns at which it set out.

        One thread does that. What it raises goes to `failed`. Raises StartError.
        """
        if self._subscriptions:
            with _refusing("ROS messages cannot be received"):
                self._messages = MessageThread(self._subscriptions, receive, failed)
            self._messages.start()

    def stop_receiving(self) -> None:
        """Lets what has arrived be received, and nothing after that. Publishing goes on."""
        if self._messages:
            self._messages.stop()
            self._messages = None

    def close(self) -> None:
        """Nothing may be published any more when this is called."""
        self.stop_receiving()
        self._open.close()


@contextmanager
def _refusing(problem: str) -> Iterator[None]:
    try:
        yield
    except RCL_ERRORS as error:
        raise StartError(f"{problem}: {error}") from error
