"""The carrier's reasons in words: their names, and why the machine refuses a value (`struct refusal` of `events.h`)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import partial

from router.declared import DropReason, Reason, Refused, Sign
from router.declared import Refusal as NativeRefusal

REJECTIONS = tuple(reason.name.lower() for reason in Reason)
"""The names of `metrics.REJECT_REASONS`, by `enum reason`."""

DROP_REASON_NAMES = tuple(reason.name.lower() for reason in DropReason)
"""The names of `metrics.DROP_REASONS`, by `enum drop_reason`."""


def why_refused(refusal: NativeRefusal, text: bytes) -> str:
    """Describe a `struct refusal`, or return "". `text` is the beginning of a refused text."""
    words = _WORDS.get(Refused(refusal.kind))
    return words(refusal, text) if words else ""


def _integers(refusal: NativeRefusal) -> list[int]:
    """Return the values; the flags say which are unsigned."""
    signs = Sign.FIRST_UNSIGNED, Sign.SECOND_UNSIGNED, Sign.THIRD_UNSIGNED
    values: list[int] = list(refusal.values)
    return [value % (1 << 64) if refusal.flags & sign else value for sign, value in zip(signs, values, strict=True)]


def _integer(refusal: NativeRefusal, _: bytes) -> str:
    value, low, high = _integers(refusal)
    return f"{value} does not fit {_RANGES.get((low, high), f'{low}..{high}')}"


_RANGES: Mapping[tuple[int, int], str] = {
    **{(-(1 << bits - 1), (1 << bits - 1) - 1): f"int{bits}" for bits in (8, 16, 32, 64)},
    **{(0, (1 << bits) - 1): f"uint{bits}" for bits in (8, 16, 32, 64)},
}


def _order(refusal: NativeRefusal, _: bytes) -> str:
    number, last, _unused = _integers(refusal)
    return f"{number} again" if number == last else f"{number} after {last}"


def _bounds(refusal: NativeRefusal, _: bytes) -> str:
    _value, low, high = _integers(refusal)
    return f"the low bound {low} is above the high bound {high}"


def _real(refusal: NativeRefusal) -> float:
    (value,) = struct.unpack("d", struct.pack("q", refusal.values[0]))
    return float(value)


def _result(refusal: NativeRefusal, _: bytes) -> str:
    return f"the function has no result for {_real(refusal)}" if refusal.flags else "the power has no finite result"


def _no_integer(refusal: NativeRefusal, _: bytes) -> str:
    value = _real(refusal)
    return f"{value} does not fit 64 bits" if abs(value) < float("inf") else f"{value} is not an integer"


def _counted(words: str, refusal: NativeRefusal, _: bytes) -> str:
    """Format the first two values, with the unit of the first one."""
    first, second, _unused = refusal.values
    return words.format(first=first, second=second, s="" if first == 1 else "s")


def _quoted(refusal: NativeRefusal, text: bytes) -> str:
    """Quote the beginning of a text."""
    more = "..." * (len(text) < refusal.values[0])
    return f"'{text.decode(errors='backslashreplace')}{more}'"


def _no_utf8(refusal: NativeRefusal, text: bytes) -> str:
    return f"{_quoted(refusal, text)} is not UTF-8: fix its publisher"


def _nul(refusal: NativeRefusal, text: bytes) -> str:
    size = refusal.values[0]
    return f"the text of {size} bytes has a NUL after '{text.decode(errors='replace')}': strip it with strip(...)"


def _no_name(refusal: NativeRefusal, text: bytes) -> str:
    return f"{_quoted(refusal, text)} names no value of the enum"


def _age(since: str, refusal: NativeRefusal, _: bytes) -> str:
    age, ttl, _unused = refusal.values
    hint = ""
    if since == _BY_STAMP and age > _YEAR:
        hint = ": is the publisher on simulated time?"
    elif since in {_BY_STAMP, _BY_SENDER} and age > _MINUTE:
        hint = ": is the publisher's clock right?"
    return f"{since.format(_duration(age))}, but ttl is {_duration(ttl)}{hint}"


_BY_STAMP, _BY_SENDER = "the stamp is {} old", "sent {} ago by the publisher's clock"
_SECOND = 1_000_000_000
_MINUTE, _HOUR, _DAY, _YEAR = 60 * _SECOND, 3600 * _SECOND, 86_400 * _SECOND, 31_557_600 * _SECOND


def _duration(ns: int) -> str:
    for unit, size in (("years", _YEAR), ("days", _DAY), ("hours", _HOUR), ("minutes", _MINUTE)):
        if ns >= 2 * size:
            return f"{ns // size} {unit}"
    return f"{ns / _SECOND:.3g} s" if ns >= _SECOND else f"{ns / 1e6:.3g} ms"


def _always(words: str) -> Callable[[NativeRefusal, bytes], str]:
    return lambda _refusal, _text: words


_WORDS: Mapping[Refused, Callable[[NativeRefusal, bytes], str]] = {
    Refused.MALFORMED: _always("it ends too early, or has another type"),
    Refused.INTEGER: _integer,
    Refused.OVERFLOW: _always("the result does not fit 64 bits"),
    Refused.DIVISION: _always("division by zero"),
    Refused.BOUNDS: _bounds,
    Refused.RESULT: _result,
    Refused.REAL: _no_integer,
    Refused.FLOAT32: lambda refusal, _: f"{_real(refusal)} does not fit float32",
    Refused.SIZE: partial(_counted, "{first} byte{s}, but at most {second} fit"),
    Refused.UTF8: _no_utf8,
    Refused.NUL: _nul,
    Refused.NAME: _no_name,
    Refused.MEMBER: partial(_counted, "the enum has no value {first}"),
    Refused.ELEMENT: partial(_counted, "there is no element [{first}]: the list has {second}"),
    Refused.COUNT: partial(_counted, "{first} element{s}, but {second} are required"),
    Refused.MOST: partial(_counted, "{first} element{s}, but at most {second} fit"),
    Refused.LENGTHS: partial(_counted, "lists side by side have {first} and {second} elements"),
    Refused.WORK: _always("the lists are too long to be processed in time"),
    Refused.ROOM: _always("the lists, the text or the resulting message are too large"),
    Refused.ARRIVAL: partial(_age, "it arrived {} ago"),
    Refused.SENDING: partial(_age, _BY_SENDER),
    Refused.STAMP: partial(_age, _BY_STAMP),
    Refused.ORDER: _order,
    Refused.WAITING: partial(_age, "{} old when it could be sent"),
}
