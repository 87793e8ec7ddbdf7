"""Envelopes of the existing system: each decodes to the listed values and encodes back to the same bytes."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from router.types.protobuf import Envelope

GOLDEN: list[dict[str, Any]] = json.loads(Path(__file__).with_name("golden_envelopes.json").read_text())


def golden_id(entry: Mapping[str, Any]) -> str:
    return f"{entry['payload_case']}-{entry['mode']}"


def values_of(message: Message, listed: Mapping[str, Any]) -> dict[str, Any]:
    """The message in the form of the listing: every scalar, and of the submessages those that are set."""
    values: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.message_type is None:
            values[field.name] = value
        elif message.HasField(field.name):
            values[field.name] = values_of(value, listed.get(field.name, {}))
    return values


def native(descriptor: Any, listed: Mapping[str, Any]) -> dict[str, Any]:
    """The listing in Python's numbers: decimals as the float32 that they were printed from, int64 not as text."""
    values: dict[str, Any] = {}
    for name, value in listed.items():
        field = descriptor.fields_by_name[name]
        if field.message_type is not None:
            values[name] = native(field.message_type, value)
        elif field.type == FieldDescriptor.TYPE_FLOAT:
            values[name] = struct.unpack("<f", struct.pack("<f", value))[0]
        elif field.type == FieldDescriptor.TYPE_INT64:
            values[name] = int(value)
        else:
            values[name] = value
    return values


@pytest.mark.parametrize("entry", GOLDEN, ids=golden_id)
def test_golden_envelope_decodes_to_the_listed_values_and_they_encode_to_it(
    envelope: Envelope, entry: Mapping[str, Any]
) -> None:
    message = envelope.message_class.FromString(bytes.fromhex(entry["hex"]))
    assert message.WhichOneof(envelope.choice.oneof) == entry["payload_case"]
    case = envelope.cases[entry["payload_case"]]
    assert (case.number, case.type.name) == (entry["field_number"], entry["message"])
    payload = getattr(message, case.name)
    listed = native(payload.DESCRIPTOR, entry["fields"])
    assert values_of(payload, entry["fields"]) == listed
    assert envelope.message_class(**{case.name: listed}).SerializeToString().hex() == entry["hex"]


def test_golden_envelopes_cover_every_payload_case_of_the_existing_system(envelope: Envelope) -> None:
    assert {envelope.cases[entry["payload_case"]].number for entry in GOLDEN} == set(range(1, 27))
