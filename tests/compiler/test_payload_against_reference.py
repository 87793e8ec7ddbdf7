"""Envelopes of generated code equal those of the reference and of protobuf: random mappings, every rover payload."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from router.compiler.cdr import CdrReads
from router.compiler.lookup import Definitions
from router.compiler.mapping import build
from router.compiler.payload import constant_envelope
from router.engine.delivery import MAPPING_FAILURES
from router.errors import MappingError
from router.table.model import FieldMap
from router.types.model import MessageType
from tests.compiler.compiling import AUTO, SPAN, context_of, field_map, outcome, scope_of
from tests.compiler.generated_types import mirror, payload_sources, values
from tests.compiler.payloads import Wire, compiled_envelope, made_wire, reference_envelope, rover_wire
from tests.oracles.reference import fill
from tests.oracles.reference_cdr import cdr

GOLDEN: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "wire" / "golden_envelopes.json").read_text(encoding="utf-8")
)
_ROS_NAMES = {"imu_info": "ImuSensorInformation"}
"""Of the one ROS type that has another name than its payload."""
MANY = settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])


def canonical(wire: Wire, datagram: Any) -> Any:
    """Entries of maps in one order; what is no datagram as it is."""
    if not isinstance(datagram, bytes):
        return datagram
    return wire[1].message_class.FromString(datagram).SerializeToString(deterministic=True)


@MANY
@given(st.data())
def test_random_mappings_make_the_envelopes_of_the_reference(data: st.DataObject) -> None:
    wire = made_wire()
    case = data.draw(st.sampled_from(list(wire[1].cases.values())))
    source = data.draw(payload_sources(case.type))
    message = data.draw(values(source))
    made = outcome(lambda: compiled_envelope(wire, case, AUTO, source)(message))
    event("refused" if made is MAPPING_FAILURES else "sent")
    expected = outcome(lambda: reference_envelope(wire, case, AUTO, source)(message))
    assert canonical(wire, made) == canonical(wire, expected)
    assert made is MAPPING_FAILURES or len(made) == len(expected)


@pytest.mark.parametrize("entry", GOLDEN, ids=lambda entry: f"{entry['payload_case']}-{entry['mode']}")
def test_golden_payloads_mapped_to_themselves_keep_their_bytes(entry: dict[str, Any]) -> None:
    wire = rover_wire()
    case = wire[1].cases[entry["payload_case"]]
    datagram = wire[1].message_class.FromString(bytes.fromhex(entry["hex"]))
    payload = getattr(datagram, case.name)
    for field in case.type.fields:
        if isinstance(field.type, MessageType):
            getattr(payload, field.name).SetInParent()  # what is mapped is there
    expected = datagram.SerializeToString()
    assert compiled_envelope(wire, case, AUTO, case.type)(payload) == expected
    assert reference_envelope(wire, case, AUTO, case.type)(payload) == expected


@pytest.mark.parametrize("name", rover_wire()[1].cases)
def test_ros_messages_of_the_rover_make_the_envelopes_of_the_reference(definitions: Definitions, name: str) -> None:
    wire = rover_wire()
    case = wire[1].cases[name]
    declared = definitions.interfaces.get(f"comms/msg/{_ROS_NAMES.get(name, case.type.name)}")
    assert declared is not None
    compiled = compiled_envelope(wire, case, AUTO, declared, CdrReads(declared))
    reference = reference_envelope(wire, case, AUTO, declared)

    @settings(max_examples=30, suppress_health_check=list(HealthCheck))
    @given(values(mirror(declared)))
    def equal(message: Any) -> None:
        value = fill(AUTO, declared, context_of(message, mirror(declared)))
        assert compiled(cdr(declared, value)) == reference(message)

    equal()


def constant(case: str, fields: FieldMap) -> bytes:
    schema, envelope = made_wire()
    declared = envelope.cases[case]
    scope = scope_of(MessageType("nothing"), tuple(schema.enums.values()))
    mapping = build(fields, declared.type, scope, SPAN)
    assert mapping.findings == []
    return constant_envelope(mapping.plan, declared)


def test_an_envelope_of_constants_is_that_of_the_reference() -> None:
    wire = made_wire()
    for case, fields in {
        "scalars": field_map(single="radians(90) * 0", rock="ROCK_BLUE", text="'stop'", i32="-1", data="[1, 2]"),
        "optional": field_map(flag="true", point__x="0.5"),
        "many": field_map(numbers="[1, 2, 3]", rocks="['ROCK_GREEN']"),
    }.items():
        expected = reference_envelope(wire, wire[1].cases[case], fields, MessageType("nothing"))(None)
        assert constant(case, fields) == expected


def test_the_rover_brakes() -> None:
    _, envelope = rover_wire()
    case = envelope.cases["manual_brake"]
    plan = build(field_map(brake="true"), case.type, scope_of(MessageType("nothing")), SPAN).plan
    assert constant_envelope(plan, case) == envelope.message_class(manual_brake={"brake": True}).SerializeToString()


@pytest.mark.parametrize(
    ("case", "fields"),
    [
        ("scalars", field_map(i32="round(sqrt(-1))")),
        ("scalars", field_map(real="1 / int(false)")),
        ("scalars", field_map(single="float32(1e39)")),
        ("scalars", field_map(i32="([1] if true else [1, 2])[5]")),
        ("closed", field_map(gear="7", number="1")),
    ],
)
def test_an_envelope_of_constants_that_no_payload_holds_is_refused(case: str, fields: FieldMap) -> None:
    with pytest.raises((MappingError, ValueError)):
        constant(case, fields)
