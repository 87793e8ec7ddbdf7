"""The functions of the expression language do what their documentation shows."""

from __future__ import annotations

import pytest

from router.compiler.expressions.functions import FUNCTIONS
from router.compiler.expressions.kinds import FloatKind, IntKind, StringKind, TimeKind
from router.types.model import MessageType
from tests.compiler.compiling import compiled, context_of, scope_of, written
from tests.oracles.reference_expressions import evaluate

NOTHING = MessageType("Nothing")
EXAMPLES = [(name, text, value) for name, function in FUNCTIONS.items() for text, value in function.examples]
PYTHON_TYPE: dict[type, tuple[type, ...]] = {
    IntKind: (int,),
    FloatKind: (int, float),
    StringKind: (str,),
    TimeKind: (int,),
}


@pytest.mark.parametrize(("name", "text", "value"), EXAMPLES, ids=[text for _, text, _ in EXAMPLES])
def test_example_is_true_compiled_and_by_reference(name: str, text: str, value: object) -> None:
    typed, run = compiled(text, scope_of(NOTHING))
    assert run(None) == value
    assert evaluate(written(text), context_of(None, NOTHING)) == value
    assert name in text
    assert isinstance(run(None), PYTHON_TYPE[type(typed.kind)])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_function_has_examples_a_summary_and_a_signature(name: str) -> None:
    function = FUNCTIONS[name]
    assert function.examples
    assert function.summary.endswith(".")
    assert function.signature.startswith(f"{name}(")
