"""A router that only counts, with clocks that a test sets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

from prometheus_client.metrics_core import Metric as Family

from router.compiler.program import Program
from router.observe.health import Look
from router.observe.metrics import Asked, CountersCollector
from router.observe.running import Running
from router.observe.watch import Watch

SECOND = 10**9
WALL = 1_800_000_000 * SECOND

TABLE = """\
version: 1
extends: {routes}/rover.yaml
endpoints:
  sensor_board: {{stale_after: 3s}}
  arm_board: {{stale_after: never}}
gateways:
  dashboard:
    inbound:
      - topic: /cmd_vel
        type: geometry_msgs/msg/Twist
        deadman: {{timeout: 500ms, send: {{}}}}
"""


@dataclass
class Counting:
    """A router in so far as it counts."""

    program: Program
    counts: list[int]
    kernel_drops: int = 0
    is_waiting: bool = False
    stalled: dict[str, float] = field(default_factory=lambda: {"imu_data": 0.0})
    now: int = 0
    shift: int = 0
    is_stuck: bool = False
    watch: Watch = field(init=False)
    _turns: int = 0

    def __post_init__(self) -> None:
        asked: dict[str, Asked] = {
            "kernel_drops": lambda: [(["rover"], self.kernel_drops)],
            "listener_waiting": lambda: [(["rover"], self.is_waiting)],
            "publish_stalled_seconds": lambda: [((topic,), each) for topic, each in self.stalled.items()],
        }
        self._collector = CountersCollector(self.program.counters, lambda: [self.counts], asked, {})
        self.watch = Watch(cast("Running", self))
        self.add(1, "config_last_reload_successful")

    def collect(self) -> Iterator[Family]:
        return self._collector.collect()

    def add(self, times: int, metric: str, *labels: str) -> None:
        self.counts[self.program.counters.index(metric, *labels)] += times

    def set_to(self, value: int, metric: str, *labels: str) -> None:
        self.counts[self.program.counters.index(metric, *labels)] = value

    @property
    def wall(self) -> int:
        return WALL + self.now + self.shift

    def hear(self, endpoint: str) -> None:
        self.set_to(self.wall, "endpoint_last_seen_timestamp_seconds", endpoint)

    def progress(self) -> int:
        self._turns += not self.is_stuck
        return self._turns

    def look(self, after: float) -> Look:
        """So many seconds later."""
        self.now += int(after * SECOND)
        return self.watch.look(self.now, self.wall)

    def told(self, after: float) -> list[str]:
        """What is wrong then, in words."""
        return [problem.text for problem in self.look(after).problems]
