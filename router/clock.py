"""The two clocks: one that only goes forward, for durations, and the calendar, for stamps. Both in nanoseconds."""

from time import monotonic_ns
from time import time_ns as wall_ns

__all__ = ["monotonic_ns", "wall_ns"]
