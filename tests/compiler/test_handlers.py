"""Every route of the rover's table: the compiled handler publishes what the reference evaluator says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from router.compiler import Checked
from router.compiler.checked import CheckedRoute
from router.compiler.namespace import MAPPING_FAILURES
from router.compiler.program import Program
from router.rehearsal.cdr import serialize as cdr
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import DATAGRAM, Published, context_of
from tests.compiler.generated_types import EACH_TYPE
from tests.oracles.reference import fill

GOLDEN: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "wire" / "golden_envelopes.json").read_text(encoding="utf-8")
)


def expected(checked: Checked, route: CheckedRoute, message: Any) -> dict[str, bytes]:
    """What the reference makes of each topic; topics that it refuses are left out."""
    assert checked.schema is not None
    made = {}
    for target in route.targets:
        if target.topic is None or target.type is None:
            continue
        context = context_of(message, route.case.type, tuple(checked.schema.enums.values()), nested(target.type))
        try:
            made[target.topic.topic.value] = cdr(target.type, fill(target.topic.fields, target.type, context))
        except MAPPING_FAILURES:
            continue
    return made


def nested(declared: Type) -> list[MessageType]:
    """A ROS type and all types in it, whose constants its expressions see."""
    if isinstance(declared, List):
        return nested(declared.element)
    if not isinstance(declared, MessageType):
        return []
    return [declared, *(inner for field in declared.fields for inner in nested(field.type))]


def assert_agreement(checked: Checked, route: CheckedRoute, serve: Published, message: Any) -> dict[str, bytes]:
    published = serve(message)
    assert published == expected(checked, route, message)
    assert {report.reason for report in serve.reports} <= {"mapping_error", "non_finite"}
    assert {report.target for report in serve.reports} == serve.topics - published.keys()
    assert {data for _, data in serve.sent} <= {DATAGRAM}
    return published


def test_golden_envelopes_fill_every_topic_as_the_reference_does(rover: Checked, rover_program: Program) -> None:
    for entry in GOLDEN:
        route = next(checked for checked in rover.routes if checked.case.name == entry["payload_case"])
        if route.route.is_outbound:
            assert route.case.number not in rover_program.inbound
            continue
        envelope = rover_program.envelope.message_class.FromString(bytes.fromhex(entry["hex"]))
        message = getattr(envelope, route.case.name)
        serve = Published(rover_program, rover_program.inbound[route.case.number][0])
        published = assert_agreement(rover, route, serve, message)
        assert published.keys() == serve.topics, "every golden envelope is published on every topic"


# values at the edges of their types

_EDGES = [0.0, -0.0, float("nan"), float("inf"), float("-inf"), 1e-45, 3.4028234663852886e38, -1.0, 360.0]


def values_for(declared: Type) -> st.SearchStrategy[Any]:
    match declared:
        case Bool():
            return st.booleans()
        case Int():
            edges = [declared.low, declared.high, 0, 255, 256]
            return st.sampled_from(edges) | st.integers(declared.low, declared.high)
        case Float():
            return st.sampled_from(_EDGES) | st.floats(width=declared.bits)  # type: ignore[arg-type]
        case Enum():
            named = [number for _, number in declared.values]
            return st.sampled_from([*named, -1, 255, 256, -(1 << 31), (1 << 31) - 1])
        case String():
            return st.text(max_size=declared.bound)
        case Bytes():
            return st.binary(max_size=declared.bound)
        case List():
            return st.lists(values_for(declared.element), max_size=5)
        case MessageType():
            return st.fixed_dictionaries({}, optional={field.name: _member(field) for field in declared.fields})


def _member(field: Field) -> st.SearchStrategy[Any]:
    return values_for(field.type)


def test_any_message_is_published_or_refused_as_the_reference_does(rover: Checked, rover_program: Program) -> None:
    inbound = [each for each in rover.routes if not each.route.is_outbound and not each.route.ignore]
    assert inbound
    for route in inbound:
        assert_agreement_on_any_message(rover, rover_program, route)


def assert_agreement_on_any_message(checked: Checked, program: Program, route: CheckedRoute) -> None:
    serve = Published(program, program.inbound[route.case.number][0])

    @EACH_TYPE
    @given(values_for(route.case.type))
    def agree(values: dict[str, Any]) -> None:
        assert_agreement(checked, route, serve, route.case.message_class(**values))

    agree()
