"""Selects the type of a topic that a gateway serves, and the QoS of the subscription."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import DiscoveredPublisher


class Selection(NamedTuple):
    """How to subscribe to a topic. `keeps` (`transient_local`) is set if all publishers keep messages for late joiners.

    `others` are the types that are not served, most publishers first. `is_ours`: only this router publishes.
    `keepers` are the gids of the publishers that keep messages.
    """

    type_name: str
    is_reliable: bool
    keeps: bool
    others: tuple[str, ...]
    is_ours: bool = False
    keepers: frozenset[bytes] = frozenset()

    @property
    def is_mixed(self) -> bool:
        """Whether only some publishers keep messages. A subscription to all publishers then gets no latched ones."""
        return bool(self.keepers) and not self.keeps


def select(
    publishers: Sequence[DiscoveredPublisher], *, is_inbound: bool, table_type: str | None = None
) -> Selection | None:
    """Return a type, and a QoS compatible with all its publishers.

    It is `table_type`, the only one that the router can use if the table has the topic. If that has no publisher, it is
    the most frequent type (in a tie, the first by name).

    On an inbound topic this router's publishers do not count: clients would get back their own messages. Returns None
    if no publisher is left.
    """
    counted = [publisher for publisher in publishers if not (is_inbound and publisher.is_ours)]
    if not counted:
        return None
    types = list(by_frequency(publisher.type_name for publisher in counted))
    type_name = table_type if table_type in types else types[0]
    others = [other for other in types if other != type_name]
    selected = [publisher for publisher in counted if publisher.type_name == type_name]
    is_reliable = all(publisher.is_reliable for publisher in selected)
    keeps = is_reliable and all(publisher.keeps for publisher in selected)
    is_ours = all(publisher.is_ours for publisher in counted)
    return Selection(type_name, is_reliable, keeps, tuple(others), is_ours, keepers(counted, type_name))


def keepers(publishers: Iterable[DiscoveredPublisher], type_name: str) -> frozenset[bytes]:
    """Return the gids of the publishers that keep messages for late joiners."""
    return frozenset(
        publisher.gid
        for publisher in publishers
        if publisher.type_name == type_name and publisher.keeps and publisher.is_reliable
    )


def by_frequency(type_names: Iterable[str]) -> dict[str, int]:
    """Count equal names, the most frequent first."""
    times = Counter(type_names)
    return {name: times[name] for name in sorted(times, key=lambda name: (-times[name], name))}
