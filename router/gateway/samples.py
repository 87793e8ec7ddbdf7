"""A message that came in, and its JSON, made once for all gateways that send it. Knows no topic's followers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from router.gateway.compression import compress
from router.gateway.json_code import json_writer
from router.gateway.schema_text import schema_text
from router.gateway.style import Style
from router.types.model import MessageType


class ReadyType:
    """A message type that can be received: its definition, its class for rclpy, its schema as JSON."""

    def __init__(self, message: MessageType, message_class: Any) -> None:
        self.message = message
        self.message_class = message_class
        self.schema = schema_text(message)
        self._writers: dict[Style, Callable[[bytes], str]] = {}

    def text(self, style: Style, cdr: bytes) -> str:
        """Raises UnreadableError."""
        if (writer := self._writers.get(style)) is None:
            writer = self._writers[style] = json_writer(self.message, style)
        return writer(cdr)


class Sample:
    """One message. `sent_ns` is the wall clock when it set out. Any thread may convert it; each form is made once."""

    __slots__ = ("_payloads", "_texts", "_type", "cdr", "sent_ns", "topic")

    def __init__(self, topic: str, ready: ReadyType, cdr: bytes, sent_ns: int) -> None:
        self.topic = topic
        self.cdr = cdr
        self.sent_ns = sent_ns
        self._type = ready
        self._texts: dict[Style, str] = {}
        self._payloads: dict[tuple[Style, int], bytes] = {}

    @property
    def type_name(self) -> str:
        return self._type.message.name

    def text(self, style: Style) -> str:
        """As JSON. Raises UnreadableError."""
        if (text := self._texts.get(style)) is None:
            text = self._texts[style] = self._type.text(style, self.cdr)
        return text

    def payload(self, style: Style, level: int) -> bytes:
        """The same in UTF-8, compressed with zstd unless `level` is 0. Raises UnreadableError."""
        if (payload := self._payloads.get((style, level))) is None:
            plain = self.text(style).encode()
            payload = self._payloads[style, level] = compress(plain, level) if level else plain
        return payload

    def has_payload(self, style: Style, level: int) -> bool:
        """`payload` and `text` take no time."""
        return (style, level) in self._payloads
