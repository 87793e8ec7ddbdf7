"""What tables refer to, read once however many tables are checked: `.proto` folders and ROS interfaces."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from router.table.model import EnvelopeSettings
from router.types.proto_folder import read_folder
from router.types.protobuf import ProtoSchema, load_protos, lock_path
from router.types.ros import RosInterfaces, ros_interfaces


class Definitions:
    """`known` are protos that were read before. They are what they were as long as the folder's files are."""

    def __init__(self, known: ProtoSchema | None = None) -> None:
        self._protos: dict[tuple[Path, str, Path], ProtoSchema] = {}
        self._known = known

    def protos(self, settings: EnvelopeSettings) -> ProtoSchema:
        """Raises TableError; a folder that is broken is read again, and reported, by every table."""
        key = settings.protos.value, settings.message.value, lock_path(settings)
        if key not in self._protos:
            self._protos[key] = self._unchanged(settings) or load_protos(settings)
        return self._protos[key]

    def _unchanged(self, settings: EnvelopeSettings) -> ProtoSchema | None:
        known = self._known
        if known is None or (known.root, known.lock) != (settings.protos.value.resolve(), lock_path(settings)):
            return None
        if settings.message.value not in (known.envelope, known.envelope.rpartition(".")[2]):
            return None
        return known if known.sha256 == read_folder(known.root, settings.protos.span).sha256 else None

    @cached_property
    def interfaces(self) -> RosInterfaces:
        return ros_interfaces()
