"""Clocks in ns: `boottime_ns` for ages, deadlines and rates, `monotonic_ns` for waits, `wall_ns` for time stamps.

While the computer is suspended, the monotonic clock stops and the boot clock continues: afterwards, a command from
before the suspend has its true age, and a deadman whose timeout has passed trips at once. Waits are suspended in any
case.
"""

import time
from functools import partial
from time import monotonic_ns
from time import time_ns as wall_ns

boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)

__all__ = ["boottime_ns", "monotonic_ns", "wall_ns"]
