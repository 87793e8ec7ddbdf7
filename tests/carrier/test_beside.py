"""What expressions read of an envelope beside the payload, against the protobuf library."""

from __future__ import annotations

from ctypes import CDLL
from types import SimpleNamespace
from typing import Any

from hypothesis import given

from router.compiler.checked import CheckedRoute, Target
from router.compiler.expressions import Scope
from router.compiler.lowering import lower_table
from router.compiler.mapping import build
from router.errors import Located
from router.rehearsal.cdr import deserialize
from router.table.model.targets import Topic
from router.types.model import Bool, Field, Float, Int, MessageType, Type
from router.types.protobuf import PayloadCase
from router.types.table_envelopes import Envelopes
from tests.carrier.delivering import Delivering, Payload
from tests.carrier.messages import payloads
from tests.compiler.compiling import SPAN, field_map
from tests.compiler.payloads import wire_of
from tests.rehearsal.test_tables import TABLES

SCHEMA, ENVELOPE = wire_of(TABLES / "beside", "Frame")
WHOLE = PayloadCase("frame", 1, SCHEMA.messages["Frame"], ENVELOPE.message_class, None)
"""The envelope as if it were a payload, for random ones."""
NOWHERE = Payload(0, 0, is_single=True)
"""An empty payload: what expressions read beside it does not depend on its place."""

READ: dict[str, tuple[Type, str]] = {
    "seq": (Int(32, signed=False), "envelope.header.seq"),
    "has_header": (Bool(), "has(envelope.header)"),
    "robot": (Int(32, signed=True), "envelope.robot"),
    "mode": (Int(32, signed=True), "envelope.mode"),
    "length": (Int(32, signed=False), "len(envelope.name)"),
    "has_volts": (Bool(), "has(envelope.volts)"),
    "volts": (Float(32), "envelope.volts"),
    "percent": (Int(32, signed=False), "envelope.percent"),
    "place": (Int(32, signed=False), "envelope.place"),
}
TARGET = MessageType("made/msg/Beside", tuple(Field(name, declared) for name, (declared, _) in READ.items()))


def _expected(data: bytes) -> dict[str, Any]:
    frame: Any = ENVELOPE.message_class.FromString(data)
    own = {name: getattr(frame, name) for name in ("robot", "mode", "volts", "percent", "place")}
    return own | {
        "seq": frame.header.seq,
        "length": len(frame.name),
        "has_header": frame.HasField("header"),
        "has_volts": frame.HasField("volts"),
    }


def test_fields_beside_a_payload_are_those_that_protobuf_parses(delivering: CDLL) -> None:
    case = ENVELOPE.cases["speed"]
    scope = Scope(case.type, tuple(SCHEMA.enums.values()), (), envelope=ENVELOPE)
    mapping = build(field_map(**{name: text for name, (_, text) in READ.items()}), TARGET, scope, SPAN)
    assert not mapping.findings
    route: Any = SimpleNamespace(name="route", ttl=None, ignore=None, span=SPAN)
    target = Target(Topic(Located("topic", SPAN), SPAN), type=TARGET, plan=mapping.plan)
    lowered, findings = lower_table([CheckedRoute(route, case, (target,))], Envelopes({"": ENVELOPE}))
    assert not findings
    carrier = Delivering(delivering, lowered.to_topics["route"])

    @given(payloads(WHOLE))
    def same(frames: list[bytes]) -> None:
        for frame in frames:
            (outcome,) = carrier.datagram(frame, NOWHERE)
            assert isinstance(outcome.got, bytes)
            made, expected = vars(deserialize(TARGET, outcome.got)), _expected(frame)
            assert {name: str(value) for name, value in made.items()} == {name: str(expected[name]) for name in READ}

    same()
