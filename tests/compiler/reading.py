"""ROS messages to read, and their values in a comparable form."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from router.compiler.expressions.kinds import TIME_TYPES
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.generated_types import INTS

TIMES = tuple(
    MessageType(name, (Field("sec", Int(32, signed=True)), Field("nanosec", Int(32, signed=False))))
    for name in sorted(TIME_TYPES)
)
_NAMES = ["from", "in", "is", "class", "count", "index", "a", "a_b", "b", "b_c", "c", "item", "length", "at", "header"]
"""Names of fields: Python keywords, methods of tuples, and names that become ambiguous when joined."""


def plain(value: Any, declared: Type) -> Any:
    """A value as dictionaries and lists, from our own form or from message objects with attributes."""
    match declared:
        case MessageType() if declared.name in TIME_TYPES:
            return value if isinstance(value, int) else value.sec * 10**9 + value.nanosec
        case MessageType():
            return {field.name: plain(getattr(value, field.name), field.type) for field in declared.fields}
        case List():
            return [plain(element, declared.element) for element in value]
        case Int(octet=True) if isinstance(value, bytes):
            return value[0]  # rclpy's way
        case _:
            return value


def field_values(value: Any, declared: Type) -> Any:
    """The same as input of the reference writer, in which a time is an ordinary message."""
    match declared:
        case MessageType():
            return {field.name: field_values(getattr(value, field.name), field.type) for field in declared.fields}
        case List():
            return [field_values(element, declared.element) for element in value]
        case _:
            return value


# types

_scalars: st.SearchStrategy[Type] = st.one_of(
    st.just(Bool()),
    st.sampled_from(INTS),
    st.sampled_from([Float(32), Float(64)]),
    st.builds(String, st.none() | st.integers(1, 6), st.booleans()),
)


def _lists(elements: st.SearchStrategy[Any]) -> st.SearchStrategy[Type]:
    sizes = st.sampled_from([(None, None), (None, 3), (1, None), (3, None)])
    return st.builds(lambda element, size: List(element, *size), elements, sizes)


@st.composite
def _message(draw: st.DrawFn, members: st.SearchStrategy[Type], smallest: int) -> MessageType:
    types = draw(st.lists(members, min_size=smallest, max_size=6))
    names = draw(st.permutations(_NAMES))
    return MessageType("made/msg/Made", tuple(map(Field, names, types)))


def messages(depth: int = 2) -> st.SearchStrategy[MessageType]:
    """Nested ROS messages up to this depth."""
    members: st.SearchStrategy[Type] = _scalars | st.sampled_from(TIMES)
    members = members | _lists(members)
    for _ in range(depth):
        inner = _message(members, 0)
        members = members | inner | _lists(inner)
    return _message(members, 1)
