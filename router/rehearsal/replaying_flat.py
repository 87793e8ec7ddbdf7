"""A delivered message as fields by path, to be laid beside another one. Knows types, no tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from router.rehearsal.shown import shown
from router.types.model import List, MessageType, Type


def fields(kind: MessageType, message: Any) -> dict[str, str]:
    """`header.stamp.sec`, `points[1].x`: each with its value as text."""
    return dict(_leaves(kind, message, ""))


def _leaves(kind: Type, value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(kind, MessageType):
        for field in kind.fields:
            yield from _leaves(field.type, getattr(value, field.name), f"{path}.{field.name}" if path else field.name)
    elif isinstance(kind, List):
        for index, element in enumerate(value):
            yield from _leaves(kind.element, element, f"{path}[{index}]")
    else:
        yield path, shown(kind, value)
