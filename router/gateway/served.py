"""A topic that a gateway serves: which of its messages were seen, and what is being made of them. Knows no client."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from router.gateway.feeds import Feed, Sample
from router.gateway.following import Choice

MOST_UNCONVERTED = 4
"""Large messages of one topic that wait to be converted, where every message is to be sent."""


@dataclass(slots=True)
class Served:
    """`period` in ns, EACH for every message. `counted` and `told` are what of `feed.arrived` is in the books, and was
    told to clients as a rate. `sample` is the latest one that was looked at. `is_busy` while a large one is converted,
    for which `unconverted` wait.
    """

    feed: Feed
    choice: Choice
    period: int
    counted: int = 0
    told: int = 0
    sample: Sample | None = None
    is_busy: bool = False
    unconverted: deque[Sample] = field(default_factory=deque)

    def came(self) -> int:
        """Messages that came since this was asked last."""
        arrived = self.feed.arrived
        came, self.counted = arrived - self.counted, arrived
        return came
