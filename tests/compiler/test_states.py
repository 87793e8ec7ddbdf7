"""States in conditions: their names, fields of the same name, and the part of a condition that only reads them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import BoolKind, EnumKind, IntKind, Kind, StringKind
from router.compiler.expressions.states import gate_of, reads_message, states_in
from router.compiler.expressions.tree import Compare, Node, Read, Variable, constant_of, parts_of
from router.errors import Code
from router.types.model import Bool, Enum, Field, Int, MessageType
from tests.compiler.compiling import scope_of, written

MODE = Enum("test.Mode", (("MANUAL", 0), ("AUTO", 1)))
STATES: dict[str, Kind | None] = {
    "mode": EnumKind(MODE),
    "on": BoolKind(),
    "turns": IntKind(-5, 5),
    "driver": StringKind(),
}
PLAIN = MessageType("test.Plain", (Field("speed", Int(32, True)), Field("AUTO", Int(32, True))))
SCALAR = MessageType("test.Scalar", (Field("state", Int(32, True)),))
NESTED = MessageType(
    "test.Nested", (Field("state", MessageType("test.Inner", (Field("mode", MODE), Field("ok", Bool())))),)
)


def scope(message: MessageType) -> Scope:
    return replace(scope_of(message, [MODE]), states=STATES, reads_states=True)


def read(text: str, message: MessageType = PLAIN) -> Node:
    return check(written(text), scope(message))


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("state.mode == MANUAL", 0),
        ("MANUAL != state.mode", 0),
        ("state.mode == Mode.AUTO", 1),
        ("state.mode in [MANUAL]", 0),
    ],
)
def test_names_beside_a_state_are_values_of_its_enum(text: str, number: int) -> None:
    node = read(text)
    assert states_in([node]) == ["mode"]
    constants = [constant_of(item) for item in _leaves(node)]
    assert number in constants


@pytest.mark.parametrize("text", ["state.driver == left", "state.driver in ['left', right]", "left != state.driver"])
def test_names_beside_a_text_are_told_to_be_quoted(text: str) -> None:
    with pytest.raises(ExpressionError) as raised:
        read(text)
    assert raised.value.diagnostic.hint in {"for text, write 'left' in quotes", "for text, write 'right' in quotes"}


def test_a_field_of_that_name_takes_precedence_over_the_value() -> None:
    node = read("state.mode == AUTO")
    assert isinstance(node, Compare)
    assert isinstance(node.operands[1], Read)


@pytest.mark.parametrize("text", ["state == 3", "state.turns == state", "message.state == 3"])
def test_a_scalar_field_named_state_can_be_read_beside_states(text: str) -> None:
    assert reads_message(read(text, SCALAR))


def test_a_message_named_state_keeps_its_fields() -> None:
    assert states_in([read("state.ok", NESTED)]) == []
    assert states_in([read("state.on and state.ok", NESTED)]) == ["on"]


def test_a_name_of_a_field_and_of_a_state_is_ambiguous() -> None:
    with pytest.raises(ExpressionError, match=r"'state\.mode' is a field of test.Nested and a state") as raised:
        read("state.mode == AUTO", NESTED)
    assert raised.value.diagnostic.code is Code.FORBIDDEN_EXPRESSION
    assert states_in([read("message.state.mode == Mode.AUTO", NESTED)]) == []


@pytest.mark.parametrize(
    ("text", "gate"),
    [
        ("state.on", ["on"]),
        ("state.on and speed > 3 and state.turns > 0", ["on", "turns"]),
        ("(state.on or state.turns > 0) and source == 'a'", ["on", "turns"]),
        ("state.on or speed > 3", []),
        ("'x' + state.driver == 'xleft' and state.driver != source", ["driver"]),
        ("speed > 3", []),
        ("source == 'a' if state.on else False", []),
    ],
)
def test_a_gate_reads_states_only(text: str, gate: list[str]) -> None:
    parts = gate_of([read(text), None])
    assert states_in(parts) == gate
    assert not any(map(reads_message, parts))


def _leaves(node: Node) -> list[Node]:
    inner = [leaf for part in parts_of(node) for leaf in _leaves(part)]
    return inner or ([] if isinstance(node, Variable) else [node])
