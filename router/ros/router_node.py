"""The router's ROS node with the publishers, subscriptions and threads of the running program."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial

from rclpy.impl.implementation_singleton import rclpy_implementation

from router.compiler.compiled_table import CalledPlan, ClientCallPlan, ServicePlan, TopicPlan
from router.declared import Demand
from router.errors import SourceSpan
from router.ros.endpoints import Publication, RosChange, Subscription, open_missing, unused
from router.ros.events import EventThread, Incompatible, PeerEvents, SubscriberJoined
from router.ros.graph import GraphWatch, Ours, Surroundings
from router.ros.marks import Mark
from router.ros.node import close_node, open_node
from router.ros.services import CallingClient, ServedService, close_services
from router.ros.topics import RosTopics
from router.table.model.settings import NodeSettings


class RouterNode:
    """The node, its publishers and subscriptions, and the thread of their events. Opening raises StartError.

    `publish[topic]` takes CDR bytes. `wanted[topic]`, a byte that is updated in place, says whether the topic has
    subscribers or serves late joiners. `topics` are the discovered topics. `name` includes the namespace:
    `rover1/rover_router`. The messages of its subscriptions are taken elsewhere.

    The event thread calls `subscriber_joined(topic)`. While a topic has peers with an incompatible QoS, and for some
    seconds afterwards, it calls `incompatible(topic, policy, peers)` once per second.

    Topics are replaced in three steps: `prepare` opens new endpoints, `adopt` uses them and waits for their events,
    `finish` closes the unused ones. After `prepare`, `undo` undoes it.
    """

    publish_errors = (rclpy_implementation.RCLError,)
    """The errors that `publish[topic]` may raise."""

    def __init__(
        self,
        node: NodeSettings,
        publishers: Sequence[TopicPlan],
        subscriptions: Sequence[TopicPlan],
        spans: Mapping[str, SourceSpan],
        ros_args: Sequence[str],
        incompatible: Incompatible,
        subscriber_joined: SubscriberJoined = lambda _: None,
    ) -> None:
        self.publish: dict[str, Callable[[bytes], None]] = {}
        self.demands: dict[str, Demand] = {}
        self._publications: dict[str, Publication] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._types: dict[str, str] = {}
        self._published: dict[str, Publication] = {}  # by absolute name
        self._is_stuck = False
        self._is_abandoned = False  # a stuck thread uses subscriptions or publishers
        self._peers = PeerEvents(incompatible, subscriber_joined)
        with ExitStack() as opening:
            self._node = open_node(node.name, node.namespace, ros_args)
            opening.callback(self._close_node)
            self._full_name = self._node.get_fully_qualified_name()
            self.name = self._full_name.removeprefix("/")
            opening.callback(Mark(self._node, self._full_name).close)
            self._graph = GraphWatch(self._node)
            opening.callback(self._graph.close)
            self.topics = RosTopics(self._node, self._types, self._published)
            opening.callback(self._close_topics)
            change = self.prepare(publishers, subscriptions, spans)
            self._use(change)
            self._events = self._event_thread()
            self._events.start()
            opening.callback(self._stop_events)
            self._open = opening.pop_all()

    def leave_open(self) -> None:
        """Have `close` leave everything open, because a thread is stuck while it takes or publishes messages."""
        self._is_abandoned = self._is_stuck = True

    def close(self) -> None:
        """Close the node, when no thread publishes or takes messages."""
        self._open.close()

    def prepare(
        self, publishers: Sequence[TopicPlan], subscriptions: Sequence[TopicPlan], spans: Mapping[str, SourceSpan]
    ) -> RosChange:
        """Open the endpoints of these plans in addition to the open ones. Raises StartError.

        An unchanged plan keeps its endpoint.
        """
        with ExitStack() as opening:
            publications, published = open_missing(
                self._publications, publishers, spans, partial(Publication, self._node, self._peers)
            )
            for publication in published:
                opening.callback(publication.close)
            kept, subscribed = open_missing(
                self._subscriptions, subscriptions, spans, partial(Subscription, self._node, self._peers)
            )
            opening.pop_all()
        for publication in published:
            earlier = self._publications.get(publication.plan.label)
            if earlier is not None and earlier.demand.wanted:
                publication.await_subscribers()
        for subscription in subscribed:
            if subscription.plan.label in self._subscriptions:
                subscription.await_publishers()
        return RosChange(publications, kept, [*published, *subscribed])

    def open_service(self, plan: ServicePlan, eventfd: int) -> ServedService:
        """Open a service whose requests add to `eventfd`, for the caller to close. Raises StartError."""
        return ServedService(self._node, plan, eventfd)

    def open_client(self, plan: CalledPlan | ClientCallPlan, eventfd: int) -> CallingClient:
        """Open a client of a service whose responses add to `eventfd`, likewise."""
        return CallingClient(self._node, plan, eventfd)

    def close_services(self, services: Collection[ServedService]) -> None:
        """Close services, after clients have had time to take the last response. Calls until then are cancelled."""
        close_services(services)

    def undo(self, change: RosChange) -> None:
        """Close the endpoints that `prepare` has opened."""
        for opened in change.opened:
            opened.close()

    @property
    def surroundings(self) -> Surroundings:
        """What was last seen in the graph."""
        return self._graph.now

    def subscribers(self) -> Iterator[tuple[str, int]]:
        """Yield the published topics, each with the number of its subscribers."""
        for topic, publication in list(self._publications.items()):
            yield topic, publication.subscribers

    def stalled(self) -> Iterator[tuple[str, float]]:
        """Yield the topics on which Python threads are publishing now, each with the seconds since they began."""
        for topic, publication in list(self._publications.items()):
            if seconds := publication.stalled():
                yield topic, seconds

    def adopt(self, change: RosChange) -> None:
        """Use the endpoints of the change: wait for their events, and update `wanted` from now on."""
        change.unused = [
            *unused(change.publications, self._publications),
            *unused(change.subscriptions, self._subscriptions),
        ]
        self._use(change)
        if change.unused or change.opened:
            self._events.stop()
            self._events = self._event_thread()
            self._events.start()

    def finish(self, change: RosChange) -> None:
        """Close unused endpoints; no thread may publish on them or wait for their events."""
        for topic in self.publish.keys() - self._publications.keys():
            del self.publish[topic], self.demands[topic]
        for opened in change.unused:
            self._close_one(opened)

    def _use(self, change: RosChange) -> None:
        self._publications, self._subscriptions = change.publications, change.subscriptions
        received, published = (
            {endpoint.topic: endpoint.plan for endpoint in endpoints.values()}
            for endpoints in (change.subscriptions, change.publications)
        )
        self._ours = Ours(self._full_name, received, published)
        self._published.clear()
        self._published.update((publication.topic, publication) for publication in change.publications.values())
        self._types.clear()
        self._types.update((topic, plan.type_name) for topic, plan in (received | published).items())
        self.publish.update((topic, publication.publish) for topic, publication in change.publications.items())
        self.demands.update((topic, publication.demand) for topic, publication in change.publications.items())

    def _event_thread(self) -> EventThread:
        return EventThread(
            self._node,
            [event for publication in self._publications.values() for event in publication.events],
            [event for subscription in self._subscriptions.values() for event in subscription.events],
            self._check,
        )

    def _check(self) -> None:
        self._peers.check(self._node, self._publications, self._subscriptions)
        self._graph.check(self._ours)

    def _stop_events(self) -> None:
        self._events.stop()

    def _close_topics(self) -> None:
        for publication in self._publications.values():
            self._close_one(publication)
        for subscription in self._subscriptions.values():
            self._close_one(subscription)

    def _close_one(self, endpoint: Publication | Subscription) -> None:
        if self._is_abandoned:
            return
        if isinstance(endpoint, Subscription):
            endpoint.close()
        elif not endpoint.close():
            self._is_stuck = True

    def _close_node(self) -> None:
        """Close the node, unless a thread is in the middleware, which makes that impossible."""
        if not self._is_stuck:
            close_node(self._node)
