"""Durations, sizes and rates as a table writes them: the shortest text that `units` reads as the same number.

Knows numbers and units, no key of a table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from router.table.units import EACH, NEVER, parse_rate, parse_topic_rate

_WHOLE = {"h": 3600 * 10**9, "min": 60 * 10**9}
"""Nobody writes 1.5 min."""
_DECIMAL = {"s": 10**9, "ms": 10**6, "us": 10**3}
_BYTES = {"MiB": 1 << 20, "MB": 10**6, "KiB": 1 << 10, "kB": 1000}
_DISK_BYTES = {"GiB": 1 << 30, "GB": 10**9, **_BYTES}
_MAX_DECIMALS = 15


def duration(ns: int) -> str:
    """`500 ms`, `1.5 s`, `1 h`."""
    for unit, size in _WHOLE.items():
        if ns >= size and ns % size == 0:
            return f"{ns // size} {unit}"
    for unit, size in _DECIMAL.items():
        if ns >= size:
            whole, rest = divmod(ns, size)
            digits = f"{rest:0{len(str(size)) - 1}}".rstrip("0")
            return f"{whole}.{digits} {unit}" if digits else f"{whole} {unit}"
    return f"{ns} ns"


def duration_or_never(ns: int) -> str:
    """0 is never."""
    return duration(ns) if ns else NEVER


def period(ns: int) -> str:
    """`500 ms`, or `each` for 0."""
    return duration(ns) if ns else EACH


def size(count: int) -> str:
    """`4 MiB`, `64 kB`, `1400 B`, for buffers and messages."""
    return _in_bytes(count, _BYTES)


def disk_size(count: int) -> str:
    """`4 GiB`."""
    return _in_bytes(count, _DISK_BYTES)


def data_rate(count: int) -> str:
    """`500 kB/s`."""
    return f"{_in_bytes(count, _BYTES)}/s"


def rate(hertz: float) -> str:
    """`30 Hz`."""
    return _in_hertz(hertz, lambda text: parse_rate(text) == hertz)


def topic_rate(ns: int) -> str:
    """A gateway's period as `50 Hz`, or `each` for 0."""
    return _in_hertz(1e9 / ns, lambda text: parse_topic_rate(text) == ns) if ns else EACH


def _in_bytes(count: int, units: Mapping[str, int]) -> str:
    for unit, bytes_ in units.items():
        if count % bytes_ == 0:
            return f"{count // bytes_} {unit}"
    return f"{count} B"


def _in_hertz(hertz: float, is_same: Callable[[str], bool]) -> str:
    """With as few decimals as say the same."""
    for decimals in range(_MAX_DECIMALS):
        text = f"{hertz:.{decimals}f} Hz"
        if float(text[:-3]) and is_same(text):
            return text
    return f"{hertz:.{_MAX_DECIMALS}f} Hz"
