"""Findings about envelopes that the router's C parser cannot judge as protobuf does."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.errors import Code, Diagnostic, SourceSpan
from router.types.descriptors import all_fields, all_types, container
from router.types.wire import delimited, parses

MOST_TYPES = 65536

Place = Callable[[str], SourceSpan]
"""Returns the span of a message or a field, by full name."""

_Found = tuple[str, str, str]
"""The full name of a declaration, what is wrong with it, and what to do."""


def undecidable(roots: Sequence[Descriptor], members: Container[int], place: Place) -> list[Diagnostic]:
    """Return findings about an envelope, other messages, and all types in them.

    The envelope is the first of `roots`. `members` are the numbers of the oneof's members.
    """
    envelope, types = roots[0], all_types(*roots)
    faults = [*_of_envelope(envelope, members), *(fault for descriptor in types for fault in _of_type(descriptor))]
    if len(types) > MOST_TYPES:
        what = f"{envelope.full_name} contains {len(types)} message types; the limit is {MOST_TYPES}"
        faults.append((envelope.full_name, what, ""))
    return [Diagnostic(place(name), Code.BAD_PROTO, what, hint) for name, what, hint in faults]


def _of_envelope(envelope: Descriptor, members: Container[int]) -> Iterator[_Found]:
    for field in envelope.fields:
        if field.number in members and field.enum_type is not None and field.enum_type.is_closed:
            what = f"{field.name} is in the envelope's oneof, and is a closed enum: protobuf ignores unknown numbers"
            yield field.full_name, what, "wrap it in a message"


def _of_type(descriptor: Descriptor) -> Iterator[_Found]:
    if descriptor.GetOptions().message_set_wire_format:
        yield descriptor.full_name, f"{descriptor.full_name} is a message set", "declare an ordinary message"
    for field in all_fields(descriptor):
        is_group = field.type == FieldDescriptor.TYPE_GROUP
        if is_group and not parses(container(field), delimited(field.number, b"\xff")):
            what = f"protobuf before 7.36 parses {field.full_name}, a group, as a message"
            yield field.full_name, what, "make it a message"
