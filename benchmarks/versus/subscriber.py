"""The ROS subscriber of a measurement, and what it should get. Knows nothing of what publishes to it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from benchmarks.versus.helpers import Helper, Topic, subscriber


def number_of(wanted: Collection[str], sent: int, cases: Sequence[str]) -> int:
    """How many of so many datagrams are of the wanted payload cases, when `cases` take turns."""
    rounds, rest = divmod(sent, len(cases))
    return sum(rounds + (place < rest) for place, case in enumerate(cases) if case in wanted)


class Heard(NamedTuple):
    """How many messages came, and the latency of those that are stamped, in microseconds."""

    received: int
    latency_us: dict[str, float] | None


class Subscriber:
    """One process that subscribes to some of a subject's topics."""

    def __init__(self, helper: Helper, topics: Sequence[Topic]) -> None:
        self._helper = helper
        self._cases = {topic.case for topic in topics}

    def heard(self) -> Heard:
        """Since this was asked the last time."""
        return Heard(**self._helper.ask())

    def expected(self, sent: int, cases: Sequence[str]) -> int:
        """How many messages so many datagrams should have become, whose payload cases took turns."""
        return number_of(self._cases, sent, cases)


@contextmanager
def subscribed(topics: Sequence[Topic]) -> Iterator[Subscriber | None]:
    """A subscriber while the context lasts; none if there are no topics."""
    if not topics:
        yield None
        return
    with subscriber(topics) as helper:
        yield Subscriber(helper, topics)
