"""Messages that hold everything that CDR makes hard, written by us and by rclpy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import assume, given

from router.rehearsal.cdr import deserialize
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Field, Int, List, MessageType, String, Type
from tests.compiler.comparing import assert_same_message, same
from tests.compiler.compiling import AUTO, context_of, field_map, outcome, scope_of, serializer
from tests.compiler.generated_types import EACH_TYPE, mirror, values
from tests.compiler.interface_package import MESSAGES, InterfacePackage, built, declared_type, is_buildable
from tests.compiler.machine import FAILURES
from tests.compiler.reading import field_values
from tests.oracles.reference import fill

pytest.importorskip("rclpy")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_buildable(), reason="cmake and the ROS interface generators are needed"),
]


@pytest.fixture(scope="module")
def package() -> Iterator[InterfacePackage]:
    made = InterfacePackage(built())
    yield made
    made.close()


def without_wide_text(declared: MessageType) -> MessageType:
    """A source message without what expressions do not read."""
    return MessageType(
        declared.name, tuple(replace(field, type=made) for field in declared.fields if (made := _readable(field.type)))
    )


def _readable(declared: Type) -> Type | None:
    match declared:
        case String(wide=True):
            return None
        case List():
            element = _readable(declared.element)
            return None if element is None else replace(declared, element=element)
        case MessageType():
            return without_wide_text(declared)
        case _:
            return declared


@pytest.mark.parametrize("name", MESSAGES)
def test_message_is_written_as_rclpy_does(package: InterfacePackage, name: str) -> None:
    declared = declared_type(package, name)
    source = without_wide_text(mirror(declared))

    @EACH_TYPE
    @given(values(source))
    def equal(message: Any) -> None:
        value = outcome(lambda: fill(AUTO, declared, context_of(message, source)))
        ours = outcome(lambda: serializer(AUTO, declared, scope_of(source))(message))
        if value is FAILURES or ours is FAILURES:
            assert ours is value
            return
        assert ours == cdr(declared, value)
        theirs, read = package.ask(name, value, ours)
        assert_same_message(ours, theirs, declared, value)
        assert same(read, value)

    equal()


@pytest.mark.parametrize("name", MESSAGES)
def test_message_of_rclpy_is_read(package: InterfacePackage, name: str) -> None:
    declared = declared_type(package, name)
    source = mirror(declared)

    @EACH_TYPE
    @given(values(source))
    def equal(message: Any) -> None:
        value = outcome(lambda: fill(AUTO, declared, context_of(message, source)))
        assume(value is not FAILURES)
        theirs, _ = package.ask(name, value, cdr(declared, value))
        assert same(field_values(deserialize(declared, theirs), declared), value)

    equal()


def test_unmapped_fields_have_the_defaults_of_rclpy(package: InterfacePackage) -> None:
    declared = declared_type(package, "Defaults")
    source = MessageType("Source", fields=(Field("number", Int(8, signed=False)),))
    ours = serializer(field_map(mapped="number"), declared, scope_of(source))(SimpleNamespace(number=9))
    theirs, read = package.ask("Defaults", {"mapped": 9}, ours)
    value = fill(field_map(mapped="number"), declared, context_of(SimpleNamespace(number=9), source))
    assert_same_message(ours, theirs, declared, value)
    assert read["text"] == "it is"
    assert read["inside"]["number"] == 7


def test_text_with_a_nul_is_refused_because_rclpy_would_cut_it() -> None:
    target = MessageType("made/msg/Text", fields=(Field("text", String()),))
    source = MessageType("Source", fields=(Field("text", String()),))
    message = SimpleNamespace(text="a\0b")
    assert outcome(lambda: serializer(AUTO, target, scope_of(source))(message)) is FAILURES
