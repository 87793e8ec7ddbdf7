"""Payloads of every kind of field (`protos/made`), and mappings compiled to functions that make envelopes of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from router.compiler.cdr import CdrReads
from router.compiler.expressions import Scope
from router.compiler.expressions.tree import paths_in
from router.compiler.mapping import build
from router.compiler.namespace import NAMESPACE
from router.compiler.plan import expressions
from router.compiler.python import NO_VALUES
from router.compiler.source import Source
from router.errors import Located
from router.table.model import FieldMap
from router.types.model import Field, MessageType, Type
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema, find_envelope, load_protos
from tests.compiler.compiling import RECEIVED_AT, SOURCE, SPAN, context_of
from tests.oracles.python_engine.payload import write_envelope
from tests.oracles.reference import fill_given
from tests.oracles.reference_protobuf import envelope_of
from tests.tables import PROTOS

Wire = tuple[ProtoSchema, Envelope]
MakeEnvelope = Callable[[Any], bytes]
"""Takes a message of the source's type. Raises one of MAPPING_FAILURES."""


@cache
def made_wire() -> Wire:
    """The definitions in `protos/made`."""
    return wire_of(Path(__file__).parent / "protos", "made.Envelope")


@cache
def rover_wire() -> Wire:
    return wire_of(PROTOS, "PBEnvelope")


def wire_of(root: Path, name: str) -> Wire:
    """The definitions in a folder, with an envelope whose oneof is `payload`."""
    schema = load_protos(Located(root, SPAN), Located(name, SPAN))
    return schema, find_envelope(schema, Located("payload", SPAN))


def compiled_envelope(
    wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType, *, is_serialized: bool = False
) -> MakeEnvelope:
    """What the compiler makes of a mapping without findings. The message comes as an object, or as CDR bytes."""
    schema, _ = wire
    scope = Scope(source, tuple(schema.enums.values()), ())
    mapping = build(fields, case.type, scope, SPAN)
    assert mapping.findings == []
    out = Source()
    with out.block(f"def envelope({'cdr' if is_serialized else 'm'}, source, received_at):", SPAN):
        reads = CdrReads(source, (path for node in expressions(mapping.plan) for path in paths_in(node)))
        if is_serialized:
            reads.write(out, SPAN)
        values = reads.values if is_serialized else NO_VALUES
        out.line(f"return {write_envelope(out, mapping.plan, case, 'it', values)}", SPAN)
    namespace: dict[str, Any] = {**NAMESPACE, **out.constants}
    exec(out.compile("table.yaml"), namespace)  # noqa: S102 - what is tested
    function = namespace["envelope"]
    return lambda message: function(message, SOURCE, RECEIVED_AT)


def reference_envelope(wire: Wire, case: PayloadCase, fields: FieldMap, source: MessageType) -> MakeEnvelope:
    """What the oracle makes of it."""
    schema, envelope = wire
    enums = tuple(schema.enums.values())

    def make(message: Any) -> bytes:
        payload = fill_given(fields, case.type, context_of(message, source, enums))
        return envelope_of(schema, envelope, case, payload)

    return make


def made(case: str, fields: FieldMap, /, **given: tuple[Type, Any]) -> Any:
    """The payload of `made_wire` that a mapping makes of a message with these fields.

    That it is the oracle's, in the envelope as protobuf serialises it, is seen to.
    """
    wire = made_wire()
    declared = wire[1].cases[case]
    source = MessageType("made/msg/Source", tuple(Field(name, type_) for name, (type_, _) in given.items()))
    message = SimpleNamespace(**{name: value for name, (_, value) in given.items()})
    datagram = compiled_envelope(wire, declared, fields, source)(message)
    assert_same_bytes(wire, datagram, reference_envelope(wire, declared, fields, source)(message))
    parsed = wire[1].message_class.FromString(datagram)
    assert parsed.WhichOneof(wire[1].oneof) == case
    assert_same_bytes(wire, parsed.SerializeToString(), datagram)
    return getattr(parsed, case)


def assert_same_bytes(wire: Wire, found: bytes, expected: bytes) -> None:
    """Assert that two envelopes are the same bytes, but for the order of a map's entries: protobuf does not fix it."""
    payload = wire[1].message_class.FromString(expected)
    if any(isinstance(value, Mapping) for _, case in payload.ListFields() for _, value in case.ListFields()):
        assert len(found) == len(expected)
        found, expected = (
            wire[1].message_class.FromString(each).SerializeToString(deterministic=True) for each in (found, expected)
        )
    assert found == expected
