"""CDR bytes of any type: the compiled path, the reference writer and rosbags agree."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import get_types_from_msg

from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import AUTO, context_of, outcome, reference_bytes, scope_of, serializer
from tests.compiler.generated_types import STATE, pairs, values
from tests.compiler.machine import FAILURES
from tests.oracles.reference import Value, fill

MANY = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


@MANY
@given(st.data())
def test_compiled_bytes_equal_the_reference(data: st.DataObject) -> None:
    target, source = data.draw(pairs())
    assert isinstance(target, MessageType)
    assert isinstance(source, MessageType)
    message = data.draw(values(source))
    scope, context = scope_of(source, [STATE]), context_of(message, source, [STATE])
    compiled = outcome(lambda: serializer(AUTO, target, scope)(message))
    event("refused" if compiled is FAILURES else "published")
    assert compiled == outcome(lambda: reference_bytes(AUTO, target, context))


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_reference_bytes_equal_those_of_rosbags(data: st.DataObject) -> None:
    target, source = data.draw(pairs(depth=1))
    assert isinstance(target, MessageType)
    assert isinstance(source, MessageType)
    if has_wide_text(target):
        return  # rosbags has none
    message = data.draw(values(source))
    value = outcome(lambda: fill(AUTO, target, context_of(message, source, [STATE])))
    if value is not FAILURES:
        assert cdr(target, value) == rosbags_bytes(target, value)


def has_wide_text(declared: Type) -> bool:
    match declared:
        case MessageType():
            return any(has_wide_text(field.type) for field in declared.fields)
        case List():
            return has_wide_text(declared.element)
        case _:
            return isinstance(declared, String) and declared.wide


def rosbags_bytes(declared: MessageType, value: dict[str, Value]) -> bytes:
    store = get_typestore(Stores.EMPTY)
    found: dict[str, Any] = {}
    _definitions(declared, found)
    store.register(found)
    return bytes(store.serialize_cdr(_rosbags_value(store.types, declared, value), declared.name))


_PLACEHOLDER = "structure_needs_at_least_one_member"


def _definitions(declared: Type, found: dict[str, Any]) -> None:
    if isinstance(declared, List):
        _definitions(declared.element, found)
    elif isinstance(declared, MessageType):
        for field in declared.fields:
            _definitions(field.type, found)
        lines = [f"{_spelled(field.type)} {field.name}" for field in declared.fields] or [f"uint8 {_PLACEHOLDER}"]
        found.update(get_types_from_msg("\n".join(lines), declared.name))


def _spelled(declared: Type) -> str:
    if isinstance(declared, List):
        size = declared.length if declared.length is not None else f"<={declared.bound}" if declared.bound else ""
        return f"{_spelled(declared.element)}[{size}]"
    return declared.name.replace("/msg/", "/") if isinstance(declared, MessageType) else str(declared)


def _rosbags_value(classes: Any, declared: Type, value: Any) -> Any:
    match declared:
        case MessageType():
            fields = {field.name: _rosbags_value(classes, field.type, value[field.name]) for field in declared.fields}
            return classes[declared.name](**(fields or {_PLACEHOLDER: 0}))
        case List(element=Bool() | Int() | Float()):
            return np.array(value, dtype=str(declared.element))
        case List():
            return [_rosbags_value(classes, declared.element, element) for element in value]
        case _:
            return value
