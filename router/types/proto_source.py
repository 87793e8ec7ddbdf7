"""Positions of messages, fields, enums and enum values in `.proto` files, and comments, from protoc's source info."""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Union

from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FileDescriptorProto

from router import inputs
from router.errors import SourceSpan, shown_path

_TAB_WIDTH = 8
_WORD = re.compile(rb'"[^"\n]*"?|[\w.]+|.')


class ProtoText:
    """The lines of a file, read on first use. protoc counts lines and columns from 0."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _lines(self) -> list[bytes]:
        return inputs.read_bytes(self.path).split(b"\n")

    def span(self, location: Sequence[int]) -> SourceSpan:
        """Return the span of a location of protoc's source info: line, column, [end line,] end column."""
        if len(location) == 3:
            return self._between(location[0], location[1], location[2])
        line = self._line(location[0])
        return self._between(location[0], location[1], _width(line.rstrip()))

    def word(self, line: int, column: int) -> SourceSpan:
        """Return the span of the name, number or sign that begins at a position."""
        text = self._line(line)
        start = _offset(text, column)
        word = _WORD.match(text, start)
        return self._span(line, start, word.end() if word else start)

    def before(self, line: int, column: int) -> str:
        """Return the text before a position on its line, without trailing whitespace."""
        text = self._line(line)
        return text[: _offset(text, column)].decode(errors="replace").rstrip()

    def _line(self, line: int) -> bytes:
        return self._lines[line] if line < len(self._lines) else b""

    def _between(self, line: int, start: int, end: int) -> SourceSpan:
        text = self._line(line)
        return self._span(line, _offset(text, start), _offset(text, end))

    def _span(self, line: int, start: int, end: int) -> SourceSpan:
        """Return a span from byte offsets, which differ from columns if the text is not ASCII."""
        text = self._line(line)
        first = len(text[:start].decode(errors="replace")) + 1
        return SourceSpan(shown_path(self.path), line + 1, first, first + len(text[start:end].decode(errors="replace")))


def _offset(text: bytes, column: int) -> int:
    """Return the byte offset of protoc's column: it counts bytes, but a tab advances to the next multiple of eight."""
    at = 0
    for offset, byte in enumerate(text):
        if at >= column:
            return offset
        at = at - at % _TAB_WIDTH + _TAB_WIDTH if byte == 0x09 else at + 1
    return len(text)


def _width(text: bytes) -> int:
    return len(text.expandtabs(_TAB_WIDTH))


_Path = tuple[int, ...]


class Part(enum.Enum):
    """The part of a declaration that a finding points at."""

    NAME = enum.auto()
    NUMBER = enum.auto()
    TYPE = enum.auto()


class _Place(NamedTuple):
    """A declaration: `parts` has the steps from `path` to its name, number and type, the likeliest first."""

    path: _Path
    parts: Mapping[Part, tuple[int, ...]]


# Field numbers of google/protobuf/descriptor.proto, which make up the paths of source info.
_FILE_MESSAGE, _FILE_ENUM, _FILE_EXTENSION = 4, 5, 7
_MESSAGE_FIELD, _MESSAGE_NESTED, _MESSAGE_ENUM, _MESSAGE_EXTENSION = 2, 3, 4, 6
_ENUM_VALUE = 2
_TYPE_PARTS = {Part.NAME: (1,)}
_FIELD_PARTS = {Part.NAME: (1,), Part.NUMBER: (3,), Part.TYPE: (6, 5)}
_VALUE_PARTS = {Part.NAME: (1,), Part.NUMBER: (2,)}


class ProtoSources:
    """Positions by full name: `PBEnvelope`, `PBEnvelope.imu_info`, `SensorState`, `SensorState.SENSOR_IDLE`.

    Unlike in protobuf, an enum's values are named below their enum. The source info of a file is kept serialized until
    a position in it is needed, which is rare: parsed, it takes ten times as much memory.
    """

    def __init__(self, files: Iterable[FileDescriptorProto], paths: Mapping[str, Path]) -> None:
        self._encoded: dict[str, bytes] = {}
        self._opened: dict[str, _File] = {}
        self._paths = paths
        self._holders: dict[str, str] = {}
        for file in files:
            self._encoded[file.name] = file.SerializeToString()
            names = [name for name, _, _ in holders(file)]
            extensions = [inside(file.package, extension.name) for extension in file.extension]
            self._holders |= dict.fromkeys([*names, *extensions], file.name)

    def file(self, name: str) -> str:
        """Return the file that declares a message or an enum, relative to the folder of the protos, with `/`."""
        return self._holders[name]

    def span(self, name: str, part: Part = Part.NAME) -> SourceSpan:
        """Return the span of a declaration, or of a part of it if it has that part."""
        file = self._holders.get(name) or self._holders[name.rpartition(".")[0]]
        if file not in self._opened:
            self._opened[file] = _File(FileDescriptorProto.FromString(self._encoded[file]), self._paths[file])
        return self._opened[file].span(name, part)

    def close(self) -> None:
        """Free the parsed source info. The next lookup parses it again."""
        self._opened.clear()


class _File:
    """The positions in one file."""

    def __init__(self, file: FileDescriptorProto, path: Path) -> None:
        self._text = ProtoText(path)
        self._locations = {tuple(location.path): tuple(location.span) for location in file.source_code_info.location}
        self._places: dict[str, _Place] = {}
        for name, place, declared in holders(file):
            self._places[name] = _Place(place, _TYPE_PARTS)
            if isinstance(declared, DescriptorProto):
                self._add(name, [field.name for field in declared.field], (*place, _MESSAGE_FIELD), _FIELD_PARTS)
                extensions = [extension.name for extension in declared.extension]
                self._add(name, extensions, (*place, _MESSAGE_EXTENSION), _FIELD_PARTS)
            else:
                self._add(name, [value.name for value in declared.value], (*place, _ENUM_VALUE), _VALUE_PARTS)
        self._add(file.package, [extension.name for extension in file.extension], (_FILE_EXTENSION,), _FIELD_PARTS)

    def _add(self, holder: str, names: Iterable[str], path: _Path, parts: Mapping[Part, tuple[int, ...]]) -> None:
        for index, name in enumerate(names):
            self._places[inside(holder, name)] = _Place((*path, index), parts)

    def span(self, name: str, part: Part) -> SourceSpan:
        place = self._places[name]
        for step in place.parts.get(part, (1,)):
            if (location := self._locations.get((*place.path, step))) is not None:
                return self._text.span(location)
        path = place.path
        while (around := self._locations.get(path)) is None:  # for example map entries, which are not in the text
            path = path[:-2]
        return self._text.span(around)


def field_comments(files: Iterable[FileDescriptorProto]) -> dict[str, str]:
    """Return the comments above and beside fields, each as one line, by full name; only for fields with comments."""
    by_field: dict[str, str] = {}
    for file in files:
        comments = {
            tuple(location.path): " ".join(f"{location.leading_comments} {location.trailing_comments}".split())
            for location in file.source_code_info.location
            if location.leading_comments or location.trailing_comments
        }
        for name, path, declared in holders(file):
            if isinstance(declared, DescriptorProto):
                for index, member in enumerate(declared.field):
                    if comment := comments.get((*path, _MESSAGE_FIELD, index)):
                        by_field[f"{name}.{member.name}"] = comment
    return by_field


def inside(holder: str, name: str) -> str:
    """Return the full name of a declaration in a message, an enum or a package, which may be empty."""
    return f"{holder}.{name}" if holder else name


Holder = tuple[str, _Path, Union[DescriptorProto, EnumDescriptorProto]]


def holders(file: FileDescriptorProto) -> Iterator[Holder]:
    """Yield the messages and enums of a file, nested ones included, each with its full name and path."""
    prefix = f"{file.package}." if file.package else ""
    for index, message in enumerate(file.message_type):
        yield from _within(message, prefix, (_FILE_MESSAGE, index))
    for index, declared in enumerate(file.enum_type):
        yield prefix + declared.name, (_FILE_ENUM, index), declared


def _within(message: DescriptorProto, prefix: str, path: _Path) -> Iterator[Holder]:
    name = prefix + message.name
    yield name, path, message
    for index, nested in enumerate(message.nested_type):
        yield from _within(nested, f"{name}.", (*path, _MESSAGE_NESTED, index))
    for index, declared in enumerate(message.enum_type):
        yield f"{name}.{declared.name}", (*path, _MESSAGE_ENUM, index), declared
