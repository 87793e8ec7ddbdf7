"""Numbers with units: parsing and printing of durations, sizes and rates.

Parsing is exact: fractions of a base unit are rejected. Parsers raise ValueError with a message that says what is
wrong. Printing gives the shortest text that parses as the same number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

_QUANTITY = re.compile(r"([0-9]{1,15})(?:\.([0-9]{1,9}))? ?([A-Za-z]+(?:/s)?)")
NANOSECONDS = {
    "ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "min": 60 * 10**9, "h": 3600 * 10**9,
}  # fmt: skip
BYTES = {"B": 1, "kB": 1000, "KiB": 1 << 10, "MB": 10**6, "MiB": 1 << 20}
DISK_BYTES = {**BYTES, "GB": 10**9, "GiB": 1 << 30}
_BYTES_PER_SECOND = {f"{unit}/s": size for unit, size in BYTES.items()}
_HERTZ = re.compile(r"([0-9]{1,15}(?:\.[0-9]{1,15})?) ?Hz")

MAX_DURATION = (1 << 63) - 1
"""ROS durations are 64-bit nanoseconds."""


MAX_SIZE = (1 << 30) - 1
"""The largest receive buffer that the kernel accepts, which doubles the requested size."""

MAX_DATA_RATE = 10**12
"""Faster than any link; products with nanoseconds stay small integers."""

EACH = "each"
"""Replaces a gateway's period or rate: every message is sent."""

NEVER = "never"
"""Written in place of a duration that never passes."""

MIN_PERIOD = 1_000_000
"""ns. A gateway with a shorter period would do nothing else; `each` sends every message."""

MIN_INTERVAL = 10_000_000
"""ns. Discovery of the ROS graph and sending schemas cost more than data."""

MIN_DATAGRAM = 576
"""Bytes that every IPv4 host accepts."""

MIN_DISK_SIZE, MAX_DISK_SIZE = 1 << 20, 1 << 50
"""Bytes of a recording. Smaller files would be rotated every few datagrams."""

LARGEST_DATAGRAM = 65_507
"""Bytes that one UDP datagram over IPv4 can carry."""

MIN_MESSAGE, MAX_MESSAGE = 1000, 256 << 20

_WHOLE = {"h": 3600 * 10**9, "min": 60 * 10**9}
"""Units without decimals: nobody writes 1.5 min."""
_DECIMAL = {"s": 10**9, "ms": 10**6, "us": 10**3}
_MAX_DECIMALS = 15


@dataclass(frozen=True, slots=True)
class Quantity:
    """The syntax of a kind of number: `parse` reads a scalar's value, `show` prints it.

    `shape` is the definition of the values that fit, in `grammar.values`.
    """

    shape: str
    parse: Callable[[Any], Any]
    show: Callable[[Any], str]


_PART = r"([0-9]{0,15}[.,]?[0-9]{1,15}(?:e[0-9]{1,2})?) ?(1?/s|per second|[a-zµμ]+(?:/s)?)"
_PARTS = re.compile(rf"(?:{_PART} ?)+,?", re.IGNORECASE)
_SPELLINGS = {
    "ns": ("ns", "nsec", "nanosecond"),
    "us": ("us", "µs", "μs", "usec", "microsecond"),
    "ms": ("ms", "msec", "millisecond"),
    "s": ("s", "sec", "second"),
    "min": ("min", "m", "minute"),
    "h": ("h", "hour"),
    "Hz": ("hz", "hertz", "/s", "1/s", "per second"),
    "B": ("b", "byte"),
    "kB": ("kb", "k", "kilobyte"),
    "KiB": ("kib", "ki", "k"),
    "MB": ("mb", "m", "megabyte"),
    "MiB": ("mib", "mi", "m"),
    "GB": ("gb", "g", "gigabyte"),
    "GiB": ("gib", "gi", "g"),
}
"""Units, with the spellings that people use, in lower case."""
_CONVERTED: Mapping[str, tuple[Fraction | int, str]] = {
    "d": (24, "h"),
    "day": (24, "h"),
    "khz": (1000, "Hz"),
    **dict.fromkeys(("bps", "bit/s", "bit"), (Fraction(1, 8), "B/s")),
    **dict.fromkeys(("kbps", "kbit/s", "kbit"), (Fraction(1, 8), "kB/s")),
    **dict.fromkeys(("mbps", "mbit/s", "mbit"), (Fraction(1, 8), "MB/s")),
}
"""Units that tables do not support, as a multiple of one that they do."""


def meant_quantity(text: str, fits: Callable[[str], bool]) -> str:
    """Return `did you mean '4MB' or '4MiB'?` for the quantities that the text may stand for and that fit, or empty."""
    meant = [f"'{quantity}'" for quantity in dict.fromkeys(_meanings(text)) if fits(quantity)]
    return f"did you mean {' or '.join(meant)}?" if meant else ""


def _meanings(text: str) -> Iterator[str]:
    """Yield quantities of all kinds that the text may stand for; durations also as rates, and the reverse."""
    if not _PARTS.fullmatch(text):
        return
    parts = [(number.replace(",", "."), unit.lower()) for number, unit in re.findall(_PART, text, re.IGNORECASE)]
    if len(parts) > 1:
        units = [next((NANOSECONDS[unit] for _, unit in _units(word) if unit in NANOSECONDS), 0) for _, word in parts]
        if all(units):
            times = zip(parts, units, strict=True)
            yield duration(int(sum(Fraction(number) * unit for (number, _), unit in times)))
        return
    [(number, written)] = parts
    for factor, unit in _units(written):
        amount = Fraction(number) * factor
        is_kept = factor == 1 and number[0] != "." and "e" not in number.lower()
        yield f"{number if is_kept else f'{float(amount):.15g}'}{' ' * (unit == 'Hz')}{unit}"
        if unit in NANOSECONDS and amount:
            yield f"{float(10**9 / (amount * NANOSECONDS[unit])):.6g} Hz"
        if unit == "Hz" and amount:
            yield duration(round(10**9 / amount))


def _units(written: str) -> list[tuple[Fraction | int, str]]:
    """Return what a unit may stand for, as multiples of units of tables. A `/s` may be missing or superfluous."""
    for word in (written, written.removesuffix("s")):
        units = [_CONVERTED[word]] if word in _CONVERTED else []
        units += [(1, unit) for unit, spellings in _SPELLINGS.items() if word in spellings]
        sizes = [unit for unit in DISK_BYTES if word.removesuffix("/s") in _SPELLINGS[unit]]
        if units := [*units, *((1, f"{unit}{end}") for unit in sizes for end in ("", "/s"))]:
            return units
    return []


def parse_duration(text: str) -> int:
    """Parse `500ms` as nanoseconds."""
    return _exact(text, NANOSECONDS, "nanoseconds", MAX_DURATION)


def parse_period(text: str) -> int:
    """Parse `500ms` as nanoseconds, for the period of a gateway."""
    period = parse_duration(text)
    if period < MIN_PERIOD:
        raise ValueError(f"'{text}' is shorter than {MIN_PERIOD // 10**6}ms; to send every message, write 'each'")
    return period


def parse_interval(text: str) -> int:
    """Parse `5s` as nanoseconds, for the interval of a rare task."""
    interval = parse_duration(text)
    if interval < MIN_INTERVAL:
        raise ValueError(f"'{text}' is shorter than {MIN_INTERVAL // 10**6}ms")
    return interval


def parse_rate(value: str | float) -> float:
    """Parse `30 Hz` or a plain number as Hz."""
    if isinstance(value, str):
        if not (match := _HERTZ.fullmatch(value)):
            raise ValueError(f"'{value}' is not a rate such as '30 Hz'{_meaning(value, 'Hz')}")
        value = float(match[1])
    if not 0 < value < math.inf:
        raise ValueError("a rate must be above zero")
    return float(value)


def parse_topic_rate(value: str | float) -> int:
    """Parse `50 Hz` or a plain number as a period in nanoseconds."""
    period = round(1e9 / parse_rate(value))
    if not MIN_PERIOD <= period <= MAX_DURATION:
        raise ValueError(f"'{value}' is above {10**9 // MIN_PERIOD} Hz; to send every message, write 'each'")
    return period


def _meaning(text: str, *units: str) -> str:
    """Return `; did you mean '200ms'?` if the text may be a quantity with one of the units, else empty."""
    meant = meant_quantity(text, lambda quantity: quantity != text and quantity.lstrip("0123456789. ") in units)
    return f"; {meant}" if meant else ""


def _exact(text: str, units: Mapping[str, int], base: str, largest: int, smallest: int = 1) -> int:
    match = _QUANTITY.fullmatch(text)
    if not match or match[3] not in units:
        raise ValueError(f"'{text}' is not a number with one of the units {', '.join(units)}{_meaning(text, *units)}")
    fraction = match[2] or ""
    amount, rest = divmod(int(match[1] + fraction) * units[match[3]], int("1" + "0" * len(fraction)))
    if rest:
        raise ValueError(f"'{text}' is not a whole number of {base}")
    if not smallest <= amount <= largest:
        least = "above zero" if smallest == 1 else f"at least {smallest}"
        raise ValueError(f"'{text}' must be {least} and at most {largest} {base}")
    return amount


def duration(ns: int) -> str:
    """Print a duration: `500 ms`, `1.5 s`, `1 h`."""
    for unit, size in _WHOLE.items():
        if ns >= size and ns % size == 0:
            return f"{ns // size} {unit}"
    for unit, size in _DECIMAL.items():
        if ns >= size:
            whole, rest = divmod(ns, size)
            digits = f"{rest:0{len(str(size)) - 1}}".rstrip("0")
            return f"{whole}.{digits} {unit}" if digits else f"{whole} {unit}"
    return f"{ns} ns"


def rate(hertz: float) -> str:
    """Print a rate: `30 Hz`."""
    return _in_hertz(hertz, lambda text: parse_rate(text) == hertz)


def topic_rate(ns: int) -> str:
    """Print a period as a rate: `50 Hz`."""
    return _in_hertz(1e9 / ns, lambda text: parse_topic_rate(text) == ns)


def _in_hertz(hertz: float, is_same: Callable[[str], bool]) -> str:
    """Print a rate with as few decimals as give the same number."""
    for decimals in range(_MAX_DECIMALS):
        text = f"{hertz:.{decimals}f} Hz"
        if float(text[:-3]) and is_same(text):
            return text
    return f"{hertz:.{_MAX_DECIMALS}f} Hz"


def _or(shape: str, word: str, quantity: Quantity, instead: int | None = 0) -> Quantity:
    """Return the quantity with an additional word, which is parsed as `instead`."""
    return Quantity(
        shape,
        lambda text: instead if text == word else quantity.parse(text),
        lambda value: quantity.show(value) if value else word,
    )


def _bytes(shape: str, units: Mapping[str, int], base: str, largest: int, smallest: int = 1) -> Quantity:
    """Return a quantity of bytes, printed in the largest unit that gives a whole number."""

    def show(count: int) -> str:
        unit = next(unit for unit in reversed([*units]) if count % units[unit] == 0)
        return f"{count // units[unit]} {unit}"

    return Quantity(shape, lambda text: _exact(text, units, base, largest, smallest), show)


DURATION = Quantity("duration", parse_duration, duration)
PATIENCE = _or("patience", NEVER, DURATION, instead=None)
VALIDITY = _or("patience", NEVER, DURATION)
PERIOD = _or("period", EACH, Quantity("duration", parse_period, duration))
INTERVAL = Quantity("duration", parse_interval, duration)
RATE = Quantity("rate", parse_rate, rate)
TOPIC_RATE = _or("topic_rate", EACH, Quantity("rate", parse_topic_rate, topic_rate))
SIZE = _bytes("size", BYTES, "bytes", MAX_SIZE)
"""Size of a buffer."""
DATAGRAM_SIZE = _bytes("size", BYTES, "bytes", LARGEST_DATAGRAM, MIN_DATAGRAM)
MESSAGE_SIZE = _bytes("size", BYTES, "bytes", MAX_MESSAGE, MIN_MESSAGE)
"""Size of one message as text."""
DISK_SIZE = _bytes("disk_size", DISK_BYTES, "bytes", MAX_DISK_SIZE, MIN_DISK_SIZE)
"""Size of files."""
DATA_RATE = _bytes("data_rate", _BYTES_PER_SECOND, "bytes per second", MAX_DATA_RATE)
