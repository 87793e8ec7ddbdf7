"""Numbers with units: durations, sizes and rates, from the text of a table and back.

Parsing is exact: what does not come to a whole base unit is refused. Every `parse_*` raises ValueError with a sentence
that says what is wrong. Formatting gives the shortest text that is parsed as the same number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

_QUANTITY = re.compile(r"([0-9]{1,15})(?:\.([0-9]{1,9}))? ?([A-Za-z]+(?:/s)?)")
_NANOSECONDS = {
    "ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9,
}  # fmt: skip
_BYTES = {"B": 1, "kB": 1000, "KiB": 1 << 10, "MB": 10**6, "MiB": 1 << 20}
_DISK_BYTES = {**_BYTES, "GB": 10**9, "GiB": 1 << 30}
_BYTES_PER_SECOND = {f"{unit}/s": size for unit, size in _BYTES.items()}
_HERTZ = re.compile(r"([0-9]{1,15}(?:\.[0-9]{1,15})?) ?Hz")

MAX_DURATION = (1 << 63) - 1
"""ROS durations are 64-bit nanoseconds."""

MAX_COALESCE = 10_000_000
"""Longer than that, what waits no longer pays: the wake-ups that 10 ms leave cost next to nothing."""

MAX_SIZE = (1 << 30) - 1
"""The largest receive buffer that the kernel takes, which doubles what it is asked for."""

MAX_DATA_RATE = 10**12
"""More than any link carries; what is multiplied with nanoseconds stays a small integer."""

EACH = "each"
"""In place of a gateway's period or rate: every message is sent."""

NEVER = "never"
"""In place of a duration: what waits for it to pass does not happen."""

MIN_PERIOD = 1_000_000
"""ns. A gateway that ticks faster does nothing else; `each` is meant for that."""

MIN_INTERVAL = 10_000_000
"""ns. Looking at the ROS graph, and sending schemas, costs more than data."""

MIN_DATAGRAM = 576
"""Bytes that every IPv4 host takes."""

MIN_DISK_SIZE, MAX_DISK_SIZE = 1 << 20, 1 << 50
"""Bytes of recordings: a file that is smaller would be begun anew with every few datagrams."""

LARGEST_DATAGRAM = 65_507
"""Bytes that one UDP datagram over IPv4 can carry."""

MIN_MESSAGE, MAX_MESSAGE = 1000, 256 << 20

_WHOLE = {"h": 3600 * 10**9, "min": 60 * 10**9}
"""Nobody writes 1.5 min."""
_DECIMAL = {"s": 10**9, "ms": 10**6, "us": 10**3}
_MAX_DECIMALS = 15


@dataclass(frozen=True, slots=True)
class Quantity:
    """How a table writes a kind of number: `parse` reads a scalar's value, `show` gives its text."""

    parse: Callable[[Any], Any]
    show: Callable[[Any], str]


def parse_duration(text: str) -> int:
    """`500ms` as nanoseconds."""
    return _exact(text, _NANOSECONDS, "nanoseconds", MAX_DURATION)


def parse_coalesce(text: str) -> int:
    """`1ms` as nanoseconds, or `never` as 0."""
    return 0 if text == NEVER else _exact(text, _NANOSECONDS, "nanoseconds", MAX_COALESCE)


def parse_size(text: str) -> int:
    """`4MiB` or `64kB` as bytes."""
    return _exact(text, _BYTES, "bytes", MAX_SIZE)


def parse_disk_size(text: str) -> int:
    """`4GiB` as bytes of files."""
    return _exact(text, _DISK_BYTES, "bytes", MAX_DISK_SIZE, MIN_DISK_SIZE)


def parse_patience(text: str) -> int:
    """`5s` as nanoseconds, or `never` as 0."""
    return 0 if text == NEVER else parse_duration(text)


def parse_datagram_size(text: str) -> int:
    """`1400B` as bytes of a UDP datagram."""
    return _exact(text, _BYTES, "bytes", LARGEST_DATAGRAM, MIN_DATAGRAM)


def parse_message_size(text: str) -> int:
    """`16MiB` as bytes of one message's text."""
    return _exact(text, _BYTES, "bytes", MAX_MESSAGE, MIN_MESSAGE)


def parse_period(text: str) -> int:
    """`500ms` as nanoseconds, or `each` as 0."""
    period = 0 if text == EACH else parse_duration(text)
    if 0 < period < MIN_PERIOD:
        raise ValueError(f"'{text}' is shorter than {MIN_PERIOD // 10**6}ms; 'each' sends every message")
    return period


def parse_interval(text: str) -> int:
    """`5s` as nanoseconds, for what is done now and then."""
    interval = parse_duration(text)
    if interval < MIN_INTERVAL:
        raise ValueError(f"'{text}' is shorter than {MIN_INTERVAL // 10**6}ms")
    return interval


def parse_data_rate(text: str) -> int:
    """`500kB/s` as bytes per second."""
    return _exact(text, _BYTES_PER_SECOND, "bytes per second", MAX_DATA_RATE)


def parse_rate(value: str | float) -> float:
    """`30 Hz` or a plain number as Hz."""
    if isinstance(value, str):
        if not (match := _HERTZ.fullmatch(value)):
            raise ValueError(f"'{value}' is not a rate such as '30 Hz'")
        value = float(match[1])
    if not 0 < value < math.inf:
        raise ValueError("a rate must be above zero")
    return float(value)


def parse_topic_rate(value: str | float) -> int:
    """`50 Hz` or a plain number as a period in nanoseconds, or `each` as 0."""
    if value == EACH:
        return 0
    period = round(1e9 / parse_rate(value))
    if not MIN_PERIOD <= period <= MAX_DURATION:
        raise ValueError(f"a topic's rate is at most {10**9 // MIN_PERIOD} Hz, or 'each'")
    return period


def _exact(text: str, units: Mapping[str, int], base: str, largest: int, smallest: int = 1) -> int:
    match = _QUANTITY.fullmatch(text)
    if not match or match[3] not in units:
        raise ValueError(f"'{text}' is not a number with a unit of {', '.join(units)}")
    fraction = match[2] or ""
    amount, rest = divmod(int(match[1] + fraction) * units[match[3]], int("1" + "0" * len(fraction)))
    if rest:
        raise ValueError(f"'{text}' is not a whole number of {base}")
    if not smallest <= amount <= largest:
        least = "above zero" if smallest == 1 else f"at least {smallest}"
        raise ValueError(f"'{text}' must be {least} and at most {largest} {base}")
    return amount


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
    """In the largest unit that gives a whole number."""
    unit = next(unit for unit in reversed([*units]) if count % units[unit] == 0)
    return f"{count // units[unit]} {unit}"


def _in_hertz(hertz: float, is_same: Callable[[str], bool]) -> str:
    """With as few decimals as say the same."""
    for decimals in range(_MAX_DECIMALS):
        text = f"{hertz:.{decimals}f} Hz"
        if float(text[:-3]) and is_same(text):
            return text
    return f"{hertz:.{_MAX_DECIMALS}f} Hz"


DURATION = Quantity(parse_duration, duration)
PATIENCE = Quantity(lambda text: parse_patience(text) or None, lambda ns: duration_or_never(ns or 0))
"""None for `never`."""
COALESCE = Quantity(parse_coalesce, duration_or_never)
PERIOD = Quantity(parse_period, period)
INTERVAL = Quantity(parse_interval, duration)
SIZE = Quantity(parse_size, size)
DATAGRAM_SIZE = Quantity(parse_datagram_size, size)
MESSAGE_SIZE = Quantity(parse_message_size, size)
DISK_SIZE = Quantity(parse_disk_size, disk_size)
DATA_RATE = Quantity(parse_data_rate, data_rate)
RATE = Quantity(parse_rate, rate)
TOPIC_RATE = Quantity(parse_topic_rate, topic_rate)
