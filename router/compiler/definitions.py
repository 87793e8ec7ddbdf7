"""What tables refer to, read once however many tables are checked: `.proto` folders and ROS interfaces."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from router.errors import SourceSpan
from router.types.proto_folder import folder_sha256
from router.types.protobuf import ProtoSchema, load_protos
from router.types.ros import RosInterfaces, ros_interfaces


class Definitions:
    """`known` is a folder that was read before. It is what it was as long as its files are."""

    def __init__(self, known: ProtoSchema | None = None) -> None:
        self._protos: dict[Path, ProtoSchema] = {}
        self._known = known

    def protos(self, root: Path, blame: SourceSpan) -> ProtoSchema:
        """Raises TableError; a folder that is broken is read again, and reported, by every table."""
        if root not in self._protos:
            self._protos[root] = self._unchanged(root, blame) or load_protos(root, blame)
        return self._protos[root]

    def _unchanged(self, root: Path, blame: SourceSpan) -> ProtoSchema | None:
        known = self._known
        if known is None or known.root != root.resolve() or known.sha256 != folder_sha256(root, blame):
            return None
        return known

    @cached_property
    def interfaces(self) -> RosInterfaces:
        return ros_interfaces()
