"""Paths to nested fields: resolves a name that is written without the names before it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from router.errors import nearest
from router.types.model import List, MessageType, Type

DEEPEST = 2
"""Maximum number of messages that a path omits before its first name."""
_ALIKE = 0.8
"""Similarity required to suggest a nested field for a misspelt name."""


def type_at(message: MessageType, names: Sequence[str]) -> Type | None:
    """Return the type of the field that `names` is a path to; None if there is no such field."""
    found: Type = message
    for name in names:
        member = found.field(name) if isinstance(found, MessageType) else None
        if member is None:
            return None
        found = member.type
    return found


def leads(message: MessageType, names: Sequence[str]) -> bool:
    """Return whether `names` is a path from the message to a field."""
    return type_at(message, names) is not None


def ways(message: MessageType, names: Sequence[str], *, with_lists: bool = False) -> list[str]:
    """Return the paths that end in `names`, shortest first.

    If there are none for a single name, return the paths that end in a similar name. `with_lists`: paths may go through
    the first element of a list, as in `samples[0].value`.
    """
    below = list(_below(message, with_lists=with_lists))
    wanted = ".".join(names)
    if exact := [prefix + wanted for prefix, holder in below if leads(holder, names)]:
        return exact
    if len(names) > 1:
        return []
    near = nearest(wanted, [member.name for _, holder in below for member in holder.fields], _ALIKE)
    return [f"{prefix}{near}" for prefix, holder in below if near and holder.field(near)]


def _below(message: MessageType, *, with_lists: bool) -> Iterator[tuple[str, MessageType]]:
    """Yield the messages in a message, each with the path to its fields; those in lists come last."""
    level: list[tuple[str, MessageType]] = [("", message)]
    behind: list[tuple[str, MessageType]] = []
    for _ in range(DEEPEST):
        inner: list[tuple[str, MessageType]] = []
        for prefix, holder in level:
            for member in holder.fields:
                if isinstance(member.type, MessageType) and not member.is_group:
                    inner.append((f"{prefix}{member.name}.", member.type))
                elif with_lists and isinstance(member.type, List):
                    element = member.type.element
                    if isinstance(element, MessageType) and not element.is_map_entry:
                        behind.append((f"{prefix}{member.name}[0].", element))
        yield from inner
        level = inner
    yield from behind
