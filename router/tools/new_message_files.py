"""The files that a new message adds or changes. Existing files get lines inserted; every other line stays as it is."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import yaml

from router.errors import Severity, UsageError, shown_path
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.routes import ANY, Route
from router.tools.new_message import SCALARS, NewField, NewMessage, Site
from router.types.envelopes import chosen_envelope
from router.types.lock import LockComparison
from router.types.lock_file import lock_text
from router.types.model import Bool, Enum, Float, MessageType, Type
from router.types.protobuf import load_protos

_WIDEST = 120
_LONGEST_FIELD = 60
"""Characters reserved for the last field on a line."""
_SECTION_WIDTH = 115
_COMMENT_GAP = 3


@dataclass(frozen=True, slots=True)
class Changes:
    """`texts` are the whole contents of each file. `unrouted` are the other tables that need a route by hand."""

    texts: Mapping[Path, str]
    unrouted: tuple[Path, ...]


def changes(message: NewMessage, site: Site, others: Sequence[RouteTable]) -> Changes:
    """Return all changes except to the lock. `others` are the tables beside the site's. Raises UsageError."""
    root, table = site.schema.root, site.table
    envelope = root / site.file(site.envelope.name)
    texts = {
        root / site.new_file(message): _proto(message, site),
        envelope: _in_envelope(_read(envelope), message, site),
        site.messages / f"{message.name}.msg": _msg(message, site),
        table.path: _in_table(_read(table.path), message, site),
    }
    tests = table.path.with_name(f"{table.path.stem}.test{table.path.suffix}")
    if tests.exists():
        texts[tests] = _in_tests(tests, message, site)
    unrouted = []
    for other in others:
        if table.path in other.files or _protos(other) != _protos(table):
            continue
        text = _in_forwarding_table(_read(other.path), message, other)
        if text is None:
            unrouted.append(other.path)
        else:
            texts[other.path] = text
    return Changes(texts, tuple(unrouted))


class Written:
    """Writes files with their line ends preserved, and can undo all of them.

    If one cannot be written, undoes the others and raises UsageError.
    """

    def __init__(self, texts: Mapping[Path, str]) -> None:
        self._before: dict[Path, bytes | None] = {}
        self._folders: list[Path] = []
        for path, text in texts.items():
            self.write(path, text)

    def write(self, path: Path, text: str) -> None:
        try:
            before = path.read_bytes() if path.exists() else None
            self._before[path] = before
            self._folders += [folder for folder in path.parents if not folder.exists()]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="\r\n" if before and b"\r\n" in before else "\n")
        except OSError as error:
            self.undo()
            raise UsageError(f"{error.filename} cannot be written: {error.strerror}") from error
        except BaseException:  # Ctrl-C
            self.undo()
            raise

    @property
    def new(self) -> list[Path]:
        return [path for path, before in self._before.items() if before is None]

    @property
    def changed(self) -> list[Path]:
        return [path for path, before in self._before.items() if before is not None]

    def undo(self) -> None:
        for path, before in self._before.items():
            if before is None:
                with suppress(FileNotFoundError, NotADirectoryError):  # it was not written
                    path.unlink()
            elif path.read_bytes() != before:
                path.write_bytes(before)
        for folder in self._folders:  # the innermost first
            with suppress(OSError):  # it was not made, or has other files by now
                folder.rmdir()


def locked(site: Site) -> str:
    """Return the lock with the new declarations of the `.proto` files. Raises UsageError and TableError."""
    schema = load_protos(site.settings.protos, site.settings.message, site.settings.lock_file, site.settings.exclude)
    lock = LockComparison(chosen_envelope(schema, site.settings.choice))
    errors = [finding for finding in lock.findings() if finding.severity is Severity.ERROR]
    if errors:
        raise UsageError("; ".join(finding.message for finding in errors))
    return lock_text(lock.extended())


# Protobuf and ROS declarations


def _proto(message: NewMessage, site: Site) -> str:
    imports = sorted({site.file(field.type) for field in message.fields if field.type not in SCALARS})
    rows = [
        (f"  {field.type} {field.name} = {number};", field.comment) for number, field in enumerate(message.fields, 1)
    ]
    lines = [
        f"// {message.title}.",
        'syntax = "proto3";',
        "",
        *(f'import "{name}";' for name in imports),
        *([""] if imports else []),
        f"message {message.name} {{",
        *_aligned(rows, "//"),
        "}",
    ]
    return "\n".join(lines) + "\n"


_IMPORT = re.compile(r'\s*import\s+(?:public\s+)?"(.*)"\s*;')
_HEAD = re.compile(r"\s*(syntax|package)\b")


def _in_envelope(text: str, message: NewMessage, site: Site) -> str:
    """Return the envelope's file with the import, in its order, and the payload case after the last one."""
    lines = text.split("\n")
    places = {
        field: site.schema.span(site.envelope.name, field.name).line
        for field in site.schema.messages[site.envelope.name].fields
        if field.oneof == site.envelope.choice.oneof
    }
    last = max(places, key=lambda field: places[field])
    end = next(index for index in range(places[last] - 1, len(lines)) if ";" in lines[index])
    indent = " " * _indent(lines[end])
    own = f"{indent}{message.name} {message.case} = {message.number};"
    is_of_same_board = site.envelope.cases[last.name].type.short_name.startswith(message.prefix)
    lines[end + 1 : end + 1] = [own] if is_of_same_board else ["", f"{indent}// {message.board_words}", own]

    imports = {index: match[1] for index, line in enumerate(lines) if (match := _IMPORT.match(line))}
    head = max((index for index, line in enumerate(lines) if _HEAD.match(line)), default=-1)
    new = site.new_file(message)
    place = next((index for index, name in imports.items() if name > new), max(imports, default=head) + 1)
    lines.insert(place, f'import "{new}";')
    return "\n".join(lines)


def _msg(message: NewMessage, site: Site) -> str:
    """Return the ROS message whose fields `fields: auto` fills by their names.

    An enum is a message of its own where there is one, else a uint8 with its values as constants. Raises UsageError
    for a field whose type has no ROS message.
    """
    lines = [f"# {message.title}.", ""]
    for name in dict.fromkeys(field.type for field in message.fields):
        if constants := list(_constants(name, site)):
            lines += [*constants, ""]
    rows = [(f"{_ros_type(field, site)} {field.name}", _msg_comment(field, site)) for field in message.fields]
    return "\n".join([*lines, *_aligned(rows, "#")]) + "\n"


def _ros_type(field: NewField, site: Site) -> str:
    if field.type in SCALARS:
        return SCALARS[field.type]
    if _has_message(field.type, site):
        return _short(field.type)
    if field.type in site.schema.enums:
        return "uint8"
    raise UsageError(f"'{field.name}' needs {site.messages.name}/{_short(field.type)}.msg", "declare that first")


def _constants(name: str, site: Site) -> Iterator[str]:
    if name not in site.schema.enums or _has_message(name, site):
        return
    for value, number in site.schema.enums[name].values:
        if not 0 <= number <= 255:
            raise UsageError(f"{name}.{value} is {number}, which is no uint8", "write the .msg file by hand")
        yield f"uint8 {value}={number}"


def _msg_comment(field: NewField, site: Site) -> str:
    if field.comment or field.type not in site.schema.enums or _has_message(field.type, site):
        return field.comment
    words = {value.partition("_")[0] for value, _ in site.schema.enums[field.type].values}
    return f"{words.pop()}_*" if len(words) == 1 else ""


def _has_message(name: str, site: Site) -> bool:
    return Path(site.messages, f"{_short(name)}.msg").exists()


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def _aligned(rows: Iterable[tuple[str, str]], mark: str) -> Iterator[str]:
    """Yield declarations with their comments aligned."""
    rows = list(rows)
    width = max((len(code) for code, comment in rows if comment), default=0) + _COMMENT_GAP
    for code, comment in rows:
        yield f"{code:{width}}{mark} {comment}" if comment else code


# Tables and tests


class _Entry(NamedTuple):
    """One entry of a YAML section: index of its first line, and of the line after its last."""

    first: int
    end: int
    indent: int
    value: yaml.Node


def _entries(text: str, section: str) -> list[_Entry]:
    """Return the entries of a top-level mapping."""
    root = yaml.compose(text, yaml.SafeLoader)
    top = root.value if isinstance(root, yaml.MappingNode) else []
    mapping = next((value for key, value in top if key.value == section), None)
    lines, entries = text.split("\n"), []
    for key, value in mapping.value if isinstance(mapping, yaml.MappingNode) else []:
        first = key.start_mark.line
        last = max(first, _last_line(value))
        while not lines[last].strip():
            last -= 1
        entries.append(_Entry(first, last + 1, key.start_mark.column, value))
    return entries


def _last_line(node: yaml.Node) -> int:
    """Return the index of a node's last line, or of a blank one after it. The end mark of a block is after comments."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _last_line(last[1] if isinstance(last, tuple) else last)
    is_block = isinstance(node, yaml.ScalarNode) and node.style in ("|", ">")
    return int(node.end_mark.line) - (is_block and node.end_mark.column == 0)


def _with_stanza(text: str, after: _Entry, stanza: Iterable[str], section: str = "") -> str:
    """Return the text with a stanza after an entry, under a heading if there is a `section`."""
    lines = text.split("\n")
    indent = " " * after.indent
    stanza = list(stanza)
    head = ["", f"{indent}# ---- {section} ".ljust(_SECTION_WIDTH, "-")] if section else []
    gap = [""] if head or len(stanza) > 1 or after.end - after.first > 1 else []
    return "\n".join([*lines[: after.end], *head, *gap, *(indent + line for line in stanza), *lines[after.end :]])


def _in_table(text: str, message: NewMessage, site: Site) -> str:
    """Return the table with a route from the board to ROS and the basestation, after the last route of that board."""
    own = _own_routes(site.table)
    if not own and len(site.table.files) > 1:
        extended = shown_path(site.table.files[1])
        raise UsageError(
            f"{shown_path(site.table.path)} has no routes of its own", f"use the table that it extends: -t {extended}"
        )
    of_board = [route for route in own if message.board in (source.value for source in route.sources)]
    last = _last_route(text, of_board or own)
    route = _route(message, site, _WIDEST - last.indent)
    return _with_stanza(text, last, route, "" if of_board else message.board_words)


def _route(message: NewMessage, site: Site, width: int) -> list[str]:
    receivers = _basestations(message, site.table)
    names = receivers[0] if len(receivers) == 1 else f"[{', '.join(receivers)}]"
    package = site.messages.parent.name
    topic = f"topic: {message.case}"
    if site.table.package is None or site.table.package.value != package:
        topic = f"topics: {{{topic}, type: {package}/msg/{message.name}}}"
    keys = [f"source: {message.board}", *([f"destinations: {names}"] if receivers else []), topic]
    line = f"{message.case}: {{{', '.join(keys)}}}"
    return [line] if len(line) <= width else [f"{message.case}:", *(f"  {key}" for key in keys)]


_ONE_LINE = re.compile(r" *\w+: +(\{.*\}) *$")


def _in_forwarding_table(text: str, message: NewMessage, table: RouteTable) -> str | None:
    """Return a table that sends everything to the same endpoints, with the new case added. None for any other table."""
    own = _own_routes(table)
    if not own or len({_forwarding(route) for route in table.routes}) != 1 or _forwarding(own[0])[0] != (ANY,):
        return None
    last = _last_route(text, own)
    lines = text.split("\n")
    template = _ONE_LINE.match(lines[last.first])
    if template is None:
        return None
    key = f"{' ' * last.indent}{message.case}:"
    lines.insert(last.end, f"{key.ljust(template.start(1) - 1)} {template[1]}")
    return "\n".join(lines)


def _forwarding(route: Route) -> tuple[tuple[str, ...], tuple[str, ...]]:
    sources = tuple(source.value for source in route.sources)
    return sources, tuple(destination.endpoint.value for destination in route.destinations)


def _own_routes(table: RouteTable) -> list[Route]:
    """Return the routes of the file itself, without those of the tables that it extends."""
    return [route for route in table.routes if route.span.file == shown_path(table.path)]


def _last_route(text: str, routes: Iterable[Route]) -> _Entry:
    line = max((route.case.span.line for route in routes), default=0)
    last = next((entry for entry in _entries(text, "routes") if entry.first == line - 1), None)
    if last is None:
        raise UsageError("the table has no routes of its own to add one to", "write the route by hand")
    return last


def _basestations(message: NewMessage, table: RouteTable) -> list[str]:
    """Return the endpoints that get every message of a board."""
    endpoints = table.endpoints.items()
    return [name for name, endpoint in endpoints if endpoint.kind is EndpointKind.BASESTATION and name != message.board]


def _in_tests(path: Path, message: NewMessage, site: Site) -> str:
    """Return the test file with one more test, below the last one of that board: the message passes unchanged."""
    text = _read(path)
    try:
        entries = _entries(text, "tests")
    except yaml.YAMLError as error:
        raise UsageError(f"{shown_path(path)} is not valid YAML: {error}") from error
    if not entries:
        raise UsageError(f"{shown_path(path)} has no 'tests'", "write a test, or remove the file")
    of_board = [entry for entry in entries if message.board in _senders(entry.value)]
    return _with_stanza(text, (of_board or entries)[-1], _test(message, site), "" if of_board else message.board_words)


def _senders(node: yaml.Node) -> Iterator[str]:
    """Yield everything that a test names as `from`."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            yield from _senders(item)
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == "from" and isinstance(value, yaml.ScalarNode):
                yield value.value
            yield from _senders(value)


def _test(message: NewMessage, site: Site) -> Iterator[str]:
    receivers = _basestations(message, site.table)
    subject = message.case.replace("_", " ")
    yield f"{subject} reaches {'the operator and ROS unchanged' if receivers else 'ROS as the operator sent it'}:"
    yield "  given:"
    yield f"    case: {message.case}"
    yield f"    from: {message.board}"
    fields = {field.name: _sample(field.type, place, site) for place, field in enumerate(message.fields)}
    yield from _flow("    fields: ", fields)
    yield "  expect:"
    if receivers:
        yield f"    sent: {receivers[0] if len(receivers) == 1 else '[' + ', '.join(receivers) + ']'}"
    yield f"    published: {{{message.case}: unchanged}}"


def _flow(key: str, values: object) -> list[str]:
    """Return a key and its value in braces, on several lines if they are long."""
    text = yaml.safe_dump(values, default_flow_style=True, sort_keys=False, width=_WIDEST - _LONGEST_FIELD)
    first, *others = text.splitlines()
    return [key + first, *(" " * (len(key) + 1) + other.strip() for other in others)]


def _sample(type_name: str, place: int, site: Site) -> object:
    """Return a value that is never a default, and mostly differs from field to field."""
    if type_name in SCALARS:
        return _scalar(type_name == "bool", type_name in ("float", "double"), place)
    return _value(site.schema.enums.get(type_name) or site.schema.messages[type_name], place)


def _value(kind: Type, place: int) -> object:
    if isinstance(kind, Enum):
        return next((name for name, number in kind.values if number), kind.values[0][0])
    if isinstance(kind, MessageType):
        return {field.name: _value(field.type, index) for index, field in enumerate(kind.fields, place)}
    return _scalar(isinstance(kind, Bool), isinstance(kind, Float), place)


def _scalar(is_bool: bool, is_float: bool, place: int) -> object:
    return is_bool or place + (1.5 if is_float else 1)


def _protos(table: RouteTable) -> Collection[Path]:
    return {envelope.protos.value for envelope in table.envelopes.values()}


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")
