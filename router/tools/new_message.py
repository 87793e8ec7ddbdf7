"""A message that the rover shall have: what it is called, its number and fields, and why there can be none like it.

Knows the table, the payload cases and the lock that there are, and writes nothing. What is written of it is the
business of `new_message_proto`, `new_message_ros` and `new_message_tables`.
"""

from __future__ import annotations

import keyword
import re
from collections import Counter
from collections.abc import Sequence

from router.errors import UsageError, did_you_mean, nearest, shown_path
from router.table.model import Endpoint, EndpointKind, RouteTable
from router.table.scalars import resolve, surprise
from router.tools.new_message_model import SCALARS, NewField, NewMessage, Site, prefix_of
from router.tools.new_message_number import check_number
from router.types.model import Enum, MessageType

_OF_C = frozenset(
    """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept const consteval
    constexpr constinit const_cast continue co_await co_return co_yield decltype default delete do double dynamic_cast
    else enum explicit export extern false float for friend goto if inline int long mutable namespace new noexcept not
    not_eq nullptr operator or or_eq private protected public register reinterpret_cast requires restrict return short
    signed sizeof static static_assert static_cast struct switch template this thread_local throw true try typedef
    typeid typename union unsigned using virtual void volatile wchar_t while xor xor_eq
    """.split()  # noqa: SIM905 - ninety words are read more easily without quotes
)
"""What boards and ROS nodes, which are compiled from the same names, cannot have as a name."""
_MESSAGE_NAME = re.compile(r"[A-Z][A-Za-z0-9]*")
_FIELD_NAME = re.compile(r"[a-z](_?[a-z0-9])*")
_WORD_BORDER = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


def new_message(name: str, number: int, board: str, fields: Sequence[str], site: Site) -> NewMessage:
    """The message as asked for, `fields` as `parsed_fields` has them. Raises UsageError for what cannot be."""
    endpoint = _endpoint(board, site.table)
    case = _case(name, endpoint.name)
    _check_names(name, case, site)
    check_number(number, case, site)
    asked = parsed_fields(fields, site) if fields else usual_fields(prefix_of(endpoint.name), site)
    message = NewMessage(name, number, endpoint.name, case, asked)
    for path in (site.schema.root / site.new_file(message), site.messages / f"{name}.msg"):
        if path.exists():
            raise UsageError(f"there is a file {shown_path(path)} already; take another name")
    return message


def parsed_fields(texts: Sequence[str], site: Site) -> tuple[NewField, ...]:
    """Of `dose_rate:float state:SensorState`, or a single field with its unit, `dose_rate:float # uSv/h`."""
    fields: list[NewField] = []
    for text in texts:
        declared, _, comment = text.partition("#")
        words = declared.split()
        if comment and len(words) != 1:
            raise UsageError(f"'{text}': a comment belongs to one field, as in 'dose_rate:float # uSv/h'")
        fields += [_field(word, " ".join(comment.split()), site) for word in words]
    for name, times in Counter(field.name for field in fields).items():
        if times > 1:
            raise UsageError(f"there are {times} fields '{name}'")
    if not fields:
        raise UsageError("--fields names no field")
    return tuple(fields)


def usual_fields(prefix: str, site: Site) -> tuple[NewField, ...]:
    """One number to begin with, and what most messages of that board have."""
    siblings = [case.type for case in site.envelope.cases.values() if case.type.short_name.startswith(prefix)]
    shared = Counter(
        NewField(field.name, field.type.name)
        for type_ in siblings
        for field in type_.fields
        if isinstance(field.type, (Enum, MessageType))
    )
    return (NewField("value", "float"), *(field for field, times in shared.items() if times * 2 > len(siblings)))


def _field(text: str, comment: str, site: Site) -> NewField:
    name, colon, type_ = text.partition(":")
    if not colon:
        raise UsageError(f"'{text}' is no field; write name:type, as in dose_rate:float")
    if not _FIELD_NAME.fullmatch(name) or keyword.iskeyword(name):
        raise UsageError(f"'{name}' is no name of a field; write it as dose_rate")
    _check_word(name, "take another name for the field")
    if surprise(name) or resolve(name) != name:  # in tables and tests names stand without quotation marks
        raise UsageError(f"'{name}' is no text to readers of YAML; take another name, such as is_{name}")
    if type_ in SCALARS:
        return NewField(name, type_, comment)
    named = (*site.schema.messages, *site.schema.enums)
    own = [full for full in named if type_ in (full, full.rpartition(".")[2])]
    if not own:
        close = nearest(type_, sorted((*SCALARS, *named)))
        there = f"there are {', '.join(SCALARS)}, and the enums and messages of the protos"
        hint = f"did you mean '{close}'?" if close else there
        if site.schema.warnings:  # perhaps the file that declares it
            hint += f" ({site.schema.warnings[0]})"
        raise UsageError(f"there is no type '{type_}' for '{name}'; {hint}")
    if len(own) > 1:
        raise UsageError(f"several types are called '{type_}'; write which for '{name}': {', '.join(sorted(own))}")
    return NewField(name, own[0], comment)


def _check_word(name: str, remedy: str) -> None:
    """Boards and ROS nodes have it as a name in their own languages."""
    if name in _OF_C:
        raise UsageError(f"'{name}' is a word of C or C++, and no name there; {remedy}")


def _endpoint(board: str, table: RouteTable) -> Endpoint:
    """By its name, or without `_board`."""
    senders = {name: each for name, each in table.endpoints.items() if each.kind is not EndpointKind.TOOL}
    found = senders.get(board) or senders.get(f"{board}_board")
    if found is None:
        names = [name.removesuffix("_board") for name in senders]
        hint = did_you_mean(board, names) or f"there are {', '.join(names)}"
        raise UsageError(f"{table.path.name} has no board '{board}'; {hint}")
    return found


def _case(name: str, board: str) -> str:
    """`radiation_info` of `SensorBoardRadiationInfo`."""
    prefix = prefix_of(board)
    rest = name.removeprefix(prefix)
    if not _MESSAGE_NAME.fullmatch(name) or rest == name or not _MESSAGE_NAME.fullmatch(rest):
        better = rest[:1].upper() + rest[1:]
        example = better if _MESSAGE_NAME.fullmatch(better) else "RadiationInfo"
        raise UsageError(f"'{name}' is no name for a message of {board}; write it as {prefix}{example}")
    return _WORD_BORDER.sub("_", rest).lower()


def _check_names(name: str, case: str, site: Site) -> None:
    taken = {known.rpartition(".")[2] for known in (*site.schema.messages, *site.schema.enums)}
    if name in taken:
        raise UsageError(f"there is a message '{name}' already")
    _check_word(case, "take another name for the message")
    if surprise(case) or resolve(case) != case:
        raise UsageError(f"'{case}' is no text to readers of YAML; take another name for the message")
    if case in site.envelope.cases:
        number = site.envelope.cases[case].number
        raise UsageError(
            f"{site.envelope.name} has a payload case '{case}' already, number {number}; take another name"
        )
    topics = {topic.topic.value: route.name for route in site.table.routes for topic in route.topics}
    if case in topics:
        raise UsageError(f"the route {topics[case]} has a topic '{case}' already; take another name")
