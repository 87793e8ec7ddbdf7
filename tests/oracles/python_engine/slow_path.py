"""Datagrams that the fast path does not take: restored where the listener allows it, then parsed by protobuf."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic, TypeVar

from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.message import Message

from router.compiler.metrics import UNKNOWN_CASE
from router.compiler.program import Program
from router.datagrams import why_no_payload
from router.declared import MAX_DATAGRAM
from router.table.model import Framing
from router.types.framing import restored

Case = TypeVar("Case")


class Rejected(Exception):
    """No route takes the datagram. `reason` is one of REJECT_REASONS; the message has details, or is empty."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(detail)
        self.reason = reason


class SlowPath(Generic[Case]):
    """Parses the datagrams of one listener. `cases` are those with a route, by field number."""

    def __init__(self, program: Program, counts: list[int], listener: str, cases: Mapping[int, Case]) -> None:
        plan = next(plan for plan in program.listeners if plan.name == listener)
        self._repairs = plan.framing is Framing.ZERO_TRIMMED
        self._padded = program.counters.index("datagrams_padded", listener)
        self._counters = program.counters
        self._envelope = program.envelope
        self._ignored = program.ignored
        self._case_numbers = frozenset(case.number for case in program.envelope.cases.values())
        self._counts = counts
        self._cases = cases

    def parse(self, data: bytes) -> tuple[Case, Message, bytes]:
        """Return the payload case, the payload and the restored envelope of any datagram. Raises Rejected."""
        if len(data) > MAX_DATAGRAM:
            raise Rejected("truncated", f"{len(data)} bytes")
        if not data:
            raise Rejected("empty")
        whole = restored(data) if self._repairs else data
        try:
            envelope = self._envelope.message_class.FromString(whole)
        except ProtobufError as error:
            raise Rejected("malformed", str(error)) from error
        if len(whole) != len(data):
            self._counts[self._padded] += 1
        return *self._routed(envelope), whole

    def _routed(self, envelope: Message) -> tuple[Case, Message]:
        name = envelope.WhichOneof(self._envelope.oneof)
        if name is None:
            reason, detail = why_no_payload(envelope, self._case_numbers)
            if reason == "unknown_case":
                self._count_unhandled(UNKNOWN_CASE)
            raise Rejected(reason, detail)
        number = self._envelope.cases[name].number
        case = self._cases.get(number)
        if case is not None:
            return case, getattr(envelope, name)
        if number in self._ignored:
            raise Rejected("ignored", name)
        self._count_unhandled(name)
        raise Rejected("unhandled", name)

    def _count_unhandled(self, case: str) -> None:
        self._counts[self._counters.index("unhandled", case)] += 1
