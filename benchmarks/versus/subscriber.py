"""The ROS subscriber of a measurement, and what it should get. Knows nothing of what publishes to it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

from benchmarks.versus.helpers import Helper, Topic, subscriber


def number_of(wanted: Collection[str], sent: int, cases: Sequence[str]) -> int:
    """How many of so many datagrams are of the wanted payload cases, when `cases` take turns."""
    rounds, rest = divmod(sent, len(cases))
    return sum(rounds + (place < rest) for place, case in enumerate(cases) if case in wanted)


class Subscriber:
    """One process that subscribes to some of a subject's topics."""

    def __init__(self, helper: Helper, topics: Sequence[Topic]) -> None:
        self._helper = helper
        self._cases = {topic.case for topic in topics}

    def received(self) -> int:
        return int(self._helper.ask()["received"])

    def expected(self, sent: int, cases: Sequence[str]) -> int:
        """How many messages so many datagrams should have become, whose payload cases took turns."""
        return number_of(self._cases, sent, cases)

    def stop(self) -> dict[str, float]:
        """Latencies in microseconds, of all stamped messages since the start."""
        latencies: dict[str, float] = self._helper.stop()["latency_us"]
        return latencies


@contextmanager
def subscribed(topics: Sequence[Topic]) -> Iterator[Subscriber | None]:
    """A subscriber while the context lasts; none if there are no topics."""
    if not topics:
        yield None
        return
    with subscriber(topics) as helper:
        yield Subscriber(helper, topics)
