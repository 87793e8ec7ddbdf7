"""The ROS side of the type model: message types by name, with or without ROS on the machine.

Definitions are read one at a time, on first use: from our own folder, from installed packages, and from the rosbags
package.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from router import inputs
from router.assets import asset, is_installed
from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean, shown_path
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type
from router.types.msg import PRIMITIVES, MsgDefinition, MsgError, parse_msg

_TYPE_NAME = re.compile(r"(?P<package>[a-z]\w*)/msg/(?P<name>[A-Z]\w*)", re.ASCII)
_HALF_NAME = re.compile(r"(?P<package>[a-z]\w*)/srv/(?P<name>[A-Z]\w*)_(?P<half>Request|Response)", re.ASCII)
_HALVES = ("Request", "Response")
_PLACEHOLDER = "structure_needs_at_least_one_member"

IGNORED = "COLCON_IGNORE"
"""A file in the folder of a package that colcon, `make setup` and the router ignore."""

DEFAULTS_MISSING_IN_ROSBAGS: dict[tuple[str, str], object] = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
}
"""All default values of Jazzy's common interfaces that differ from zero: rosbags does not keep them."""


@dataclass(frozen=True, slots=True)
class FoundDefinition:
    """A definition and its `file`: a `.msg` file, or the name of the rosbags module."""

    file: str
    definition: MsgDefinition


STD_SRVS: Mapping[str, str] = {
    "Empty": "---\n",
    "SetBool": "bool data\n---\nbool success\nstring message\n",
    "Trigger": "---\nbool success\nstring message\n",
}
"""The services of the package std_srvs, for machines without ROS: rosbags has messages only."""


class MsgFiles:
    """The definitions of installed packages, below each of `folders`.

    They are `share/<package>/msg/<Name>.msg`, and `share/<package>/srv/<Name>.srv`, which has two messages.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = folders

    def find(self, name: str) -> FoundDefinition | None:
        """Find a definition by full name: `sensor_msgs/msg/Imu`, or `std_srvs/srv/SetBool_Request`.

        Raises TableError for an invalid file.
        """
        if parts := _TYPE_NAME.fullmatch(name):
            path = self._file(parts["package"], "msg", parts["name"])
            return _read(path, parts["package"]) if path else None
        if parts := _HALF_NAME.fullmatch(name):
            path = self._file(parts["package"], "srv", parts["name"])
            if path is not None:
                return _read(path, parts["package"], parts["half"])
            if parts["package"] == "std_srvs" and parts["name"] in STD_SRVS:
                text = _half(STD_SRVS[parts["name"]], parts["half"])
                return FoundDefinition("<std_srvs>", parse_msg("std_srvs", text))
        return None

    def _file(self, package: str, kind: str, name: str) -> Path | None:
        for folder in self._folders:
            path = folder / package / kind / f"{name}.{kind}"
            if inputs.is_file(path) and not inputs.exists(folder / package / IGNORED):
                return path
        return None

    def names(self, kind: str = "msg") -> Iterator[str]:
        """Yield the names of all messages, or of all services (`srv`)."""
        for folder in self._folders:
            packages = inputs.listing(folder)[0]
            for package in (name for name in packages if not inputs.exists(folder / name / IGNORED)):
                for file in inputs.listing(folder / package / kind)[1]:
                    name, _, ending = file.rpartition(".")
                    if ending == kind:
                        yield f"{package}/{kind}/{name}"
        if kind == "srv":
            yield from (f"std_srvs/srv/{name}" for name in STD_SRVS)


def msg_files() -> MsgFiles:
    """Return the files of all sourced workspaces, then of Python's environment.

    Our own files come first in a checkout, where they are edited and then built, and last in an installation, where a
    team edits and builds its own copy.
    """
    prefixes = [*filter(None, inputs.ENVIRONMENT.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    shares = [Path(prefix, "share") for prefix in prefixes]
    ours = asset("schemas")
    return MsgFiles([*shares, ours] if is_installed(ours) else [ours, *shares])


def _half(text: str, half: str) -> str:
    """Return the request or the response of a service. The response keeps the numbers of its lines."""
    lines = text.splitlines()
    between = next((number for number, line in enumerate(lines) if line.strip() == "---"), len(lines))
    return "\n".join(lines[:between] if half == "Request" else ["#"] * (between + 1) + lines[between + 1 :])


def _read(path: Path, package: str, half: str = "") -> FoundDefinition:
    """Read a message, or `half` of a service. Raises TableError for an invalid file."""
    try:
        text = inputs.read_text(path)
        return FoundDefinition(shown_path(path), parse_msg(package, _half(text, half) if half else text))
    except MsgError as error:
        span = SourceSpan(shown_path(path), error.line, error.column, error.end_column)
        raise TableError.of(span, Code.BAD_FILE, error.message) from None
    except (OSError, UnicodeDecodeError) as error:
        finding = Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, f"the file cannot be read: {error}")
        raise TableError([finding]) from None


class RosbagsDefinitions:
    """The interfaces of Jazzy from the rosbags package, for machines without ROS.

    Imported on first use, because that takes 0.1 s. Only the data is used: building a typestore takes longer and does
    not distinguish `byte`.
    """

    @cached_property
    def _definitions(self) -> dict[str, Any]:
        from rosbags.typesys.stores.ros2_jazzy import FIELDDEFS

        return FIELDDEFS

    def find(self, name: str) -> FoundDefinition | None:
        if name not in self._definitions:
            return None
        constants, fields = self._definitions[name]
        return FoundDefinition(
            "<rosbags>",
            MsgDefinition(
                tuple(_rosbags_field(name, field, node) for field, node in fields if field != _PLACEHOLDER),
                {constant: value for constant, _, value in constants},
                {},
            ),
        )

    def names(self) -> Iterator[str]:
        yield from self._definitions


def _rosbags_field(message: str, name: str, node: Any) -> Field:
    return Field(name, _rosbags_type(node), default=DEFAULTS_MISSING_IN_ROSBAGS.get((message, name)))


def _rosbags_type(node: Any) -> Type:
    """Convert a node (kind, content): BASE (name, bound), NAME full name, ARRAY and SEQUENCE (node, size or 0)."""
    kind, content = node
    if kind.name == "ARRAY":
        return List(_rosbags_type(content[0]), length=content[1])
    if kind.name == "SEQUENCE":
        return List(_rosbags_type(content[0]), bound=content[1] or None)
    if kind.name == "NAME":
        return MessageType(content)
    base, bound = content
    return String(bound or None) if base == "string" else PRIMITIVES[base]


class RosInterfaces:
    """Message types by full name (`sensor_msgs/msg/Imu`), each read on first use.

    A message without fields also has none in the model; in CDR, ROS adds one uint8.
    """

    def __init__(self, files: MsgFiles, rosbags: RosbagsDefinitions) -> None:
        self._files = files
        self._rosbags = rosbags
        self._known: dict[str, MessageType | None] = {}

    def get(self, name: str) -> MessageType | None:
        """Return a type with all nested types, None if it does not exist.

        Raises TableError at the `.msg` file if a definition cannot be read, contains itself or refers to a type that
        does not exist.
        """
        return self._get(name, ())

    def service(self, name: str) -> tuple[MessageType, MessageType] | None:
        """Return the request and the response of `std_srvs/srv/SetBool`, None if it does not exist.

        Raises TableError as `get` does.
        """
        request, response = (self.get(f"{name}_{half}") for half in _HALVES)
        return (request, response) if request is not None and response is not None else None

    def names(self) -> Collection[str]:
        """Return every name of a message that `get` accepts, for hints. Slow: lists folders."""
        return {*self._files.names(), *self._rosbags.names()}

    def services(self) -> Collection[str]:
        """Return every name that `service` accepts, likewise."""
        return {*self._files.names("srv")}

    def _get(self, name: str, inside: tuple[str, ...]) -> MessageType | None:
        if name not in self._known:
            found = self._files.find(name) or self._rosbags.find(name)
            self._known[name] = self._resolved(name, found, inside) if found is not None else None
        return self._known[name]

    def _resolved(self, name: str, found: FoundDefinition, inside: tuple[str, ...]) -> MessageType:
        definition, inside = found.definition, (*inside, name)
        fields = []
        for field in definition.fields:
            span = SourceSpan(found.file, definition.lines.get(field.name, 1))
            fields.append(replace(field, type=self._known_type(field.type, span, inside)))
        return MessageType(name, fields=tuple(fields), constants=definition.constants)

    def _known_type(self, declared: Type, span: SourceSpan, inside: tuple[str, ...]) -> Type:
        if isinstance(declared, List):
            return replace(declared, element=self._known_type(declared.element, span, inside))
        return self._nested(declared.name, span, inside) if isinstance(declared, MessageType) else declared

    def _nested(self, name: str, span: SourceSpan, inside: tuple[str, ...]) -> MessageType:
        if name in inside:
            chain = " > ".join([*inside[inside.index(name) :], name])
            raise TableError.of(span, Code.BAD_FILE, f"{name} contains itself: {chain}")
        nested = self._get(name, inside)
        if nested is None:
            message = f"there is no ROS message type '{name}'"
            raise TableError.of(span, Code.UNKNOWN_ROS_TYPE, message, did_you_mean(name, self.names()))
        return nested


def ros_interfaces() -> RosInterfaces:
    """Return the interfaces of this machine and this repository."""
    return RosInterfaces(msg_files(), RosbagsDefinitions())


def definition(message: MessageType) -> tuple[tuple[str, str], ...]:
    """Return field names and types as rclpy's `get_fields_and_field_types()` spells them."""
    return tuple((field.name, _spelled(field.type)) for field in message.fields)


def _spelled(type_: Type) -> str:
    if isinstance(type_, List):
        element = _spelled(type_.element)
        if type_.length is not None:
            return f"{element}[{type_.length}]"
        return f"sequence<{element}{f', {type_.bound}' if type_.bound is not None else ''}>"
    if isinstance(type_, Bool):
        return "boolean"
    if isinstance(type_, Float):
        return "float" if type_.bits == 32 else "double"
    if isinstance(type_, Int):
        return "octet" if type_.octet else str(type_)
    if isinstance(type_, String):
        return ("wstring" if type_.wide else "string") + (f"<{type_.bound}>" if type_.bound is not None else "")
    if not isinstance(type_, MessageType):
        raise TypeError(f"ROS has no type {type_}")
    package, _, rest = type_.name.partition("/")
    return f"{package}/{rest.rpartition('/')[2]}"  # without `msg`, `srv` or `action`
