"""A reference client of gateways: decodes, counts and filters what a source delivers."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.selection import matcher, pattern_problem
from router.errors import SourceSpan, UsageError
from router.gateway.packets import PacketError, unbatched
from router.table.model import TopicPattern
from router.tools.gateway_messages import Message, Problem, Received, Remark, Schema, Shape, read
from router.tools.gateway_sources import Arrival, Source

PATIENCE = 0.2
"""Longest wait of a source in seconds, so that Ctrl-C and the end of `seconds` are noticed."""

ASK_AGAIN = 1.0
"""Seconds between two requests for schemas."""


@dataclass(slots=True)
class Tally:
    """Counts. `early` messages came before their schema, `unwanted` ones are of other topics."""

    messages: int = 0
    schemas: int = 0
    undecodable: int = 0
    lost: int = 0
    early: int = 0
    unwanted: int = 0

    def __str__(self) -> str:
        text = f"{self.messages} messages, {self.schemas} schemas, {self.undecodable} undecodable, {self.lost} lost"
        if self.early:
            text += f", {self.early} before their schema"
        return text + (f", {self.unwanted} of other topics" if self.unwanted else "")


class GatewayClient:
    """Decodes arrivals. `wants` selects topics; `wants("")` says whether all topics are wanted.

    A schema without a topic is shown before the first wanted message of its type.
    """

    def __init__(self, wants: Callable[[str], bool]) -> None:
        self._wants = wants
        self._held: dict[tuple[Hashable, str], Schema] = {}
        self._tally = Tally()
        self._shapes: dict[tuple[Hashable, str], Mapping[str, Shape]] = {}

    def tally(self, source: Source) -> Tally:
        self._tally.lost = source.lost
        return self._tally

    def receive(self, source: Source, seconds: float) -> Iterator[Received]:
        """Decode what the source delivers within `seconds`, and yield the wanted part."""
        ends, asks = time.monotonic() + seconds, 0.0
        while (now := time.monotonic()) < ends:
            if not self._tally.schemas and now >= asks:
                source.ask()
                asks = now + ASK_AGAIN
            for arrival in source.arrivals(min(PATIENCE, ends - now)):
                yield from self.take(arrival)

    def take(self, arrival: Arrival) -> Iterator[Received]:
        """Decode one arrival, and yield the wanted part."""
        try:
            packets = unbatched(arrival.data)
        except PacketError as error:
            yield self._problem(error, arrival.data)
            return
        for packet in packets:
            try:
                received = read(packet)
            except PacketError as error:
                yield self._problem(error, packet)
            else:
                yield from self._counted(received, arrival.sender)

    def _counted(self, received: Message | Schema | Remark, sender: Hashable) -> Iterator[Received]:
        """Count a message or schema, and yield it if it is wanted, after its schema."""
        if isinstance(received, Remark):
            yield received
        elif isinstance(received, Schema):
            yield from self._schema(received, sender)
        elif not self._wants(received.topic):
            self._tally.unwanted += 1
        else:
            if (held := self._held.pop((sender, received.type_name), None)) is not None:
                yield held
            shape = self._shapes.get((sender, received.type_name))
            self._tally.messages += 1
            self._tally.early += shape is None
            yield received._replace(shape=shape)

    def _schema(self, schema: Schema, sender: Hashable) -> Iterator[Schema]:
        self._tally.schemas += 1
        self._shapes[sender, schema.type_name] = schema.shape
        if self._wants(schema.topic):
            yield schema
        elif not schema.topic:
            self._held[sender, schema.type_name] = schema

    def _problem(self, error: PacketError, data: bytes) -> Problem:
        self._tally.undecodable += 1
        return Problem(str(error), data)


_COMMAND_LINE = SourceSpan("command line", 1, 1)


def topic_filter(globs: Sequence[str]) -> Callable[[str], bool]:
    """Return a predicate: whether any glob matches a topic. Without globs, every topic matches. Raises UsageError."""
    patterns = [TopicPattern(glob, is_regex=False, span=_COMMAND_LINE) for glob in globs]
    for problem in filter(None, map(pattern_problem, patterns)):
        raise UsageError(f"--topic: {problem.what}", problem.hint)
    matchers = [matcher(pattern) for pattern in patterns]
    return lambda topic: not matchers or any(matches(topic) for matches in matchers)
