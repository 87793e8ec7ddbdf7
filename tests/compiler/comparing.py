"""Equality of two serializations of one message."""

from __future__ import annotations

import math
from typing import Any

from router.rehearsal.cdr import serialize as cdr
from router.types.model import MessageType
from tests.oracles.reference import Value


def assert_same_message(ours: bytes, theirs: bytes, declared: MessageType, value: dict[str, Value]) -> None:
    """Assert that all significant bytes are equal.

    Fast CDR does not write padding bytes, and rclpy returns a buffer that may be longer than the message: up to four
    bytes for a message without fields, more with wide strings.
    """
    meaningful = [a == b for a, b in zip(cdr(declared, value, 0x00), cdr(declared, value, 0xFF), strict=True)]
    assert len(ours) == len(meaningful)
    assert bytes(byte for byte, counts in zip(ours, meaningful, strict=True) if not counts).strip(b"\0") == b""
    shown = [byte if counts else 0 for byte, counts in zip(theirs, meaningful, strict=False)]
    assert ours == bytes(shown)


def same(left: Any, right: Any) -> bool:
    """Whether two values are equal, with NaN equal to NaN."""
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right) or (isinstance(left, float) and math.isnan(left) and math.isnan(right))


def without_nul(value: Any) -> Any:
    """The text up to the first NUL, where rclpy truncates strings."""
    match value:
        case dict():
            return {name: without_nul(member) for name, member in value.items()}
        case list():
            return [without_nul(element) for element in value]
        case str():
            return value.replace("\0", "")
        case _:
            return value
