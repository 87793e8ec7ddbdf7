"""ROS 2: one node with the program's publishers and subscriptions. Together with `ros_*` the only importer of rclpy.

Knows bytes and topics; what the bytes mean and why they are published is the engine's business.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial

from rclpy.impl.implementation_singleton import rclpy_implementation

from router.compiler.program import TopicPlan
from router.errors import SourceSpan, StartError
from router.ros.change import RosChange, hand_over, left_by, opened_beside
from router.ros.node import RCL_ERRORS, close_node, open_node
from router.ros.opened import Publication, Subscription
from router.ros.qos import Incompatible, Met, PeerEvents
from router.ros.threads import EventThread, MessageThread, Receive
from router.ros.topics import RosTopics
from router.table.model import NodeSettings


class RosEdge:
    """The node, its publishers and subscriptions, and the threads that serve them. Opening raises StartError.

    `publish[topic]` takes CDR bytes. `wanted[topic]` is one boolean in a list, kept up to date in place: whether
    anybody listens, or may want it later. `subscribed` has the topics with a subscriber now.
    `incompatible(topic, policy, peers)` is called by a thread of events, from opening on: peers whose QoS does not go
    with ours, now. It is called once per second for a topic that has such peers, and for some seconds after that.
    `met(topic)` is called there too, when somebody new subscribes to it. Nothing is received before `start`. `topics`
    are those that the node sees, `name` is what ROS made of its namespace and name: `rover1/rover_router`.

    What is open can be replaced: `prepare` opens what is new, `apply` has it used, `finish` closes what is not used
    any more. Or `abandon` closes what was opened.
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
        met: Met = lambda _: None,
    ) -> None:
        self.publish: dict[str, Callable[[bytes], None]] = {}
        self.wanted: dict[str, list[bool]] = {}
        self._publications: dict[str, Publication] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._messages: MessageThread | None = None
        self._failed: Callable[[Exception], None] | None = None
        self._peers = PeerEvents(incompatible, met)
        self.subscribed: Collection[str] = self._peers.subscribed
        with ExitStack() as opening:
            self._node = open_node(node.name, node.namespace, ros_args)
            opening.callback(close_node, self._node)
            self.name = self._node.get_fully_qualified_name().removeprefix("/")
            self.topics = RosTopics(self._node)
            opening.callback(self._close_topics)
            change = self.prepare(publishers, subscriptions, spans)
            self._use(change)
            self._events = self._event_thread()
            self._events.start()
            opening.callback(self._stop_events)
            self._open = opening.pop_all()

    def start(self, receive: Mapping[str, Receive], failed: Callable[[Exception], None]) -> None:
        """Calls `receive[topic]` with each message's CDR bytes and the wall clock ns at which it set out.

        One thread does that. What it raises goes to `failed`. Raises StartError.
        """
        self._failed = failed
        self._receive(self._subscriptions, receive)

    def stop_receiving(self) -> None:
        """Lets what has arrived be received, and nothing after that. Publishing goes on."""
        if self._messages:
            self._messages.stop()
            self._messages = None

    def close(self) -> None:
        """Nothing may be published any more when this is called."""
        self.stop_receiving()
        self._open.close()

    # -- another table's topics ----------------------------------------------------------------------------------

    def prepare(
        self, publishers: Sequence[TopicPlan], subscriptions: Sequence[TopicPlan], spans: Mapping[str, SourceSpan]
    ) -> RosChange:
        """Opens what these plans want and what is not open, and nothing else changes. Raises StartError.

        A plan that is the same as before keeps what was opened for it.
        """
        with ExitStack() as opening:
            publications, published = opened_beside(
                self._publications, publishers, spans, partial(Publication, self._node, self._peers)
            )
            for each in published:
                opening.callback(each.close)
            kept, subscribed = opened_beside(
                self._subscriptions, subscriptions, spans, partial(Subscription, self._node, self._peers)
            )
            opening.pop_all()
        for each in published:
            earlier = self._publications.get(each.plan.label)
            if earlier is not None and earlier.wanted[0]:
                each.meet()
        for subscription in subscribed:
            if subscription.plan.label in self._subscriptions:
                subscription.meet()
        return RosChange(publications, kept, [*published, *subscribed])

    def abandon(self, change: RosChange) -> None:
        """Closes what `prepare` opened."""
        for opened in change.opened:
            opened.close()

    def paused(self) -> AbstractContextManager[None]:
        """No message is received meanwhile; none is lost. Raises StuckError."""
        return self._messages.paused() if self._messages else nullcontext()

    def apply(self, change: RosChange, receive: Mapping[str, Receive]) -> None:
        """From now on these are used. To be called while paused; `receive` is as in `start`.

        What has arrived on what is to be closed is received before that, in the way it was until now.
        Raises StartError, and then the topics are as they were.
        """
        change.left = [
            *left_by(change.publications, self._publications),
            *left_by(change.subscriptions, self._subscriptions),
        ]
        more = hand_over(self._messages, self._subscriptions, change.subscriptions) if self._messages else ()
        self._receive(change.subscriptions, receive)
        self._use(change)
        for topic, cdr, sent_at in more:
            receive[topic](cdr, sent_at)

    def finish(self, change: RosChange) -> None:
        """Closes what is not used any more: nobody may publish there when this is called."""
        for topic in self.publish.keys() - self._publications.keys():
            del self.publish[topic], self.wanted[topic]
        if change.left or change.opened:
            self._events.stop()
            for opened in change.left:
                opened.close()
            self._peers.forget_all_but(self._publications)
            self._events = self._event_thread()
            self._events.start()

    def _use(self, change: RosChange) -> None:
        self._publications, self._subscriptions = change.publications, change.subscriptions
        self.publish.update((topic, each.publish) for topic, each in change.publications.items())
        self.wanted.update((topic, each.wanted) for topic, each in change.publications.items())

    def _receive(self, subscriptions: Mapping[str, Subscription], receive: Mapping[str, Receive]) -> None:
        served = {each.raw: receive[topic] for topic, each in subscriptions.items()}
        try:
            if self._messages:
                self._messages.serve(served)
            elif served:
                assert self._failed is not None  # noqa: S101 - it has started
                self._messages = MessageThread.serving(served, self._failed)
        except (*RCL_ERRORS, OSError) as error:
            raise StartError(f"ROS messages cannot be received: {error}") from error

    def _event_thread(self) -> EventThread:
        return EventThread(
            self._node,
            [event for each in self._publications.values() for event in each.events],
            [event for each in self._subscriptions.values() for event in each.events],
            self._look,
        )

    def _look(self) -> None:
        self._peers.look(self._node, self._publications, self._subscriptions)

    def _stop_events(self) -> None:
        self._events.stop()

    def _close_topics(self) -> None:
        for publication in self._publications.values():
            publication.close()
        for subscription in self._subscriptions.values():
            subscription.close()
