"""One fresh process of one contender, and how long things take. Knows no figure."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.versus.contenders import Contender, Ports
from benchmarks.versus.subject import Subject

Metrics = dict[str, float]


@dataclass(frozen=True)
class Pace:
    """How much time a measurement takes, in seconds: `longest` is that of any run, `settle` from started to measured.

    `retries`: how often a run is repeated because something disturbed it. `step`: how finely the highest rate is found.
    """

    seconds: float = 4
    longest: float = 60
    settle: float = 1.5
    retries: int = 4
    step: float = 1.05
    most_rates: int = 10

    def rates(self, rates: Sequence[float]) -> Sequence[float]:
        return rates[: self.most_rates]


QUICK = Pace(seconds=0.3, longest=0.3, settle=0.2, retries=0, step=4, most_rates=1)
"""To see that it works."""


@dataclass(frozen=True)
class Trial:
    """`folder` is for whatever has to be written down."""

    contender: Contender
    pace: Pace
    folder: Path

    def start(self, ports: Ports | None = None) -> Subject:
        """The process, just started."""
        return Subject(self.contender, ports or Ports.free(), self.folder / f"{self.contender.name}.log")

    @contextmanager
    def started(self) -> Iterator[Subject]:
        """The process, ready for datagrams."""
        with self.start() as subject:
            if self.contender.listens:
                subject.wait_until_bound()
            time.sleep(self.pace.settle)
            yield subject


Measure = Callable[[Trial], Metrics]
"""All figures of one fresh process, by name: `METRIC`, or `METRIC@CONDITION`, which mostly is a rate."""
