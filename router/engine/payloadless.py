"""Why an envelope that the protobuf library accepts has no payload, for the engine and for tools that tell the same."""

from __future__ import annotations

from collections.abc import Container

from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet


def why_no_payload(envelope: Message, cases: Container[int]) -> tuple[str, str]:
    """The reason under which the datagram is rejected, and the field that gives it, if one does.

    `cases` are the field numbers of the payload cases: one of them that the library does not know as a
    field has the wrong wire type.
    """
    fields = UnknownFieldSet(envelope)
    numbers = [fields[index].field_number for index in range(len(fields))]
    if not numbers:
        return "no_payload", ""
    if known := [number for number in numbers if number in cases]:
        return "malformed", f"field {known[0]} is no message here"
    return "unknown_case", f"field {numbers[0]}"
