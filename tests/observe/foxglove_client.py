"""A client like the Foxglove app: it knows the WebSocket protocol, and decodes messages by the advertised schemas."""

from __future__ import annotations

import base64
import json
import struct
from contextlib import ExitStack
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from websockets.sync.client import connect

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1
_HEAD = struct.Struct("<BIQ")
PATIENCE = 20.0


class Told(NamedTuple):
    """One message: topic, log time (ns), bytes, and the value decoded by the channel's schema."""

    topic: str
    log_time: int
    data: bytes
    message: Message


class FoxgloveClient:
    """`with FoxgloveClient(port) as client:`; `channels` are the channels advertised so far, by topic."""

    def __init__(self, port: int) -> None:
        self._open = ExitStack()
        opening = connect(f"ws://127.0.0.1:{port}", subprotocols=[SUBPROTOCOL])  # type: ignore[list-item]
        self._socket = self._open.enter_context(opening)
        self.channels: dict[str, dict[str, Any]] = {}
        self.info: dict[str, Any] = {}
        self._topics: dict[int, str] = {}  # by subscription
        while not self.channels:
            self._hear()

    def __enter__(self) -> FoxgloveClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def subscribe(self, *topics: str) -> None:
        subscriptions = []
        for topic in topics:
            number = len(self._topics) + 100
            self._topics[number] = topic
            subscriptions.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def unsubscribe(self, *topics: str) -> None:
        numbers = [number for number, topic in self._topics.items() if topic in topics]
        self._socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": numbers}))

    def receive(self, timeout: float = PATIENCE) -> Told:
        """Wait for the next message. Raises TimeoutError."""
        while (told := self._hear(timeout)) is None:
            pass
        return told

    def await_change(self) -> None:
        """Wait until channels are advertised or removed."""
        before = {topic: channel["id"] for topic, channel in self.channels.items()}
        while {topic: channel["id"] for topic, channel in self.channels.items()} == before:
            self._hear()

    def _hear(self, timeout: float = PATIENCE) -> Told | None:
        heard = self._socket.recv(timeout)
        if isinstance(heard, bytes):
            kind, subscription, log_time = _HEAD.unpack_from(heard)
            assert kind == MESSAGE_DATA
            topic, data = self._topics[subscription], heard[_HEAD.size :]
            return Told(topic, log_time, data, self._decoded(topic, data))
        said = json.loads(heard)
        if said["op"] == "serverInfo":
            self.info = said
        elif said["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        elif said["op"] == "unadvertise":
            self.channels = {
                topic: channel for topic, channel in self.channels.items() if channel["id"] not in said["channelIds"]
            }
        return None

    def _decoded(self, topic: str, data: bytes) -> Message:
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("protobuf", "protobuf")
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString(data)
