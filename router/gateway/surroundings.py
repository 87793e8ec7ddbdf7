"""What all gateways of a router share. Opens nothing and owns nothing."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from router.gateway.hub import Hub


@dataclass(frozen=True, slots=True)
class Surroundings:
    """`converting` and `reading` are for what would hold up the loop: large messages from ROS, and from clients, which
    need not wait for those. `failed` hears of faults of the router itself. Clocks in ns.
    """

    hub: Hub
    converting: Executor
    reading: Executor
    failed: Callable[[Exception], None]
    clock_ns: Callable[[], int]
    wall_ns: Callable[[], int]

    def wall_s(self) -> float:
        return self.wall_ns() * 1e-9
