"""`max_rate`: which messages of a stream may pass so that the rate is right on average."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil

NS = 1_000_000_000


def rate_limit(hertz: float) -> Callable[[int], bool]:
    """A function of the monotonic time in ns that says whether a message may pass now.

    Passes keep to a grid of one period. A message up to half a period off takes its place on the grid (an
    interval throttle would wait for the next and undershoot: 25 instead of 30 Hz out of 100); after a pause
    the grid starts anew, so nothing is saved up for a burst. In any second at most `hertz` + 1 pass.
    """
    period = ceil(NS / hertz)
    early = period // 2
    late = period - early
    due: int | None = None

    def may_pass(now: int) -> bool:
        nonlocal due
        if due is None or now - due >= late:
            due = now + period
        elif now < due - early:
            return False
        else:
            due += period
        return True

    return may_pass
