"""ROS messages as they came in, and their JSON, which is made once for all gateways that send it."""

from __future__ import annotations

from typing import Any

from router.gateway.json_codec import Encode, encoder
from router.gateway.json_types import Style, schema_text
from router.gateway.packets import compress
from router.types.model import MessageType


class ReadyType:
    """A message type that can be received: its definition, its class for rclpy, its schema as JSON."""

    def __init__(self, message: MessageType, message_class: Any) -> None:
        self.message = message
        self.message_class = message_class
        self.schema = schema_text(message)
        self._encoders: dict[Style, Encode] = {}

    def text(self, style: Style, cdr: bytes) -> bytes:
        """Raises UnreadableError."""
        if (encode := self._encoders.get(style)) is None:
            encode = self._encoders[style] = encoder(self.message, style)
        return encode(cdr)


class Sample:
    """One message. `sent_ns` is the wall clock when it set out. Any thread may convert it; each form is made once."""

    __slots__ = ("_payloads", "_texts", "_type", "cdr", "sent_ns", "topic")

    def __init__(self, topic: str, ready: ReadyType, cdr: bytes, sent_ns: int) -> None:
        self.topic = topic
        self.cdr = cdr
        self.sent_ns = sent_ns
        self._type = ready
        self._texts: dict[Style, bytes] = {}
        self._payloads: dict[tuple[Style, int], bytes] = {}

    @property
    def type_name(self) -> str:
        return self._type.message.name

    def text(self, style: Style) -> bytes:
        """As JSON in UTF-8. Raises UnreadableError."""
        if (text := self._texts.get(style)) is None:
            text = self._texts[style] = self._type.text(style, self.cdr)
        return text

    def payload(self, style: Style, level: int) -> bytes:
        """The same, compressed with zstd unless `level` is 0. Raises UnreadableError."""
        if (payload := self._payloads.get((style, level))) is None:
            plain = self.text(style)
            payload = self._payloads[style, level] = compress(plain, level) if level else plain
        return payload

    def has_payload(self, style: Style, level: int) -> bool:
        """Whether `payload` and `text` are made already."""
        return (style, level) in self._payloads
