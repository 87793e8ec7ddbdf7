"""What JSON has in common whichever way it goes: the two styles, and what is unreadable. Imports nothing."""

from __future__ import annotations

import enum

PLACEHOLDER = "structure_needs_at_least_one_member"
"""The one field, a uint8, that rosidl gives a message without fields."""


class Style(enum.Enum):
    """How values stand in the text. Keys are sorted and there are no spaces in either."""

    WRAPPED = enum.auto()
    """The existing gateway's: whatever is no array is an array of one element, a wstring is a list of UTF-16 units."""
    PLAIN = enum.auto()
    """Scalars and messages bare, a wstring is a string."""


class UnreadableError(ValueError):
    """Bytes that are no such message, or hold text that is no text."""
