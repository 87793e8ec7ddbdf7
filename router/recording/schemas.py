"""The protobuf descriptors that a recording has inside, so that whoever opens it needs no `.proto` file.

Knows descriptors, and no file.
"""

from __future__ import annotations

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass


def descriptor_set(message: Descriptor) -> bytes:
    """The file of a message and all that it imports, each behind what it imports itself: a FileDescriptorSet."""
    files: dict[str, bytes] = {}
    _collect(message.file, files)
    return FileDescriptorSet(file=[FileDescriptorProto.FromString(data) for data in files.values()]).SerializeToString()


def _collect(file: FileDescriptor, into: dict[str, bytes]) -> None:
    for imported in file.dependencies:
        _collect(imported, into)
    into.setdefault(file.name, file.serialized_pb)


def _datagram() -> Descriptor:
    """What a datagram is recorded as that is more, or less, than a payload in an envelope."""
    file = FileDescriptorProto(name="rover_router/datagram.proto", package="rover_router", syntax="proto3")
    message = file.message_type.add(name="Datagram")
    for number, (name, kind) in enumerate(
        (
            ("listener", FieldDescriptorProto.TYPE_STRING),
            ("peer", FieldDescriptorProto.TYPE_STRING),
            ("data", FieldDescriptorProto.TYPE_BYTES),
            ("endpoint", FieldDescriptorProto.TYPE_STRING),
        ),
        1,
    ):
        message.field.add(name=name, number=number, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return pool.FindMessageTypeByName("rover_router.Datagram")


DATAGRAM = _datagram()
Datagram = GetMessageClass(DATAGRAM)
"""`listener` by its name, `peer` as HOST:PORT, `data` as received, `endpoint` as the table calls the sender."""
