"""Clocks in ns: `boottime_ns` for ages, deadlines and rates, `monotonic_ns` for waits, `wall_ns` for time stamps.

While the computer is suspended the monotonic clock stands still, and the boot clock goes on: a command from before the
suspend is as old afterwards as it is, and a deadman whose time has passed meanwhile trips at once. Waits stop with the
computer anyway.
"""

import time
from functools import partial
from time import monotonic_ns
from time import time_ns as wall_ns

boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)

__all__ = ["boottime_ns", "monotonic_ns", "wall_ns"]
