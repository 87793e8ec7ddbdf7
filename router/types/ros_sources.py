"""Where ROS message definitions come from: our own folder, installed packages, those inside rosbags.

Hands on one unresolved definition at a time and reads no more than it is asked for.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from router.assets import asset, is_installed
from router.errors import Code, Diagnostic, SourceSpan, TableError, shown_path
from router.types.model import String
from router.types.msg_text import PRIMITIVES, MsgDefinition, MsgError, MsgField, NamedType, Shape, parse_msg

_TYPE_NAME = re.compile(r"(?P<package>[a-z]\w*)/msg/(?P<name>[A-Z]\w*)", re.ASCII)
_PLACEHOLDER = "structure_needs_at_least_one_member"

DEFAULTS_MISSING_IN_ROSBAGS: dict[tuple[str, str], object] = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): -2,
}
"""rosbags keeps no default values; these are all of Jazzy's common interfaces that differ from zero."""


@dataclass(frozen=True, slots=True)
class FoundDefinition:
    """`file` is where it was found: a `.msg` file, or the name of the rosbags module."""

    file: str
    definition: MsgDefinition


class MsgFiles:
    """The `.msg` files of installed packages: `share/<package>/msg/<Name>.msg` below each of `folders`."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = folders

    def find(self, name: str) -> FoundDefinition | None:
        """By full name, `sensor_msgs/msg/Imu`. Raises TableError for a file that is no definition."""
        parts = _TYPE_NAME.fullmatch(name)
        if parts is None:
            return None
        for folder in self._folders:
            path = folder / parts["package"] / "msg" / f"{parts['name']}.msg"
            if path.is_file():
                return _read(path, parts["package"])
        return None

    def names(self) -> Iterator[str]:
        for folder in self._folders:
            for path in folder.glob("*/msg/*.msg"):
                yield f"{path.parent.parent.name}/msg/{path.stem}"


def msg_files() -> MsgFiles:
    """Every prefix of the sourced workspaces, then the environment that Python runs in.

    Ours come first in a checkout, where they are edited and then built, and last in an installation, where a team's own
    copy of them is what it edits and builds.
    """
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    shares = [Path(prefix, "share") for prefix in prefixes]
    ours = asset("schemas")
    return MsgFiles([*shares, ours] if is_installed(ours) else [ours, *shares])


def _read(path: Path, package: str) -> FoundDefinition:
    try:
        return FoundDefinition(shown_path(path), parse_msg(package, path.read_text(encoding="utf-8")))
    except MsgError as error:
        span = SourceSpan(shown_path(path), error.line, error.column, error.end_column)
        raise TableError([Diagnostic(span, Code.BAD_FILE, error.message)]) from None
    except (OSError, UnicodeDecodeError) as error:
        finding = Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, f"cannot be read: {error}")
        raise TableError([finding]) from None


class RosbagsDefinitions:
    """The interfaces of Jazzy as the rosbags package carries them, for machines without ROS.

    Imported when first asked, because that takes 0.1 s. Only their data is used: building a typestore
    out of them takes longer, and loses what a `byte` is.
    """

    def __init__(self) -> None:
        self._loaded: dict[str, Any] | None = None

    @property
    def _definitions(self) -> dict[str, Any]:
        if self._loaded is None:
            from rosbags.typesys.stores.ros2_jazzy import FIELDDEFS

            self._loaded = FIELDDEFS
        return self._loaded

    def find(self, name: str) -> FoundDefinition | None:
        if name not in self._definitions:
            return None
        constants, fields = self._definitions[name]
        return FoundDefinition(
            "<rosbags>",
            MsgDefinition(
                tuple(_rosbags_field(name, field, node) for field, node in fields if field != _PLACEHOLDER),
                {constant: value for constant, _, value in constants},
            ),
        )

    def names(self) -> Iterator[str]:
        yield from self._definitions


def _rosbags_field(message: str, name: str, node: Any) -> MsgField:
    """A node is (kind, content): BASE (name, bound), NAME full name, ARRAY and SEQUENCE (node, size), 0 for none."""
    kind, content = node
    shape = None
    if kind.name in ("ARRAY", "SEQUENCE"):
        (inner, content), size = content
        shape = Shape(length=size) if kind.name == "ARRAY" else Shape(bound=size or None)
        kind = inner
    default = DEFAULTS_MISSING_IN_ROSBAGS.get((message, name))
    if kind.name == "NAME":
        return MsgField(name, NamedType(content.replace("/msg/", "/")), shape)
    base, bound = content
    return MsgField(name, String(bound or None) if base == "string" else PRIMITIVES[base], shape, default)
