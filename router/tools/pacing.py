"""When the next of a series is due: on an absolute schedule, so that a slow one does not delay all others."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator


def paced(count: int | None, rate: float | None) -> Iterator[float]:
    """Yield `count` times (None: for ever) at `rate` Hz (None: at once) the seconds since the first time."""
    start = time.monotonic()
    for index in itertools.count() if count is None else range(count):
        now = time.monotonic()
        if rate is not None and (wait := start + index / rate - now) > 0:
            time.sleep(wait)
            now = time.monotonic()
        yield now - start
