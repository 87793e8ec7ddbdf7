"""Payloads with fields of every kind (`protos/made`), and mappings to envelopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from router.compiler.checked import CheckedRoute, CheckedSubscription, Target
from router.compiler.expressions import Scope
from router.compiler.lowering import lower_table
from router.compiler.mapping import build
from router.errors import Located, MappingError
from router.rehearsal.cdr import serialize as cdr
from router.table.model.expressions import FieldMap
from router.table.model.targets import Destination, Topic
from router.types.model import Bytes, Enum, Field, Int, List, MessageType, Type
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema, find_envelope, load_protos
from tests.carrier.delivering import Delivering
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, context_of
from tests.compiler.machine import functions
from tests.oracles.reference import fill_given
from tests.oracles.reference_protobuf import envelope_of
from tests.tables import PROTOS

Wire = tuple[ProtoSchema, Envelope]
MakeEnvelope = Callable[[Any], bytes]
"""Takes a message of the source's type. Raises MappingError, or one of FAILURES."""


@cache
def made_wire() -> Wire:
    """The definitions in `protos/made`."""
    return wire_of(Path(__file__).parent / "protos", "made.Envelope")


@cache
def rover_wire() -> Wire:
    return wire_of(PROTOS, "PBEnvelope")


def wire_of(root: Path, name: str) -> Wire:
    """The definitions in a folder; the envelope's oneof is `payload`."""
    schema = load_protos(Located(root, SPAN), Located(name, SPAN))
    return schema, find_envelope(schema, Located("payload", SPAN))


def compiled_envelope(wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType) -> MakeEnvelope:
    """The envelope that the machine in C makes from a ROS message, with a mapping without findings."""
    received = as_ros(source)
    made = machine_envelope(wire, case, fields, received)
    return lambda message: made(cdr(received, as_values(received, message)))


def machine_envelope(wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType) -> Callable[[bytes], bytes]:
    """The same for messages in CDR. `source` is a type that ROS can express."""
    schema, _ = wire
    mapping = build(fields, case.type, Scope(source, tuple(schema.enums.values()), ()), SPAN)
    assert mapping.findings == []
    route: Any = SimpleNamespace(name="route", ttl=None, ignore=None, span=SPAN)
    target = Target(Destination(Located("board", SPAN), SPAN), plan=mapping.plan)
    feed = CheckedSubscription(Topic(Located(SOURCE, SPAN), SPAN), source, None, None, None, (target,))
    lowered, findings = lower_table([CheckedRoute(route, case, subscriptions=(feed,))])
    assert findings == []
    carrier = Delivering(functions(), lowered.from_ros[SOURCE][0], RECEIVED_AT, "not of ROS")

    def make(message: bytes) -> bytes:
        (outcome,) = carrier.from_ros(message)
        if isinstance(outcome.got, str):
            raise MappingError(outcome.got)
        return outcome.got

    return make


def as_ros(declared: Type) -> Any:
    """A type that ROS can express and whose values fill the same fields."""
    match declared:
        case Bytes():
            return List(Int(8, signed=False))
        case Enum():
            return Int(32, signed=True)
        case List():
            return List(as_ros(declared.element), declared.length, declared.bound)
        case MessageType():
            possible = [field for field in declared.fields if _exists_in_ros(field.type)]
            return MessageType(declared.name, tuple(Field(field.name, as_ros(field.type)) for field in possible))
        case _:
            return declared


def _exists_in_ros(declared: Type) -> bool:
    """Whether ROS can express the type. It has no lists of lists, nor messages made only of them."""
    match declared:
        case List():
            return not isinstance(declared.element, (Bytes, List)) and _exists_in_ros(declared.element)
        case MessageType():
            return not declared.fields or any(_exists_in_ros(field.type) for field in declared.fields)
        case _:
            return True


def as_values(declared: MessageType, message: Any) -> dict[str, Any]:
    """A message as nested dictionaries by field name."""
    return {field.name: _value(field.type, getattr(message, field.name)) for field in declared.fields}


def _value(declared: Type, value: Any) -> Any:
    match declared:
        case MessageType():
            return as_values(declared, value)
        case List():
            return [_value(declared.element, each) for each in value]
        case _:
            return value


def reference_envelope(wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType) -> MakeEnvelope:
    """The oracle's envelope."""
    schema, envelope = wire
    enums = tuple(schema.enums.values())

    def make(message: Any) -> bytes:
        payload = fill_given(fields, case.type, context_of(message, source, enums))
        return envelope_of(schema, envelope, case, payload)

    return make


def made(case: str, fields: FieldMap, /, **given: tuple[Type, Any]) -> Any:
    """The payload of `made_wire` that a mapping makes from a message with these fields.

    Asserts that the oracle gives the same payload, in an envelope as protobuf serializes it.
    """
    wire = made_wire()
    declared = wire[1].cases[case]
    source = MessageType("made/msg/Source", tuple(Field(name, type_) for name, (type_, _) in given.items()))
    message = SimpleNamespace(**{name: value for name, (_, value) in given.items()})
    datagram = compiled_envelope(wire, declared, fields, source)(message)
    assert_same_bytes(wire, datagram, reference_envelope(wire, declared, fields, source)(message))
    parsed = wire[1].message_class.FromString(datagram)
    assert parsed.WhichOneof(wire[1].choice.oneof) == case
    assert_same_bytes(wire, parsed.SerializeToString(), datagram)
    return getattr(parsed, case)


def assert_same_bytes(wire: Wire, found: bytes, expected: bytes) -> None:
    """Assert that two envelopes are equal. Map entries may have any order, and the last entry of a key counts."""
    payload = wire[1].message_class.FromString(expected)
    if any(isinstance(value, Mapping) for _, case in payload.ListFields() for _, value in case.ListFields()):
        found, expected = (
            wire[1].message_class.FromString(each).SerializeToString(deterministic=True) for each in (found, expected)
        )
    assert found == expected
