"""Hypothesis strategies: types with source types that fill them, payloads with sources, values of sources."""

from __future__ import annotations

import itertools
import math
from functools import cache
from types import SimpleNamespace
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type

EACH_TYPE = settings(max_examples=settings().max_examples // 4, suppress_health_check=list(HealthCheck))
"""Settings for tests that try many types."""

INTS = [Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (True, False)]
STATE = Enum("State", (("IDLE", 0), ("BUSY", 1), ("BROKEN", 300)))

Pair = tuple[Type, Type]
"""A ROS type, and a source type whose values fill it or are refused at run time."""

_numbers = itertools.count()


def _name(is_ros: bool) -> str:
    return f"made/msg/T{next(_numbers)}" if is_ros else f"Made{next(_numbers)}"


def message(is_ros: bool, *fields: Field) -> MessageType:
    return MessageType(_name(is_ros), fields)


def mirror(declared: MessageType) -> MessageType:
    """A source message with the fields of a ROS message; a time is an ordinary message."""
    return MessageType(
        declared.name.replace("/", "_"),
        tuple(Field(field.name, _mirrored(field.type)) for field in declared.fields),
    )


def _mirrored(declared: Type) -> Type:
    match declared:
        case List():
            return List(_mirrored(declared.element), declared.length, declared.bound)
        case MessageType():
            return mirror(declared)
        case _:
            return declared


def _wider(target: Int) -> list[Type]:
    return [source for source in INTS if target.low <= source.low and source.high <= target.high]


def _exact(target: Float) -> list[Type]:
    small: list[Type] = [source for source in INTS if source.bits < target.bits]
    return [*small, Float(32)] if target.bits == 32 else [*small, Float(32), Float(64)]


@st.composite
def scalar_pairs(draw: st.DrawFn) -> Pair:
    target: Type = draw(
        st.one_of(
            st.just(Bool()),
            st.sampled_from(INTS),
            st.sampled_from([Float(32), Float(64)]),
            st.builds(String, st.none() | st.integers(1, 6)),
        )
    )
    match target:
        case Int():
            return target, draw(st.sampled_from([*_wider(target), STATE]))
        case Float():
            return target, draw(st.sampled_from(_exact(target)))
        case String():
            return target, String()
        case _:
            return target, target


@st.composite
def list_pairs(draw: st.DrawFn, elements: st.SearchStrategy[Pair]) -> Pair:
    target, source = draw(elements)
    length, bound = draw(st.sampled_from([(None, None), (None, 2), (None, 5), (1, None), (3, None)]))
    if target == Int(8, signed=False) and draw(st.booleans()):
        return List(target, length, bound), Bytes()
    # A length known from the source's type is checked at compile time, otherwise at run time.
    return List(target, length, bound), List(source, draw(st.sampled_from([None, length])))


def _wrapped(pair: Pair) -> st.SearchStrategy[Pair]:
    """The type, or a message with one field of this type: both are equivalent."""
    target, source = pair
    return st.sampled_from(
        [
            (message(True, Field("only", target)), source),
            (target, message(False, Field("other", source))),
        ]
    )


_WIDE: st.SearchStrategy[Pair] = st.builds(lambda bound: (String(bound, wide=True), String()), st.none() | st.just(6))
"""Types of fields that nothing fills. Expressions do not fill wide strings."""


@st.composite
def message_pairs(draw: st.DrawFn, members: st.SearchStrategy[Pair], *, top: bool = False) -> Pair:
    """Two messages: fields of the same name in any order, unfilled fields of the target, or no fields."""
    shared = draw(st.lists(members, min_size=1, max_size=6))
    if not top and draw(st.integers(0, 9)) == 0:
        return message(True), message(False, Field("unused", Bool()))
    targets = [Field(f"field_{index}", target) for index, (target, _) in enumerate(shared)]
    sources = [Field(f"field_{index}", source) for index, (_, source) in enumerate(shared)]
    unset = [Field(f"unset_{index}", type_, default=draw(defaults(type_))) for index, (type_, _) in
             enumerate(draw(st.lists(members | _WIDE, max_size=2)))]  # fmt: skip
    return (
        message(True, *draw(st.permutations([*targets, *unset]))),
        message(False, *draw(st.permutations(sources))),
    )


def defaults(declared: Type) -> st.SearchStrategy[Any]:
    """A default value that a `.msg` file can give to a field; None for no default."""
    if isinstance(declared, MessageType) or (isinstance(declared, List) and isinstance(declared.element, MessageType)):
        return st.none()
    if isinstance(declared, String) and not declared.wide:
        return st.none() | st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=declared.bound or 8)
    return st.none() | values(declared)


def pairs(depth: int = 2) -> st.SearchStrategy[Pair]:
    """Nested messages up to this depth."""
    members: st.SearchStrategy[Pair] = scalar_pairs() | list_pairs(scalar_pairs()) | scalar_pairs().flatmap(_wrapped)
    for _ in range(depth):
        inner = message_pairs(members)
        members = members | inner | list_pairs(inner)
    return message_pairs(members, top=True)


@st.composite
def payload_sources(draw: st.DrawFn, payload: MessageType, depth: int = 2) -> MessageType:
    """A message with some fields of a payload: all required ones, and one of each oneof."""
    fields = [field for field in payload.fields if depth or not isinstance(_innermost(field.type), MessageType)]
    chosen = draw(st.lists(st.sampled_from(fields), min_size=1, unique=True)) if fields else []
    one_each = {field.oneof or field.name: field for field in chosen}
    required = {field.name: field for field in fields if field.is_required}
    return message(
        True,
        *(Field(field.name, draw(_payload_source(field.type, depth))) for field in (one_each | required).values()),
    )


def _innermost(declared: Type) -> Type:
    return declared.element if isinstance(declared, List) else declared


def _payload_source(target: Type, depth: int) -> st.SearchStrategy[Type]:
    """Types whose values fill a field of a payload or are refused at run time."""
    match target:
        case Int():
            return st.sampled_from([*_wider(target), STATE])
        case Float():
            return st.sampled_from(_exact(target))
        case String():
            return st.just(String())
        case Enum():
            return st.sampled_from([target, *_wider(Int(32, signed=True))])
        case Bytes():
            return st.sampled_from([target, List(Int(8, signed=False), 2), List(Int(8, signed=False))])
        case List():
            lengths = st.sampled_from([None, 2])
            return st.builds(List, _payload_source(target.element, depth), lengths)
        case MessageType():
            return payload_sources(target, depth - 1)
        case _:
            return st.just(target)


@cache  # Hypothesis checks each new strategy, which takes longer than drawing from it
def values(declared: Type) -> st.SearchStrategy[Any]:
    """Python values of a type; messages are namespaces."""
    match declared:
        case Bool():
            return st.booleans()
        case Int():
            return st.integers(declared.low, declared.high) | st.sampled_from([declared.low, declared.high])
        case Float():
            # One NaN only: JSON, which carries values to another process, does not distinguish NaNs.
            return st.floats(width=declared.bits, allow_nan=False) | st.just(math.nan)  # type: ignore[arg-type]
        case String():
            return st.text(st.characters(exclude_categories=["Cs"]), max_size=declared.bound or 8)
        case Bytes():
            return st.binary(max_size=5)
        case Enum():
            return st.sampled_from([*(number for _, number in declared.values), -5, (1 << 31) - 1])
        case List():
            sizes = {declared.length} if declared.length is not None else {0, 1, min(3, declared.bound or 3)}
            return st.sampled_from(sorted(sizes)).flatmap(
                lambda size: st.lists(values(declared.element), min_size=size, max_size=size)
            )
        case MessageType():
            return st.builds(SimpleNamespace, **{field.name: values(field.type) for field in declared.fields})
