"""Messages that are made of what a test gives: protobuf ones, and the values of ROS ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from router.compiler.expressions.functions import NS_PER_SECOND
from router.rehearsal.matching import Exactly, ListMatch, Match, MessageMatch, Moment, Moments
from router.rehearsal.shown import default_of
from router.types.model import List, MessageType, Type


def fill(message: Any, kind: MessageType, given: MessageMatch, moments: Moments) -> None:
    """Sets the fields of a protobuf message."""
    for name, match in given.members.items():
        field = kind.field(name)
        assert field is not None  # noqa: S101 - it was read with this type
        member = getattr(message, name)
        match match:
            case MessageMatch():
                member.SetInParent()
                assert isinstance(field.type, MessageType)  # noqa: S101
                fill(member, field.type, match, moments)
            case Moment():
                member.seconds, member.nanos = divmod(match.time(moments), NS_PER_SECOND)
            case ListMatch():
                assert isinstance(field.type, List)  # noqa: S101
                _extend(member, field.type.element, match, moments)
            case Exactly():
                setattr(message, name, match.value)


def _extend(values: Any, element: Type, given: ListMatch, moments: Moments) -> None:
    for item in given.items:
        if isinstance(item, MessageMatch) and isinstance(element, MessageType) and element.is_map_entry:
            _put(values, item, element, moments)
        elif isinstance(item, MessageMatch) and isinstance(element, MessageType):
            fill(values.add(), element, item, moments)
        elif isinstance(item, Exactly):
            values.append(item.value)


def _put(holder: Any, given: MessageMatch, entry: MessageType, moments: Moments) -> None:
    """One entry of a map."""
    key, value = given.members.get("key"), given.members.get("value")
    place = key.value if isinstance(key, Exactly) else default_of(entry.fields[0].type)
    kind = entry.fields[1].type
    if isinstance(kind, MessageType):
        holder[place].SetInParent()
        if isinstance(value, MessageMatch):
            fill(holder[place], kind, value, moments)
    else:
        holder[place] = value.value if isinstance(value, Exactly) else default_of(kind)


def values(kind: MessageType, given: MessageMatch, moments: Moments) -> Mapping[str, Any]:
    """A ROS message as its values by name, those that were not given at their default."""
    made = default_of(kind)
    for name, match in given.members.items():
        field = kind.field(name)
        assert field is not None  # noqa: S101 - it was read with this type
        made[name] = _plain(field.type, match, moments)
    found: Mapping[str, Any] = made
    return found


def _plain(kind: Type, match: Match, moments: Moments) -> Any:
    match match:
        case MessageMatch() if isinstance(kind, MessageType):
            return values(kind, match, moments)
        case Moment():
            seconds, nanoseconds = divmod(match.time(moments), NS_PER_SECOND)
            return {"sec": seconds, "nanosec": nanoseconds}
        case ListMatch() if isinstance(kind, List):
            return [_plain(kind.element, item, moments) for item in match.items]
        case Exactly():
            return match.value
    raise AssertionError(f"{match} cannot be given")
