"""An envelope with every feature of protobuf that the router forwards, and datagrams of it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from router.datagrams import Wire
from router.errors import Located, SourceSpan
from router.tools.payloads import PayloadModel, pose
from router.types.protobuf import find_envelope, load_protos
from router.types.table_envelopes import Envelopes
from tests.envelopes import LEN, VARINT, framed, tag

PROTOS = Path(__file__).parent


@cache
def wire() -> Wire:
    span = SourceSpan("everything")
    schema = load_protos(Located(PROTOS, span), Located("Envelope", span))
    return Wire(Envelopes({"": find_envelope(schema, Located("payload", span))}))


def payload(case: str, **fields: object) -> Any:
    """A payload of this case, with every field set unless `fields` are given."""
    found = wire().case(case)
    message = found.message_class(**fields)
    if not fields:
        PayloadModel(case, found.type, seed=1).fill(message, pose(1.5, 1_700_000_000.0))
    return message


def any_in_any(depth: int) -> bytes:
    value = b""
    for _ in range(depth):
        value = framed(1, b"/google.protobuf.Any") + framed(2, value)
    return value


def enveloped(case: str, **fields: object) -> bytes:
    return wire().encode(wire().case(case), payload(case, **fields))


def usual() -> Mapping[str, bytes]:
    """An envelope of each payload case, with every field."""
    return {case: enveloped(case) for case in wire().envelopes.first.cases}


def odd() -> Mapping[str, bytes]:
    """Envelopes that protobuf accepts, with values that have no JSON form, or that tools cannot print as they are."""
    motor = {"type_url": "t/plain.Motor", "value": b"\x0d\0\0\x80\x3f"}
    return {
        "a time out of range": enveloped("at", seconds=10**12),
        "a time with negative nanoseconds": enveloped("known", at={"seconds": 1, "nanos": -5}, whole={"value": 7}),
        "a duration with mixed signs": enveloped("known", lasts={"seconds": 1, "nanos": -1}),
        "an unknown type": enveloped("any", type_url="t/no.Such", value=b"\1"),
        "a known type": enveloped("any", **motor),
        "a known type, malformed": enveloped("known", anys={"a": {**motor, "value": b"\xff"}}),
        "any in any": framed(5, any_in_any(300)),
        "NaN in a struct": enveloped("object", fields={"a": {"number_value": float("nan")}}),
        "a mask without a JSON form": enveloped("known", mask={"paths": ["a_B"]}),
        "text that is not UTF-8": framed(1, tag(1, VARINT) + b"\1" + framed(7, b"\xff")),
        "a key that is not UTF-8": framed(1, tag(1, VARINT) + b"\1" + framed(13, framed(1, b"\xff")) + framed(13, b"")),
        "no required field": framed(1, b""),
        "a message without its required field": framed(15, b""),
        "no value of a closed enum": framed(1, tag(1, VARINT) + b"\1" + tag(4, VARINT) + b"\x63" + framed(6, b"\x63")),
        "nulls": enveloped("object", fields={"a": {"null_value": 0}, "b": {}}),
        "no kind of value": tag(6, LEN) + b"\0",
    }


def unroutable() -> Mapping[str, bytes]:
    """Envelopes whose payload is no message."""
    made = wire().envelopes.first.message_class
    members: Mapping[str, object] = {"heartbeat": 5, "note": "x", "gear": 1, "ping": {"number": 1}, "real": 0.5}
    return {name: made(**{name: value}).SerializePartialToString() for name, value in members.items()}
