"""What `router init --protos` proposes: an envelope among somebody's messages, and a route for each payload case."""

from __future__ import annotations

import keyword
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from router.errors import UsageError, did_you_mean
from router.table.compose import resolve, surprise
from router.types.lock_file import LOCK_NAME
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, snake_case
from router.types.protobuf import ProtoSchema

_MOST_NUMBERS = 16
"""Numbers of a message that its proposed topic has."""

_DEEPEST = 3
"""How deep in other messages these may be."""

_EXACT_BITS = 53
"""Integers of more bits need a conversion to become doubles."""

_WIDTH = 120
"""Columns of a comment in the table."""

_PLAIN = re.compile(r"[A-Za-z0-9_./+-]+")
"""Text that needs no quotation marks in YAML, if it is not a number or the like."""


class Choice(IntEnum):
    """How a frame says which message it is; the surest sign comes last."""

    WHOLE = 0
    CASES = 1
    NAMED = 2
    ONEOF = 3


@dataclass(frozen=True, slots=True)
class Candidate:
    """A message that may be the envelope.

    `settings` are the keys of the table's `envelope` that say which payload it has; `cases` are the payloads, by name.
    """

    message: MessageType
    choice: Choice
    settings: Mapping[str, str]
    cases: Mapping[str, MessageType]


def candidates(schema: ProtoSchema, name: str | None = None) -> list[Candidate]:
    """Return the messages that may be the envelope, the likeliest first: those that no other message contains.

    With `name`, a message with or without its package, that one comes first. Raises UsageError.
    """
    own = [message for full, message in schema.messages.items() if _is_top_level(schema, full)]
    contained = {inner for message in schema.messages.values() for inner in _contained(message) if inner is not message}
    roots = [message for message in own if message not in contained]
    found = sorted((_candidate(message, roots) for message in roots), key=_rank)
    if name is None:
        return found
    fitting = [message for message in own if name in (message.name, message.short_name)]
    if len(fitting) != 1:
        hint = did_you_mean(name, [message.name for message in own])
        raise UsageError(f"the protos have {'several messages' if fitting else 'no message'} '{name}'", hint)
    return [_candidate(fitting[0], roots), *(each for each in found if each.message is not fitting[0])]


def _rank(candidate: Candidate) -> tuple[int, int]:
    return -candidate.choice, -len(candidate.cases)


def table_text(envelope: Candidate, others: Sequence[Candidate], protos: str) -> str:
    """Return a table for the envelope, with the folder `protos` relative to it. A comment names the `others`."""
    settings = {"protos": protos, "lock": LOCK_NAME, "message": envelope.message.name, **envelope.settings}
    lines = [_HEADER, "envelope:", *(f"  {key}: {_quoted(value)}" for key, value in settings.items())]
    payloads = envelope.cases.values()
    if names := ", ".join(other.message.name for other in others if other.message not in payloads):
        lines += _comment(f"Not in this envelope: {names}. `router init --message NAME` proposes a table for another")
    lines.append(_ENDPOINTS)
    for name, payload in envelope.cases.items():
        lines += _route(name, payload)
    return "\n".join(lines) + "\n"


_HEADER = """\
# A table to begin with, proposed by `router init --protos`: each payload of the envelope becomes a topic with the first
# numbers of the message. Give each topic the type and the fields that you want, and the robot its address. If it is on
# a serial line, the listener has `serial`, `baud` and `framing` instead, and the robot `listener: robot`. To send a
# payload to the robot, write `source: {topic: NAME}` and `destinations: robot` instead.

version: 1
"""

_ENDPOINTS = """\

http: {address: 127.0.0.1:9108}   # the status page

listen:
  robot: {address: 127.0.0.1:5000, framing: exact}   # a datagram that was cut short is malformed

endpoints:
  robot: {address: 127.0.0.2:8008, kind: board}   # known by its IP address

routes:"""


def _route(name: str, payload: MessageType) -> Iterator[str]:
    fields = ", ".join(f"{member.name}: {member.type}" for member in payload.fields)
    type_, filled = _topic(payload)
    topic = ", ".join([f"topic: {_quoted(name.replace('.', '/'))}", f"type: std_msgs/msg/{type_}", f"fields: {filled}"])
    yield ""
    yield from (f"  {line}" for line in _comment(f"{payload.name}: {fields or 'no fields'}"))
    yield f"  {_quoted(name)}:"
    yield "    source: robot"
    yield f"    topics: {{{topic}}}"


def _topic(payload: MessageType) -> tuple[str, str]:
    """Return a type of std_msgs that shows something of the message, and its `fields`."""
    numbers = [*_numbers(payload, (), _DEEPEST)][:_MOST_NUMBERS]
    if numbers:
        return "Float64MultiArray", f"{{data: [{', '.join(numbers)}]}}"
    texts = [member.name for member in payload.fields if isinstance(member.type, String) and not member.is_unchecked]
    if texts:
        return "String", f"{{data: {_path((texts[0],))}}}"
    return "Empty", "{}"


def _numbers(message: MessageType, path: tuple[str, ...], depth: int) -> Iterator[str]:
    """Yield expressions for the numbers of a message, and of those in it."""
    for member in message.fields:
        here = (*path, member.name)
        if isinstance(member.type, (Bool, Enum)):
            yield f"int({_path(here)})"
        elif isinstance(member.type, Int) and member.type.bits > _EXACT_BITS:
            yield f"float64({_path(here)})"
        elif isinstance(member.type, (Int, Float)):
            yield _path(here)
        elif isinstance(member.type, MessageType) and not member.is_group and depth > 0:
            yield from _numbers(member.type, here, depth - 1)


def _path(path: tuple[str, ...]) -> str:
    """Return an expression for a field, which stands for nothing else to YAML or to the router."""
    first = path[0]
    is_plain = resolve(first) == first and not surprise(first) and not keyword.iskeyword(first)
    return ".".join(path if is_plain else ("message", *path))


def _is_top_level(schema: ProtoSchema, name: str) -> bool:
    """Whether a message of this full name is declared in a file of the folder, outside other messages."""
    descriptor = schema.descriptor(name)
    return descriptor.containing_type is None and descriptor.file.name in schema.files


def _contained(message: MessageType) -> Iterator[MessageType]:
    """Yield the types of the messages in a message's fields."""
    for member in message.fields:
        kind = member.type.content if isinstance(member.type, List) else member.type
        if isinstance(kind, MessageType):
            yield kind


def _candidate(message: MessageType, roots: Sequence[MessageType]) -> Candidate:
    groups: dict[str, list[Field]] = {}
    for member in message.fields:
        if member.oneof and member.oneof != f"_{member.name}" and isinstance(member.type, MessageType):
            groups.setdefault(member.oneof, []).append(member)
    if groups:
        oneof = max(groups, key=lambda name: len(groups[name]))
        return Candidate(message, Choice.ONEOF, {"oneof": oneof}, _payloads(groups[oneof]))
    if named := _name_and_bytes(message):
        return Candidate(message, Choice.NAMED, named, {root.name: root for root in roots if root is not message})
    optional = [member for member in message.fields if _is_optional_message(member)]
    if len(optional) > 1 and 2 * len(optional) > len(message.fields):
        cases = ", ".join(member.name for member in optional)
        return Candidate(message, Choice.CASES, {"cases": f"[{cases}]"}, _payloads(optional))
    case = snake_case(message.short_name)
    return Candidate(message, Choice.WHOLE, {"case": case}, {case: message})


def _is_optional_message(member: Field) -> bool:
    is_single = isinstance(member.type, MessageType) and not member.is_group
    return is_single and not member.is_required and member.oneof in (None, f"_{member.name}")


def _name_and_bytes(message: MessageType) -> dict[str, str]:
    """Return the settings of an envelope with the payload's name and its bytes, {} of another message."""
    texts = [member.name for member in message.fields if isinstance(member.type, String)]
    data = [member.name for member in message.fields if isinstance(member.type, Bytes)]
    return {"case": texts[0], "payload": data[0]} if len(texts) == len(data) == 1 else {}


def _payloads(members: Sequence[Field]) -> dict[str, MessageType]:
    return {member.name: member.type for member in members if isinstance(member.type, MessageType)}


def _quoted(text: str) -> str:
    """Return a scalar of YAML that is this text."""
    is_plain = resolve(text) == text and not surprise(text) and _PLAIN.fullmatch(text)
    return text if is_plain or text.startswith("[") else f"'{text}'"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
