"""The oracle of mappings: a plain, slow implementation for one message.

It shares functions and the type model with the compiler, but must not import expressions, scalars, conversion,
mapping, cdr, payload or source: then two implementations have to agree. Expects a table that the compiler has
accepted. `router.rehearsal.cdr` and `reference_protobuf` serialize the results.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import partial, reduce
from typing import Any, Union

from router.table.model.expressions import Elements, Expression, FieldMap
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.oracles.reference_expressions import Context, elements_of, meaning_of, value_of
from tests.oracles.reference_kinds import (
    MAPPING_ERROR,
    NS,
    TIMES,
    Computation,
    EnumNumber,
    Nanoseconds,
    Refused,
    View,
    all_of,
    known,
)

Value = Union[bool, int, float, str, bytes, "list[Value]", "dict[str, Value]"]
"""The value of a field; a message is a dictionary of its fields, in their order."""


def fill(fields: FieldMap | None, target: MessageType, context: Context) -> dict[str, Value]:
    """The ROS message that `fields` makes from a message, with all fields.

    Raises Refused if a field has no value.
    """
    try:
        given = fill_given(fields, target, context)
    except Refused as refused:
        # The reason may also be a text with a NUL, which is only detected later.
        raise Refused(*refused.reasons, *[MAPPING_ERROR] * _has_text(target)) from None
    return _completed(target, given)


def _has_text(declared: Type) -> bool:
    match declared:
        case MessageType():
            return any(_has_text(field.type) for field in declared.fields)
        case List():
            return _has_text(declared.element)
        case _:
            return isinstance(declared, String)


def _completed(message: MessageType, values: Mapping[str, Value]) -> dict[str, Value]:
    """The message with its unfilled fields added, because ROS messages have all fields."""
    return {
        field.name: _complete(field.type, values[field.name])
        if field.name in values
        else initial(field.type, field.default)
        for field in message.fields
    }


def _complete(declared: Type, value: Any) -> Any:
    match declared:
        case MessageType():
            return _completed(declared, value)
        case List():
            return [_complete(declared.element, element) for element in value]
        case String(wide=False) if "\0" in value:
            raise Refused(MAPPING_ERROR)
        case _:
            return value


def fill_given(fields: FieldMap | None, target: MessageType, context: Context) -> dict[str, Value]:
    """The same without unfilled fields."""
    tree: dict[str, Any] = {}
    for entry in fields.entries if fields else ():
        holder = reduce(lambda inner, name: inner.setdefault(name, {}), entry.path[:-1], tree)
        holder[entry.path[-1]] = entry.value
    return _filled(target, tree, context.view if fields and fields.auto else None, context)


def _filled(target: MessageType, tree: Mapping[str, Any], auto: View | None, context: Context) -> dict[str, Value]:
    def fill_field(field: Field) -> Value:
        given = tree.get(field.name)
        same_named = auto.read(field.name) if auto and auto.type.field(field.name) else None
        if isinstance(given, (Expression, Elements)):
            return _of_expression(given, field.type, context)
        if given is None:
            return converted(same_named, field.type)
        assert isinstance(field.type, MessageType)
        return _filled(field.type, given, same_named if isinstance(same_named, View) else None, context)

    fields = [each for each in target.fields if each.name in tree or (auto and auto.type.field(each.name))]
    values = all_of([partial(fill_field, field) for field in fields])
    return {field.name: value for field, value in zip(fields, values, strict=True)}


def _of_expression(given: Expression | Elements, target: Type, context: Context) -> Value:
    if isinstance(given, Elements):
        assert isinstance(target, List)
        elements = elements_of(meaning_of(given.source, context), context)
        return _listed([partial(_of_element, given.fields, target.element, each, context) for each in elements], target)
    if given.fields is not None:
        assert isinstance(target, MessageType)
        return fill_given(given.fields, target, context)
    if given.items and isinstance(target, List) and any(item.fields is not None for item in given.items):
        return all_of([partial(_of_expression, item, target.element, context) for item in given.items])
    meaning = meaning_of(given, context, target)
    if isinstance(target, (List, Bytes)):
        return _to_list(elements_of(meaning, context), target)
    return converted(value_of(meaning, context), target)


def _of_element(fields: FieldMap, target: Type, element: Computation, context: Context) -> Value:
    assert isinstance(target, MessageType)
    return fill_given(fields, target, context.of_element(element()))


def initial(declared: Type, default: object = None) -> Value:
    """The value of an unfilled field of a ROS message: its declared default, else zero."""
    match declared:
        case MessageType():
            return {field.name: initial(field.type, field.default) for field in declared.fields}
        case List() if isinstance(default, Sequence):
            return [initial(declared.element, value) for value in default]
        case List():
            return [initial(declared.element) for _ in range(declared.length or 0)]
        case _ if default is not None:
            return default  # type: ignore[return-value]
        case Bool():
            return False
        case Float():
            return 0.0
        case String():
            return ""
        case _:
            return 0


def converted(value: Any, target: Type) -> Value:  # noqa: C901 - a case a type
    """The value converted to the target's type. Raises Refused if it does not fit."""
    match target:
        case MessageType():
            return _to_message(value, target)
        case List():
            return _to_list(known(value), target)
        case _ if isinstance(value, View):
            return converted(value.read(value.type.fields[0].name), target)
        case Bool():
            return bool(value)
        case Int():
            if isinstance(value, EnumNumber):
                return max(target.low, min(target.high, int(value)))
            if not target.low <= value <= target.high:
                raise Refused(MAPPING_ERROR)
            return int(value)
        case Float():
            return _to_float(value, target)
        case String():
            return _to_text(value, target)
        case Enum():
            return _to_enum(value, target)
        case Bytes():
            return _to_list(known(value), target)


_OCTET = Int(8, signed=False)


def _to_list(elements: Sequence[Computation], target: List | Bytes) -> Value:
    """A list or bytes, from elements that are not computed yet."""
    declared = target.element if isinstance(target, List) else _OCTET
    return _listed([partial(_converted_to, declared, each) for each in elements], target)


def _listed(elements: Sequence[Computation], target: List | Bytes) -> Value:
    """The same from elements that have the type of the target's."""
    least, most = (target.length or 0, _most_elements(target)) if isinstance(target, List) else (0, target.bound)

    def check_length() -> None:
        if len(elements) < least or (most is not None and len(elements) > most):
            raise Refused(MAPPING_ERROR)

    _, *made = all_of([check_length, *elements])
    return made if isinstance(target, List) else bytes(made)


def _converted_to(declared: Type, element: Computation) -> Value:
    return converted(element(), declared)


def _most_elements(target: List) -> int:
    most = target.length if target.length is not None else target.bound
    return most if most is not None else 0xFFFF_FFFF


def _to_message(value: Any, target: MessageType) -> dict[str, Value]:
    if isinstance(value, View) and (value.type.name, target.name) in _SAME_TIMES:
        return _to_message(_nanoseconds(value), target)
    if isinstance(value, Nanoseconds) and target.name in (*TIMES, *dict(_SAME_TIMES)):
        sec, nanosec = target.fields
        seconds = value // NS
        if target.name == "google.protobuf.Duration" and seconds < 0:
            seconds = -(-value // NS)  # nanoseconds have the sign of the seconds
        return {sec.name: converted(seconds, sec.type), nanosec.name: converted(value - seconds * NS, nanosec.type)}
    if not isinstance(value, View):
        (only,) = target.fields
        return {only.name: converted(value, only.type)}
    return {
        field.name: converted(value.read(field.name), field.type)
        for field in target.fields
        if value.type.field(field.name)
    }


_SAME_TIMES = (
    ("google.protobuf.Timestamp", "builtin_interfaces/msg/Time"),
    ("google.protobuf.Duration", "builtin_interfaces/msg/Duration"),
)


def _nanoseconds(moment: View) -> Nanoseconds:
    """A Timestamp or Duration of protobuf. Raises Refused if ROS cannot hold its seconds, or it has too many nanos."""
    seconds, nanos = moment.read("seconds"), moment.read("nanos")
    least = 0 if moment.type.name == "google.protobuf.Timestamp" else 1 - NS
    if not -(1 << 31) <= seconds < 1 << 31 or not least <= nanos < NS:
        raise Refused(MAPPING_ERROR)
    return Nanoseconds(seconds * NS + nanos)


def _to_float(value: float, target: Float) -> float:
    try:
        struct.pack("<f" if target.bits == 32 else "<d", value)
    except (OverflowError, struct.error) as error:
        raise Refused(MAPPING_ERROR) from error
    return float(value)


def _to_text(value: str, target: String) -> str:
    size = len(value.encode("utf-16-le")) // 2 if target.wide else len(value.encode())
    if target.bound is not None and size > target.bound:
        raise Refused(MAPPING_ERROR)
    return value


def _to_enum(value: int | str, target: Enum) -> int:
    """The number of an enum value given as number or name."""
    numbers = dict(target.values)
    if isinstance(value, str) and value not in numbers:
        raise Refused(MAPPING_ERROR)
    number = numbers[value] if isinstance(value, str) else int(value)
    if target.is_closed and number not in numbers.values():
        raise Refused(MAPPING_ERROR)
    if not -(1 << 31) <= number < 1 << 31:
        raise Refused(MAPPING_ERROR)
    return number
