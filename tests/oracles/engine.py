"""The oracle of dispatch: the protobuf library parses every envelope, names are looked up. Slow and plain."""

from __future__ import annotations

from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet

from router.table.model import Framing
from router.types.framing import MAX_DATAGRAM, restored
from tests.engine.rig import Rig
from tests.oracles.python_engine.binding import bind
from tests.oracles.python_engine.freshness import Freshness


class Naive:
    """Stands in for the engine of a rig: same handlers, context and counters, another way to get there."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.program = rig.program
        handlers = [(number, handler) for number, [handler] in self.program.inbound.items()]
        self.handles = {number: bind(self.program, handler, rig.context, Freshness()) for number, handler in handlers}

    def receive(self, data: bytes, peer: tuple[str, int], listener: str) -> None:
        self._add(1, "datagrams_received", listener)
        self._add(len(data), "received_bytes", listener)
        if (sender := self._endpoint(peer, listener)) is not None:
            self._stamp("endpoint_last_seen_timestamp_seconds", sender)
        reason = self._take(data, peer, listener)
        if reason is not None:
            self._add(1, "datagrams_rejected", listener, reason)

    def _add(self, amount: int, metric: str, *labels: str) -> None:
        self.rig.counts[self.program.counters.index(metric, *labels)] += amount

    def _stamp(self, metric: str, label: str) -> None:
        self.rig.counts[self.program.counters.index(metric, label)] = self.rig.WALL + self.rig.now

    def _take(self, data: bytes, peer: tuple[str, int], listener: str) -> str | None:
        if len(data) > MAX_DATAGRAM:
            return "truncated"
        if not data:
            return "empty"
        [plan] = [plan for plan in self.program.listeners if plan.name == listener]
        whole = restored(data) if plan.framing is Framing.ZERO_TRIMMED else data
        try:
            message = self.program.envelope.message_class.FromString(whole)
        except DecodeError:
            return "malformed"
        if whole != data:
            self._add(1, "datagrams_padded", listener)
        return self._route(message, whole, peer, listener)

    def _route(self, message: Message, data: bytes, peer: tuple[str, int], listener: str) -> str | None:
        name = message.WhichOneof("payload")
        if name is None:
            fields = UnknownFieldSet(message)
            if not len(fields):
                return "no_payload"
            cases = {case.number for case in self.program.envelope.cases.values()}
            if any(fields[index].field_number in cases for index in range(len(fields))):
                return "malformed"
            self._add(1, "unhandled", "unknown")
            return "unknown_case"
        number = self.program.envelope.cases[name].number
        if number in self.program.ignored:
            return "ignored"
        if number not in self.program.inbound:
            self._add(1, "unhandled", name)
            return "unhandled"
        sender = self._endpoint(peer, listener)
        if sender not in self.program.inbound[number][0].sources:
            return "source_mismatch"
        label = sender or "unknown"
        self._add(1, "messages_received", name, label)
        self.handles[number](getattr(message, name), data, self.rig.WALL + self.rig.now, self.rig.now, label)
        self._stamp("route_last_message_timestamp_seconds", name)
        self._add(1, "route_duration_seconds", name)  # the first bucket: the clock of these tests stands still
        return None

    def _endpoint(self, peer: tuple[str, int], listener: str) -> str | None:
        for endpoint in self.program.table.endpoints.values():
            if endpoint.listener is not None and endpoint.listener.value != listener:
                continue
            port = endpoint.source_port.value if endpoint.source_port else None
            if endpoint.address.value.host == peer[0] and port in (None, peer[1]):
                return endpoint.name
        return None
