"""Places in `.proto` files: of every message, field, enum and enum value, and the comment beside it.

Made of protoc's source info.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FileDescriptorProto, SourceCodeInfo

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

    file: str
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

    An enum's values are named below their enum here, which is not protobuf's own scoping.
    """

    def __init__(self, files: Iterable[FileDescriptorProto], paths: Mapping[str, Path]) -> None:
        self._files = {file.name: file for file in files}
        self._texts = {name: ProtoText(path) for name, path in paths.items()}
        self._locations: dict[str, dict[_Path, SourceCodeInfo.Location]] = {}
        self._places: dict[str, _Place] = {}
        for file in self._files.values():
            self._add_file(file)

    def file(self, name: str) -> str:
        """The file that declares `name`, relative to the folder of the protos, with `/`."""
        return self._places[name].file

    def span(self, name: str, part: Part = Part.NAME) -> SourceSpan:
        """The place of a declaration, or of a part of it where it has that part."""
        place = self._places[name]
        for step in place.parts.get(part, (1,)):
            if (location := self._location(place.file, (*place.path, step))) is not None:
                return self._texts[place.file].span(location.span)
        path = place.path
        while (around := self._location(place.file, path)) is None:  # as for the entries of a map, written nowhere
            path = path[:-2]
        return self._texts[place.file].span(around.span)

    def comment(self, name: str) -> str:
        """The comment above and beside a declaration, as one line; empty where there is none."""
        place = self._places[name]
        location = self._location(place.file, place.path)
        if location is None:
            return ""
        return " ".join(f"{location.leading_comments} {location.trailing_comments}".split())

    def _location(self, file: str, path: _Path) -> SourceCodeInfo.Location | None:
        if file not in self._locations:
            self._locations[file] = {
                tuple(location.path): location for location in self._files[file].source_code_info.location
            }
        return self._locations[file].get(path)

    def _add_file(self, file: FileDescriptorProto) -> None:
        prefix = f"{file.package}." if file.package else ""
        for index, message in enumerate(file.message_type):
            self._add_message(file.name, (_FILE_MESSAGE, index), prefix, message)
        for index, declared in enumerate(file.enum_type):
            self._add_enum(file.name, (_FILE_ENUM, index), prefix, declared)

    def _add_message(self, file: str, path: _Path, prefix: str, message: DescriptorProto) -> None:
        name = prefix + message.name
        self._places[name] = _Place(file, path, _TYPE_PARTS)
        for index, member in enumerate(message.field):
            self._places[f"{name}.{member.name}"] = _Place(file, (*path, _MESSAGE_FIELD, index), _FIELD_PARTS)
        for index, nested in enumerate(message.nested_type):
            self._add_message(file, (*path, _MESSAGE_NESTED, index), f"{name}.", nested)
        for index, declared in enumerate(message.enum_type):
            self._add_enum(file, (*path, _MESSAGE_ENUM, index), f"{name}.", declared)

    def _add_enum(self, file: str, path: _Path, prefix: str, declared: EnumDescriptorProto) -> None:
        name = prefix + declared.name
        self._places[name] = _Place(file, path, _TYPE_PARTS)
        for index, value in enumerate(declared.value):
            self._places[f"{name}.{value.name}"] = _Place(file, (*path, _ENUM_VALUE, index), _VALUE_PARTS)
