"""Routes from ROS as the carrier executes them, and the subscriptions whose messages they route."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import ctypes

    from router import declared as c
    from router.carrier.loading import LoadedImage


class Subscription(Protocol):
    """The protocol of `ros.receiving.RawSubscription`. Only one thread takes its messages."""

    @property
    def address(self) -> int: ...

    @property
    def capacity(self) -> int: ...

    def announce_to(self, eventfd: int | None) -> None: ...

    def take_all(self) -> Sequence[object]: ...


@dataclass(frozen=True, slots=True)
class RosRoutes:
    """The routes of each topic, an array of `struct ros_route` in `image`.

    `urgent` are the topics with an urgent route; `subscriptions` has the subscriptions of all topics.
    """

    topics: Mapping[str, ctypes.Array[c.RosRoute]] = field(default_factory=dict)
    urgent: frozenset[str] = frozenset()
    subscriptions: Mapping[str, Subscription] = field(default_factory=dict)
    image: LoadedImage | None = None

    @classmethod
    def of(cls, image: LoadedImage, subscriptions: Mapping[str, Subscription] = MappingProxyType({})) -> RosRoutes:
        """Return the routes of an image. `subscriptions` are by topic."""
        routes = [*image.ros_routes()]
        urgent = frozenset(topic for topic, _, is_urgent in routes if is_urgent)
        return cls({topic: each for topic, each, _ in routes}, urgent, subscriptions, image)

    def only(self, *, urgent: bool) -> RosRoutes:
        """Return the part for the thread of urgent messages, or for the other thread."""
        return self.without({topic for topic in self.topics if (topic in self.urgent) is not urgent})

    def without(self, topics: Container[str]) -> RosRoutes:
        return replace(self, topics={topic: routes for topic, routes in self.topics.items() if topic not in topics})
