"""The message that `router new` adds, with its number and fields, checked against the existing ones."""

from __future__ import annotations

import keyword
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from router.compiler import Checked
from router.errors import UsageError, did_you_mean, nearest, shown_path
from router.table.compose import resolve, surprise
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, EndpointKind
from router.table.model.settings import EnvelopeSettings
from router.types.lock_file import read_lock
from router.types.model import Enum, MessageType, snake_case
from router.types.protobuf import Envelope, ProtoSchema, load_protos

SCALARS = {
    "bool": "bool", "float": "float32", "double": "float64", "int32": "int32", "int64": "int64", "uint32": "uint32",
    "uint64": "uint64",
}  # fmt: skip
"""Scalar types of a field, by protobuf's name: ROS's name."""


@dataclass(frozen=True, slots=True)
class NewField:
    """`type` is one of SCALARS, or the full name of an enum or a message of the protos."""

    name: str
    type: str
    comment: str = ""


@dataclass(frozen=True, slots=True)
class NewMessage:
    """`board` is the endpoint that sends it, `case` its payload case, `fields` in the order of their numbers."""

    name: str
    number: int
    board: str
    case: str
    fields: tuple[NewField, ...]

    @property
    def prefix(self) -> str:
        """The prefix of the board's message names."""
        return prefix_of(self.board)

    @property
    def board_words(self) -> str:
        return self.board.replace("_", " ")

    @property
    def title(self) -> str:
        return f"{self.case.replace('_', ' ').capitalize()} from the {self.board_words}"

    @property
    def stem(self) -> str:
        """The name of its `.proto` file."""
        return self.case.removesuffix("_info")


@dataclass(frozen=True, slots=True)
class Site:
    """The place for a new message: a table without errors, its schema, and the folder of the ROS messages."""

    table: RouteTable
    settings: EnvelopeSettings
    schema: ProtoSchema
    envelope: Envelope
    messages: Path

    def file(self, name: str) -> str:
        """Return the `.proto` file of a message or an enum, relative to the folder of the protos."""
        return self.schema.sources.file(name)

    def new_file(self, message: NewMessage) -> str:
        """Return where its `.proto` file goes: the folder of its board, beside that of the envelope."""
        common = PurePosixPath(self.file(self.envelope.name)).parent
        return (common.parent / message.board / f"{message.stem}.proto").as_posix()


def site_of(checked: Checked, messages: Path) -> Site:
    """Return the site of a table without errors. Raises UsageError if it has no envelope."""
    if checked.table is None or checked.envelopes is None:
        raise ValueError(f"{checked.path} has errors")
    settings = checked.table.envelopes.get("")
    if settings is None and checked.table.envelopes:
        hint = "write the message, and its route, by hand"
        raise UsageError(f"{checked.path} has several envelopes: 'router new' adds to a table with `envelope`", hint)
    if settings is None:
        raise UsageError(f"{checked.path} has no 'envelope' that a message could be added to")
    if settings.oneof is None:
        hint = "write the message, and its route, by hand"
        raise UsageError(f"{checked.path} has an envelope without a oneof: 'router new' adds members of a oneof", hint)
    # A field's type may be in a file of its own.
    schema = load_protos(settings.protos, settings.message, settings.lock_file, settings.exclude, with_others=True)
    return Site(checked.table, settings, schema, checked.envelopes.first, messages)


def prefix_of(board: str) -> str:
    return "".join(word.capitalize() for word in board.split("_"))


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
"""Rejected as names, since boards and ROS nodes are compiled from the same declarations."""
_MESSAGE_NAME = re.compile(r"[A-Z][A-Za-z0-9]*")
_FIELD_NAME = re.compile(r"[a-z](_?[a-z0-9])*")

_LARGEST_NUMBER = (1 << 29) - 1
_OF_PROTOBUF = range(19_000, 20_000)
"""Field numbers that protobuf reserves for itself."""


def new_message(name: str, number: int, board: str, fields: Sequence[str], site: Site) -> NewMessage:
    """Return the message that the command line describes. Raises UsageError if it is invalid."""
    endpoint = _endpoint(board, site.table)
    case = _case(name, endpoint.name)
    _check_names(name, case, site)
    _check_number(number, case, site)
    new_fields = _parsed_fields(fields, site) if fields else _usual_fields(prefix_of(endpoint.name), site)
    message = NewMessage(name, number, endpoint.name, case, new_fields)
    for path in (site.schema.root / site.new_file(message), site.messages / f"{name}.msg"):
        if path.exists():
            raise UsageError(f"the file {shown_path(path)} already exists", "choose another name")
    return message


def _parsed_fields(texts: Sequence[str], site: Site) -> tuple[NewField, ...]:
    """Return fields from `dose_rate:float state:SensorState`, or one from `dose_rate:float # uSv/h`."""
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


def _usual_fields(prefix: str, site: Site) -> tuple[NewField, ...]:
    """Return the fields of a message without `--fields`: a number, and enums and messages that most siblings have."""
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
        raise UsageError(f"'{text}' is not a field", "write name:type, as in dose_rate:float")
    if not _FIELD_NAME.fullmatch(name) or keyword.iskeyword(name):
        raise UsageError(f"'{name}' is not a valid field name", "write it in the style of dose_rate")
    _check_word(name, "choose another name for the field")
    if surprise(name) or resolve(name) != name:  # in tables and tests names stand without quotation marks
        raise UsageError(f"YAML does not read '{name}' as text", f"choose another name, for example is_{name}")
    if type_ in SCALARS:
        return NewField(name, type_, comment)
    named = (*site.schema.messages, *site.schema.enums)
    own = [full for full in named if type_ in (full, full.rpartition(".")[2])]
    if not own:
        close = nearest(type_, sorted((*SCALARS, *named)))
        there = f"the types are {', '.join(SCALARS)}, and the enums and messages of the protos"
        hint = f"did you mean '{close}'?" if close else there
        if site.schema.warnings:  # perhaps the file that declares it
            hint += f" ({site.schema.warnings[0]})"
        raise UsageError(f"there is no type '{type_}' for '{name}'", hint)
    if len(own) > 1:
        raise UsageError(
            f"several types are called '{type_}'", f"write the full name for '{name}': {', '.join(sorted(own))}"
        )
    return NewField(name, own[0], comment)


def _check_word(name: str, remedy: str) -> None:
    """Reject keywords of C and C++. Raises UsageError."""
    if name in _OF_C:
        raise UsageError(f"'{name}' is a keyword of C or C++", remedy)


def _endpoint(board: str, table: RouteTable) -> Endpoint:
    """Return the endpoint of this name, with or without `_board`."""
    senders = {name: endpoint for name, endpoint in table.endpoints.items() if endpoint.kind is not EndpointKind.TOOL}
    endpoint = senders.get(board) or senders.get(f"{board}_board")
    if endpoint is None:
        names = [name.removesuffix("_board") for name in senders]
        hint = did_you_mean(board, names) or f"the boards are {', '.join(names)}"
        raise UsageError(f"{table.path.name} has no board '{board}'", hint)
    return endpoint


def _case(name: str, board: str) -> str:
    """Return the payload case: `radiation_info` of `SensorBoardRadiationInfo`."""
    prefix = prefix_of(board)
    rest = name.removeprefix(prefix)
    if not _MESSAGE_NAME.fullmatch(name) or rest == name or not _MESSAGE_NAME.fullmatch(rest):
        better = rest[:1].upper() + rest[1:]
        example = better if _MESSAGE_NAME.fullmatch(better) else "RadiationInfo"
        raise UsageError(f"'{name}' is not a valid name for a message of {board}", f"write it as {prefix}{example}")
    return snake_case(rest)


def _check_names(name: str, case: str, site: Site) -> None:
    taken = {known.rpartition(".")[2] for known in (*site.schema.messages, *site.schema.enums)}
    if name in taken:
        raise UsageError(f"there is already a message '{name}'")
    _check_word(case, "choose another name for the message")
    if surprise(case) or resolve(case) != case:
        raise UsageError(f"YAML does not read '{case}' as text", "choose another name for the message")
    if case in site.envelope.cases:
        number = site.envelope.cases[case].number
        raise UsageError(
            f"{site.envelope.name} already has a payload case '{case}', number {number}; choose another name"
        )
    topics = {topic.topic.value: route.name for route in site.table.routes for topic in route.all_topics}
    if case in topics:
        raise UsageError(f"the route {topics[case]} already has a topic '{case}'", "choose another name")


def _check_number(number: int, case: str, site: Site) -> None:
    """Raise UsageError, with the next free number, for a number that was ever used, reserved or promised."""
    lock, envelope = read_lock(site.schema.lock), site.envelope.name
    entries = lock.messages[envelope].entries if lock is not None and envelope in lock.messages else frozenset()
    holders = {entry.number: entry.name for entry in entries}
    holders |= {field.number: field.name for field in site.schema.messages[envelope].fields}
    above = range(max(holders, default=0) + 1, _LARGEST_NUMBER)
    free = next(candidate for candidate in above if _is_free(candidate, site))
    if not 1 <= number <= _LARGEST_NUMBER or number in _OF_PROTOBUF:
        raise UsageError(f"{number} is not a field number of protobuf", f"{free} is free")
    if number in holders:
        raise UsageError(f"number {number} belongs permanently to '{holders[number]}'", f"{free} is free")
    if any(number in span for span in site.schema.reserved_numbers(envelope)):
        raise UsageError(f"{envelope} reserves number {number}", f"{free} is free")
    if promised := _promise(number, site):
        raise UsageError(f"{site.file(envelope)} says: {promised} {free} is free")
    if case in holders.values():
        was = next(old for old, name in holders.items() if name == case)
        raise UsageError(
            f"'{case}' once had number {was}, and cannot be added again with another", "choose another name"
        )


def _is_free(number: int, site: Site) -> bool:
    reserved = any(number in span for span in site.schema.reserved_numbers(site.envelope.name))
    return not reserved and number not in _OF_PROTOBUF and not _promise(number, site)


def _promise(number: int, site: Site) -> str:
    """Return the comment in the envelope's file that promises the number, such as `Number 30 is promised to ...`."""
    text = (site.schema.root / site.file(site.envelope.name)).read_text(encoding="utf-8")
    promise = re.search(rf"//\s*(.*\b[Nn]umber {number}\b.*)", text)
    return promise[1] if promise else ""
