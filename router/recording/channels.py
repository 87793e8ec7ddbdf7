"""Schemas and channels of recordings. The files of one router use the same numbers for them.

A channel has the datagrams of one payload case from one sender to one listener with one decision of routing. These are
its metadata; together with a message's data they give the whole datagram (see `Holds`). Other channels have what the
router sent, and its other actions.
"""

from __future__ import annotations

import enum
from functools import lru_cache

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.records import Channel, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from router.datagrams import Peer
from router.table.addresses import Address
from router.types.protobuf import PayloadCase

DATAGRAMS = "raw/datagrams"
"""The topic of datagrams as received. No payload case can have a slash in its name."""

REJECTED = "rejected/{reason}/{topic}"
"""The topic of rejected datagrams, so that viewers do not mix them with accepted ones."""

SENT = "sent/{topic}"
"""The topic of payloads that the router sent."""

EVENTS = "router/events"
"""The topic of actions that sent nothing."""

MOST_CHANNELS = 4096
"""Beyond that, for example if a client often changes its port, datagrams are recorded raw."""


class Holds(enum.Enum):
    """The content of a channel's messages."""

    PAYLOAD = "payload"
    """Payloads of datagrams with one field, encoded as protobuf encodes it: tag and length follow from number and
    payload. With number 0 the datagram is the payload."""
    DATAGRAM = "datagram"
    """All other datagrams, byte for byte."""
    VIEW = "view"
    """Payloads of datagrams that are also recorded whole: for viewers, not for replay."""
    SENT = "sent"
    """Payloads that the router sent; not for replay."""
    EVENT = "event"
    """All other actions, as `Event`; not for replay."""


class Channels:
    """Assigns numbers to schemas and channels, the same number for the same content. Numbers are never reused."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._schema_ids: dict[tuple[str, bytes], int] = {}
        self._channel_ids: dict[tuple[object, ...], int] = {}

    def payload(self, case: PayloadCase, listener: str, peer: Peer, endpoint: str, reason: str) -> int | None:
        """Return the channel of a payload; None if there are too many. `endpoint`, `reason`: as in MirroredDatagram."""
        sender = {"listener": listener, "peer": str(Address(*peer)), "endpoint": endpoint}
        topic, metadata = _decided(case.name, {**_metadata(case, Holds.PAYLOAD), **sender}, reason)
        if len(self.channels) >= MOST_CHANNELS and self._key(topic, _payload(case), metadata) not in self._channel_ids:
            return None
        return self._channel(topic, _payload(case), metadata)

    def view(self, case: PayloadCase, reason: str) -> int:
        topic, metadata = _decided(case.name, _metadata(case, Holds.VIEW), reason)
        return self._channel(topic, _payload(case), metadata)

    def datagrams(self, message: Descriptor, label: str, reason: str) -> int:
        """Return the channel of whole datagrams. `label`: the name of their envelope, if `message` is for that only."""
        topic, metadata = _decided(_raw(label), _whole(Holds.DATAGRAM, label), reason)
        return self._channel(topic, message, metadata)

    def sent(
        self, case: PayloadCase, what: str, route: str, target: str, ros_topic: str, holds: Holds = Holds.SENT
    ) -> int:
        """Return the channel of payloads that were sent. The texts are those of an Action."""
        metadata = {**_metadata(case, holds), "what": what, "route": route, "endpoint": target, "ros": ros_topic}
        return self._channel(SENT.format(topic=case.name), _payload(case), metadata)

    def sent_datagrams(self, message: Descriptor, label: str) -> int:
        """Return the channel of whole datagrams that were sent, each as an Event."""
        return self._channel(SENT.format(topic=_raw(label)), message, _whole(Holds.EVENT, label))

    def events(self) -> int:
        return self._channel(EVENTS, EVENT, _whole(Holds.EVENT, ""))

    def _channel(self, topic: str, message: Descriptor, metadata: dict[str, str]) -> int:
        key = self._key(topic, message, metadata)
        if key not in self._channel_ids:
            number = self._channel_ids[key] = len(self.channels) + 1
            self.channels[number] = Channel(number, topic, MessageEncoding.Protobuf, metadata, self._schema(message))
        return self._channel_ids[key]

    def _key(self, topic: str, message: Descriptor, metadata: dict[str, str]) -> tuple[object, ...]:
        return topic, self._schema(message), *metadata.values()

    def _schema(self, message: Descriptor) -> int:
        key = (message.full_name, descriptor_set(message))
        if key not in self._schema_ids:
            number = self._schema_ids[key] = len(self.schemas) + 1
            self.schemas[number] = Schema(
                id=number, name=message.full_name, encoding=SchemaEncoding.Protobuf, data=key[1]
            )
        return self._schema_ids[key]


def _metadata(case: PayloadCase, holds: Holds) -> dict[str, str]:
    around = case.wrapping
    named = {"before": around.before.hex(), "after": around.after.hex()} if around.before or around.after else {}
    shared = {"shared": "1"} if around.is_shared else {}
    of = {"envelope": case.envelope} if case.envelope else {}
    return {"holds": holds.value, "number": str(around.tag >> 3), **named, **shared, **of}


def _raw(label: str) -> str:
    """Return the topic of whole datagrams, which is one for each schema."""
    return f"{DATAGRAMS}/{label}" if label else DATAGRAMS


def _whole(holds: Holds, label: str) -> dict[str, str]:
    return {"holds": holds.value, **({"envelope": label} if label else {})}


def _decided(topic: str, metadata: dict[str, str], reason: str) -> tuple[str, dict[str, str]]:
    """Return topic and metadata, changed for rejected datagrams if there is a `reason`."""
    if not reason:
        return topic, metadata
    return REJECTED.format(reason=reason, topic=topic), {**metadata, "reason": reason}


def _payload(case: PayloadCase) -> Descriptor:
    return case.message_class.DESCRIPTOR  # type: ignore[return-value]  # or upb's, which is the same


@lru_cache(256)
def descriptor_set(message: Descriptor) -> bytes:
    """Return a serialized FileDescriptorSet: the file of a message, preceded by its imports."""
    files: dict[str, bytes] = {}
    collect(message.file, files)
    return FileDescriptorSet(file=[FileDescriptorProto.FromString(data) for data in files.values()]).SerializeToString()


def collect(file: FileDescriptor, into: dict[str, bytes]) -> None:
    """Add a file, preceded by its imports, by name."""
    for imported in file.dependencies:
        collect(imported, into)
    into.setdefault(file.name, file.serialized_pb)


def _own_message(name: str, **fields: FieldDescriptorProto.Type.ValueType) -> Descriptor:
    """Return a message of ours, with its fields in order."""
    file = FileDescriptorProto(name=f"rover_router/{name.lower()}.proto", package="rover_router", syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields.items(), 1):
        message.field.add(name=field, number=number, type=kind, label=FieldDescriptorProto.LABEL_OPTIONAL)
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return pool.FindMessageTypeByName(f"rover_router.{name}")


_TEXT, _BYTES = FieldDescriptorProto.TYPE_STRING, FieldDescriptorProto.TYPE_BYTES

DATAGRAM = _own_message("Datagram", listener=_TEXT, peer=_TEXT, data=_BYTES, endpoint=_TEXT)
Datagram = GetMessageClass(DATAGRAM)
"""`peer` is HOST:PORT, as `Address` writes it, `data` the bytes as received, `endpoint` the sender's name in the table.

Like an Event, it may have a field `envelope` (see `Whole`).
"""

EVENT = _own_message(
    "Event", what=_TEXT, route=_TEXT, endpoint=_TEXT, ros=_TEXT, reason=_TEXT, detail=_TEXT, data=_BYTES
)
Event = GetMessageClass(EVENT)
"""The fields of an Action: `endpoint` is its target, `ros` its topic. `data` is a datagram that was not sent."""
