"""What tables refer to, read once however many tables are checked: `.proto` folders and ROS interfaces."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from router.errors import SourceSpan
from router.types.protobuf import ProtoSchema, load_protos
from router.types.ros import RosInterfaces, ros_interfaces


class Definitions:
    def __init__(self) -> None:
        self._protos: dict[Path, ProtoSchema] = {}

    def protos(self, root: Path, blame: SourceSpan) -> ProtoSchema:
        """Raises TableError; a folder that is broken is read again, and reported, by every table."""
        if root not in self._protos:
            self._protos[root] = load_protos(root, blame)
        return self._protos[root]

    @cached_property
    def interfaces(self) -> RosInterfaces:
        return ros_interfaces()
