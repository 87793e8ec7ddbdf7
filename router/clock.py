"""The monotonic clock, for durations, and the wall clock, for time stamps. Both in ns."""

from time import monotonic_ns
from time import time_ns as wall_ns

__all__ = ["monotonic_ns", "wall_ns"]
