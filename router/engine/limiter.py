"""`max_rate`: which messages of a stream may pass so that the rate is right on average."""

from __future__ import annotations

from collections.abc import Callable

NS = 1_000_000_000


def rate_limit(hertz: float) -> Callable[[int], bool]:
    """A function of the monotonic time in ns that says whether a message may pass now.

    Passes keep to a grid of one period. A message up to half a period early takes its place on the grid
    (an interval throttle would wait for the next and undershoot: 25 instead of 30 Hz out of 100); after a
    pause the grid starts anew, so nothing is saved up for a burst.
    """
    period = round(NS / hertz)
    early = period // 2
    due: int | None = None

    def may_pass(now: int) -> bool:
        nonlocal due
        if due is None or now - due >= period:
            due = now + period
        elif now < due - early:
            return False
        else:
            due += period
        return True

    return may_pass
