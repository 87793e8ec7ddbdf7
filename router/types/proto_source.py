"""Places in `.proto` files: of every message, field, enum and enum value, and the comment beside it.

Made of protoc's source info.
"""

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
    """The lines of a file, read when first needed. protoc counts lines and columns from 0."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def _lines(self) -> list[bytes]:
        return inputs.read_bytes(self.path).split(b"\n")

    def span(self, location: Sequence[int]) -> SourceSpan:
        """A location of protoc's source info: line, column, end column, or with the end's line as third."""
        if len(location) == 3:
            return self._between(location[0], location[1], location[2])
        line = self._line(location[0])
        return self._between(location[0], location[1], _width(line.rstrip()))

    def word(self, line: int, column: int) -> SourceSpan:
        """The name, number or sign that begins at the place."""
        text = self._line(line)
        start = _offset(text, column)
        word = _WORD.match(text, start)
        return self._span(line, start, word.end() if word else start)

    def before(self, line: int, column: int) -> str:
        """What stands before the place on its line, without blanks at its end."""
        text = self._line(line)
        return text[: _offset(text, column)].decode(errors="replace").rstrip()

    def _line(self, line: int) -> bytes:
        return self._lines[line] if line < len(self._lines) else b""

    def _between(self, line: int, start: int, end: int) -> SourceSpan:
        text = self._line(line)
        return self._span(line, _offset(text, start), _offset(text, end))

    def _span(self, line: int, start: int, end: int) -> SourceSpan:
        """From byte offsets, which are not columns where the text is not ASCII."""
        text = self._line(line)
        first = len(text[:start].decode(errors="replace")) + 1
        return SourceSpan(shown_path(self.path), line + 1, first, first + len(text[start:end].decode(errors="replace")))


def _offset(text: bytes, column: int) -> int:
    """The byte at protoc's column: it counts bytes, but a tab goes on to the next multiple of eight."""
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
    """What of a declaration a finding blames."""

    NAME = enum.auto()
    NUMBER = enum.auto()
    TYPE = enum.auto()


class _Place(NamedTuple):
    """`parts` holds the steps from `path` to the name, the number and the type, the likeliest first."""

    path: _Path
    parts: Mapping[Part, tuple[int, ...]]


# Field numbers of google/protobuf/descriptor.proto, of which source info's paths consist.
_FILE_MESSAGE, _FILE_ENUM = 4, 5
_MESSAGE_FIELD, _MESSAGE_NESTED, _MESSAGE_ENUM = 2, 3, 4
_ENUM_VALUE = 2
_TYPE_PARTS = {Part.NAME: (1,)}
_FIELD_PARTS = {Part.NAME: (1,), Part.NUMBER: (3,), Part.TYPE: (6, 5)}
_VALUE_PARTS = {Part.NAME: (1,), Part.NUMBER: (2,)}


class ProtoSources:
    """Asked by full name: `PBEnvelope`, `PBEnvelope.imu_info`, `SensorState`, `SensorState.SENSOR_IDLE`.

    An enum's values are named below their enum here, which is not protobuf's own scoping. What protoc says of a file is
    kept as its bytes until a place in it is asked for, as it seldom is, and takes ten times as much memory then.
    """

    def __init__(self, files: Iterable[FileDescriptorProto], paths: Mapping[str, Path]) -> None:
        self._encoded: dict[str, bytes] = {}
        self._opened: dict[str, _File] = {}
        self._paths = paths
        self._holders: dict[str, str] = {}
        for file in files:
            self._encoded[file.name] = file.SerializeToString()
            self._holders |= dict.fromkeys((name for name, _, _ in _holders(file)), file.name)

    def file(self, name: str) -> str:
        """The file that declares a message or an enum, relative to the folder of the protos, with `/`."""
        return self._holders[name]

    def span(self, name: str, part: Part = Part.NAME) -> SourceSpan:
        """The place of a declaration, or of a part of it where it has that part."""
        file = self._holders.get(name) or self._holders[name.rpartition(".")[0]]
        if file not in self._opened:
            self._opened[file] = _File(FileDescriptorProto.FromString(self._encoded[file]), self._paths[file])
        return self._opened[file].span(name, part)


class _File:
    """The places in one file."""

    def __init__(self, file: FileDescriptorProto, path: Path) -> None:
        self._text = ProtoText(path)
        self._locations = {tuple(each.path): tuple(each.span) for each in file.source_code_info.location}
        self._places: dict[str, _Place] = {}
        for name, place, declared in _holders(file):
            self._places[name] = _Place(place, _TYPE_PARTS)
            if isinstance(declared, DescriptorProto):
                self._add(name, [each.name for each in declared.field], (*place, _MESSAGE_FIELD), _FIELD_PARTS)
            else:
                self._add(name, [each.name for each in declared.value], (*place, _ENUM_VALUE), _VALUE_PARTS)

    def _add(self, holder: str, names: Iterable[str], path: _Path, parts: Mapping[Part, tuple[int, ...]]) -> None:
        for index, name in enumerate(names):
            self._places[f"{holder}.{name}"] = _Place((*path, index), parts)

    def span(self, name: str, part: Part) -> SourceSpan:
        place = self._places[name]
        for step in place.parts.get(part, (1,)):
            if (location := self._locations.get((*place.path, step))) is not None:
                return self._text.span(location)
        path = place.path
        while (around := self._locations.get(path)) is None:  # as for the entries of a map, written nowhere
            path = path[:-2]
        return self._text.span(around)


def field_comments(files: Iterable[FileDescriptorProto]) -> dict[str, str]:
    """The comments above and beside fields, each as one line, by full name. Fields without one are left out."""
    found: dict[str, str] = {}
    for file in files:
        comments = {
            tuple(each.path): " ".join(f"{each.leading_comments} {each.trailing_comments}".split())
            for each in file.source_code_info.location
            if each.leading_comments or each.trailing_comments
        }
        for name, path, declared in _holders(file):
            if isinstance(declared, DescriptorProto):
                for index, member in enumerate(declared.field):
                    if comment := comments.get((*path, _MESSAGE_FIELD, index)):
                        found[f"{name}.{member.name}"] = comment
    return found


_Holder = tuple[str, _Path, Union[DescriptorProto, EnumDescriptorProto]]


def _holders(file: FileDescriptorProto) -> Iterator[_Holder]:
    """The messages and enums of a file, nested ones too, each with its full name and path."""
    prefix = f"{file.package}." if file.package else ""
    for index, message in enumerate(file.message_type):
        yield from _within(message, prefix, (_FILE_MESSAGE, index))
    for index, declared in enumerate(file.enum_type):
        yield prefix + declared.name, (_FILE_ENUM, index), declared


def _within(message: DescriptorProto, prefix: str, path: _Path) -> Iterator[_Holder]:
    name = prefix + message.name
    yield name, path, message
    for index, nested in enumerate(message.nested_type):
        yield from _within(nested, f"{name}.", (*path, _MESSAGE_NESTED, index))
    for index, declared in enumerate(message.enum_type):
        yield f"{name}.{declared.name}", (*path, _MESSAGE_ENUM, index), declared
