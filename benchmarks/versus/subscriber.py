"""The ROS subscriber of a measurement, and what it should get. Knows nothing of what publishes to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from benchmarks.versus.helpers import Helper, Topic, subscriber


class Subscriber:
    """One process that subscribes to some of a subject's topics."""

    def __init__(self, helper: Helper, topics: Sequence[Topic]) -> None:
        self._helper = helper
        self._cases = {topic.case for topic in topics}

    def received(self) -> int:
        return int(self._helper.ask()["received"])

    def expected(self, sent: int, cases: Sequence[str]) -> int:
        """How many messages so many datagrams should have become, whose payload cases took turns."""
        rounds, rest = divmod(sent, len(cases))
        return rounds * sum(case in self._cases for case in cases) + sum(case in self._cases for case in cases[:rest])

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
