"""Where every message, field, enum and enum value stands in its `.proto` file, and the comment beside it.

Made of protoc's source info; knows nothing of the type model.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FileDescriptorProto, SourceCodeInfo

from router.errors import SourceSpan
from router.types.proto_text import ProtoText

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

    def __contains__(self, name: str) -> bool:
        return name in self._places

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
