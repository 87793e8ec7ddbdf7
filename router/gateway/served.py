"""A topic that a gateway serves: which of its messages were seen, and what is being made of them. Knows no client."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from router.gateway.feeds import Feed
from router.gateway.following import Choice
from router.gateway.samples import Sample
from router.table.model import EACH

MOST_UNCONVERTED = 4
"""Large messages of one topic that wait to be converted, where every message is to be sent."""


@dataclass(slots=True)
class Served:
    """`period` in ns, EACH for every message. `counted` is what of `feed.arrived` is in the counters, of `feed.missed`
    where every message is handed on; `told` is what of `feed.arrived` was told to clients as a rate. `number` tells
    when in a period it has its turn. `sample` is the latest one that was looked at, `readable` the latest that could be
    converted. `is_busy` while a large one is converted, for which `unconverted` wait.
    """

    feed: Feed
    choice: Choice
    period: int
    number: int
    counted: int = 0
    told: int = 0
    sample: Sample | None = None
    readable: Sample | None = None
    is_busy: bool = False
    has_ended: bool = False
    unconverted: deque[Sample] = field(default_factory=deque)

    @classmethod
    def fresh(cls, feed: Feed, choice: Choice, period: int, number: int) -> Served:
        """One that is served from now on. A latest value that is there already, because another gateway follows the
        topic, counts as one that comes: publishers that keep it for late joiners do not send it again.
        """
        known = feed.latest() is not None
        arrived = feed.arrived
        counted = feed.missed if period == EACH else arrived - known
        return cls(feed, choice, period, number, counted=counted, told=arrived)

    def came(self) -> int:
        """Messages since this was asked last; where every one is handed on, those that were not."""
        total = self.feed.missed if self.period == EACH else self.feed.arrived
        came, self.counted = total - self.counted, total
        return came
