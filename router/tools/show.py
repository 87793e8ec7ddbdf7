"""A protobuf message as one line of `field=value` words: what `send` takes, `tap` and `sim` print."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from typing import Any

from google.protobuf.message import Message

from router.types.model import Enum, Field, Float, List, MessageType, Type


def words(message: Message, kind: MessageType, digits: int | None = None) -> Iterator[str]:
    """`path=value` of every field that is not its default; `digits` rounds floats, None keeps them exact."""
    for field in kind.fields:
        yield from _field_words(message, field, "", digits)


def compact(message: Message, kind: MessageType, digits: int | None = None) -> str:
    """The words as one line."""
    return one_line(words(message, kind, digits))


def one_line(words: Iterable[str]) -> str:
    """`(all default)` when there are none."""
    return " ".join(map(_printable, words)) or "(all default)"


def _printable(word: str) -> str:
    return word if word.isprintable() and " " not in word else repr(word)


def float_text(value: float, bits: int, digits: int | None = None) -> str:
    """The shortest decimal that reads back as the same float of this width.

    With `digits`, rounded to that many, and to twice as many where somebody chose 64 bits: a degree of
    latitude has 111 km.
    """
    if digits is not None:
        return f"{value:.{digits * bits // 32}g}"
    if not math.isfinite(value):
        return str(value)
    if bits == 64:
        return repr(value)
    packed = struct.pack("<f", value)
    return next(text for p in range(6, 10) if struct.pack("<f", float(text := f"{value:.{p}g}")) == packed)


def rate_text(rate: float) -> str:
    """Per second, in at most four characters up to 9999."""
    return f"{rate:.1f}" if 0 < rate < 9.95 else f"{rate:.0f}"


def _field_words(message: Any, field: Field, prefix: str, digits: int | None) -> Iterator[str]:
    path = prefix + field.name
    if isinstance(field.type, List):
        for index, element in enumerate(getattr(message, field.name)):
            yield from _value_words(element, field.type.element, f"{path}[{index}]", digits)
    elif isinstance(field.type, MessageType) or field.has_presence:
        if message.HasField(field.name):
            yield from _value_words(getattr(message, field.name), field.type, path, digits)
    elif (value := getattr(message, field.name)) or _is_negative_zero(value):
        yield from _value_words(value, field.type, path, digits)


def _is_negative_zero(value: Any) -> bool:
    """Protobuf writes -0.0 although it equals the default."""
    return isinstance(value, float) and math.copysign(1.0, value) < 0


def _value_words(value: Any, kind: Type, path: str, digits: int | None) -> Iterator[str]:
    if not isinstance(kind, MessageType):
        yield f"{path}={_text(value, kind, digits)}"
        return
    inner = [word for field in kind.fields for word in _field_words(value, field, f"{path}.", digits)]
    yield from inner or [f"{path}="]


def _text(value: Any, kind: Type, digits: int | None) -> str:
    if isinstance(kind, Float):
        return float_text(value, kind.bits, digits)
    if isinstance(kind, Enum):
        return next((name for name, number in kind.values if number == value), str(value))
    if isinstance(value, bytes):
        return value.hex()
    return str(value).lower() if isinstance(value, bool) else str(value)
