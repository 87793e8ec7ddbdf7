"""Numbers, ages and latencies in the words of `router top`."""

from __future__ import annotations

import math
from collections.abc import Mapping

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.table.units import duration


def reasons_text(dropped: Mapping[str, int]) -> str:
    """`12 stale, 3 queue_full`, the largest first."""
    by_count = sorted(dropped.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{count} {reason}" for reason, count in by_count)


def latency_text(seconds: float | None) -> str:
    """`35 us`, `1.2 ms`; `-` for None."""
    if seconds is None:
        return "-"
    if math.isinf(seconds):
        return f"> {duration(HISTOGRAM_BOUNDS_NS[-1])}"
    return f"{seconds * 1e6:.0f} us" if seconds < 1e-3 else f"{seconds * 1e3:.1f} ms"
