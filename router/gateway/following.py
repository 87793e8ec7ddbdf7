"""Which of a topic's publishers a gateway goes by. Pure: it is told of publishers, and opens nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # which imports rclpy
    from router.ros.topics import SeenPublisher


class Choice(NamedTuple):
    """How a topic is subscribed to. `keeps` asks for what was kept for those who join late.

    `others` are the types that are not served, most publishers first. `is_ours`: nobody else publishes on it.
    """

    type_name: str
    is_reliable: bool
    keeps: bool
    others: tuple[str, ...]
    is_ours: bool = False


def choice(publishers: Sequence[SeenPublisher], *, is_let_in: bool) -> Choice | None:
    """The type that most publishers have (of several the first by name), with a QoS that hears each of them.

    Of a topic that is let in our own publishers do not count: what clients sent would go back to them. None where
    nobody is left.
    """
    counted = [publisher for publisher in publishers if not (is_let_in and publisher.is_ours)]
    if not counted:
        return None
    type_name, *others = by_frequency(publisher.type_name for publisher in counted)
    heard = [publisher for publisher in counted if publisher.type_name == type_name]
    is_reliable = all(publisher.is_reliable for publisher in heard)
    keeps = is_reliable and all(publisher.keeps for publisher in heard)
    is_ours = all(publisher.is_ours for publisher in counted)
    return Choice(type_name, is_reliable, keeps, tuple(others), is_ours)


def by_frequency(type_names: Iterable[str]) -> dict[str, int]:
    """How often each is there, the most frequent first."""
    times = Counter(type_names)
    return {name: times[name] for name in sorted(times, key=lambda name: (-times[name], name))}
