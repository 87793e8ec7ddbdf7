"""The oracle of JSON: the parsed JSON of a message's value. No gateway uses it.

Takes values as `router.rehearsal.cdr` does: dictionaries, lists and scalars.
"""

from __future__ import annotations

import math
import struct
from typing import Any

from router.types.model import Bool, Float, Int, List, MessageType, String, Type


def reference_value(message: MessageType, value: dict[str, Any], *, is_wrapped: bool) -> dict[str, Any]:
    """The value as JSON in the existing gateway's style or bare, keys sorted. Raises ValueError for invalid Unicode."""
    members = {field.name: _member(field.type, value[field.name], is_wrapped) for field in message.fields}
    if not members:
        members["structure_needs_at_least_one_member"] = [0] if is_wrapped else 0
    return {name: members[name] for name in sorted(members)}


def _member(declared: Type, value: Any, is_wrapped: bool) -> Any:
    if isinstance(declared, List):
        return [_bare(declared.element, element, is_wrapped) for element in value]
    bare = _bare(declared, value, is_wrapped)
    return [bare] if is_wrapped else bare


def _bare(declared: Type, value: Any, is_wrapped: bool) -> Any:
    match declared:
        case MessageType():
            return reference_value(declared, value, is_wrapped=is_wrapped)
        case String(wide=True) if is_wrapped:
            return [unit for (unit,) in struct.iter_unpack("<H", value.encode("utf-16-le", "surrogatepass"))]
        case String():
            value.encode()  # which refuses surrogates
            return value
        case Bool():
            return bool(value)
        case Int():
            return int(value)
        case Float():
            return float(value) if math.isfinite(value) else None
        case _:
            raise TypeError(f"ROS has no type {declared}")
