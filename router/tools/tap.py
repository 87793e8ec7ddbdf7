"""What `router tap` and `listen` show: datagrams of a running router or a UDP port, messages of a ROS topic."""

from __future__ import annotations

import datetime as dt
import json
import socket
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Any

from google.protobuf.json_format import MessageToDict
from google.protobuf.message import Message

from router.carrier.conditions import NativeCondition
from router.carrier.library import library
from router.clock import wall_ns
from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import BoolKind
from router.compiler.expressions.tree import Node
from router.compiler.lowering import lower_condition
from router.compiler.lowering.names import TooLargeError
from router.datagrams import Decoded, Wire
from router.errors import Code, DecodeError, Diagnostic, SourceSpan, UsageError
from router.observe.tap import Lost
from router.recording.mirror import Action, MirroredDatagram
from router.table.model import Expression
from router.table.nodes import TextPlace
from router.table.units import LARGEST_DATAGRAM
from router.types.model import Enum, List, MessageType, Type
from router.types.protobuf import Envelope, PayloadCase
from router.values import clock_text, compact, one_line, ros_json, ros_tree, words

if TYPE_CHECKING:
    from router.ros.topics import TopicListener


class Condition:
    """One expression for several payload cases; it may use fields that not all of them have.

    The library evaluates it like `when`. `failure` names the first case with a payload for which it has no value, for
    example because of a division by zero: there it counts as false.
    """

    def __init__(self, text: str, envelope: Envelope, cases: Sequence[PayloadCase]) -> None:
        """Parse the expression. Raises UsageError if it fits none of the cases, StartError without a library."""
        self.failure = ""
        self._conditions: dict[str, NativeCondition] = {}
        findings: dict[str, Diagnostic] = {}
        for case in cases:
            try:
                lowered = lower_condition(_checked(text, case.type), case)
                self._conditions[case.name] = NativeCondition(library(), lowered)
            except (ExpressionError, TooLargeError) as error:
                findings[case.name] = error.diagnostic
        if not self._conditions:
            # The hint closest to what was written.
            likely = max(findings.values(), key=lambda each: SequenceMatcher(a=each.hint, b=text).ratio())
            raise UsageError(f"--where: {likely.message}", likely.hint)

    @property
    def cases(self) -> frozenset[str]:
        """The payload cases that have all fields of the expression."""
        return frozenset(self._conditions)

    def holds(self, case: str, payload: Message, source: str, received_at: int) -> bool:
        if (condition := self._conditions.get(case)) is None:
            return False
        holds = condition.holds(payload.SerializeToString(), source, received_at)
        if holds is None:
            self.failure = self.failure or f"{case}: for example, because of a division by zero"
        return bool(holds)


def _checked(text: str, message: MessageType) -> Node:
    """Parse a condition on a message. Raises ExpressionError if it is not a valid one."""
    span = SourceSpan("--where", 1, 1, len(text) + 1)
    place = TextPlace(span, ((0, span),))
    node = check(Expression(text, place), Scope(message, tuple(_enums(message)), ()))
    if not isinstance(node.kind, BoolKind):
        raise ExpressionError(
            span, Code.TYPE_MISMATCH, f"it is {node.kind}, not a bool", "compare something, as in speed > 0"
        )
    return node


def _enums(message: MessageType) -> Iterator[Enum]:
    """Return the enum types of all fields of a message and of the messages in it, each once."""
    waiting: list[Type] = [message]
    found: dict[str, Type] = {}
    while waiting:
        current = waiting.pop()
        if isinstance(current, List):
            waiting.append(current.element)
        elif isinstance(current, (Enum, MessageType)) and current.name not in found:
            found[current.name] = current
            if isinstance(current, MessageType):
                waiting += [member.type for member in current.fields]
    return (each for each in found.values() if isinstance(each, Enum))


PATIENCE = 0.2
"""Longest delay in seconds before Ctrl-C or the end of --for is noticed while no message arrives."""


@dataclass(frozen=True, slots=True)
class TappedDatagram:
    """One datagram: time of arrival (local time), sender, bytes, and its payload or why it cannot be decoded.

    `rejected` is the reason if no route took it.
    """

    at: dt.datetime
    peer: str
    data: bytes
    decoded: Decoded | None
    problem: str = ""
    rejected: str = ""

    def line(self, with_hex: bool) -> str:
        """Return one line: `12:00:00.123+0200 sensor_board imu_info accel_x=1.5`."""
        start = f"{clock_text(self.at)} {self.peer}" + (f" rejected ({self.rejected})" if self.rejected else "")
        if self.decoded is None:
            return f"{start} undecodable ({self.problem}): {self.data.hex() or 'no bytes'}"
        line = f"{start} {self.decoded.case.name} {compact(self.decoded.message, self.decoded.case.type)}"
        if self.decoded.zeros:
            line += f" ({self._repair(self.decoded.zeros)})"
        if self.decoded.superseded:
            line += f" (superseded: {', '.join(self.decoded.superseded)})"
        return f"{line} [{self.data.hex()}]" if with_hex else line

    def _repair(self, zeros: int) -> str:
        return f"trimmed: {zeros} zeros restored" if zeros > 0 else f"padded: {-zeros} zeros removed"

    def json(self, with_hex: bool) -> str:
        """Return one JSON object; the fields in protobuf's JSON mapping with the names of the `.proto` files."""
        document: dict[str, object] = {
            "time": utc_text(self.at),
            "peer": self.peer,
            "bytes": len(self.data),
        }
        if self.rejected:
            document["rejected"] = self.rejected
        if self.decoded is None:
            document["problem"] = self.problem
        else:
            document["case"] = self.decoded.case.name
            document["fields"] = MessageToDict(self.decoded.message, preserving_proto_field_name=True)
            document["zeros_restored"] = self.decoded.zeros
            if self.decoded.superseded:
                document["superseded"] = self.decoded.superseded
        if with_hex or self.decoded is None:
            document["hex"] = self.data.hex()
        return json.dumps(document)


@dataclass(frozen=True, slots=True)
class TappedMessage:
    """One ROS message: when it arrived (local time), its type, its CDR bytes, and rclpy's object of them."""

    at: dt.datetime
    type_name: str
    cdr: bytes
    message: Any

    def line(self, with_hex: bool) -> str:
        """Return one line: `12:00:00.123+0200 comms/msg/BasestationManualDrive forward_backward=5`."""
        line = f"{clock_text(self.at)} {self.type_name} {one_line(words(ros_tree(self.message)))}"
        return f"{line} [{self.cdr.hex()}]" if with_hex else line

    def json(self, with_hex: bool) -> str:
        """Return one JSON object."""
        document = {
            "time": utc_text(self.at),
            "type": self.type_name,
            "bytes": len(self.cdr),
            "fields": ros_json(self.message),
        }
        return json.dumps(document | {"hex": self.cdr.hex()} if with_hex else document)


def utc_text(at: dt.datetime) -> str:
    """Return a time for programs: UTC in ISO 8601."""
    return at.astimezone(dt.timezone.utc).isoformat()


def local_time(at: int) -> dt.datetime:
    """Return the local time of `at`, ns since 1970."""
    return dt.datetime.fromtimestamp(at / 1e9).astimezone()


class RunningTap:
    """Decodes what a running router receives. `missed` counts datagrams not sent because this reader is too slow.

    Selects payloads of `cases` that fulfil `condition`; without either, all datagrams, even without a payload.
    """

    def __init__(
        self,
        wire: Wire,
        cases: Collection[str] = (),
        condition: Condition | None = None,
    ) -> None:
        self.missed = 0
        self._wire = wire
        self._cases = cases
        self._condition = condition

    def take(self, batches: Iterable[list[MirroredDatagram | Action | Lost]]) -> Iterator[list[TappedDatagram]]:
        """Yield the part of each batch that is to be shown, which may be empty."""
        for batch in batches:
            shown = []
            for each in batch:
                if isinstance(each, Lost):
                    self.missed += each.number
                if not isinstance(each, MirroredDatagram):
                    continue
                peer = each.endpoint or f"{each.peer[0]}:{each.peer[1]}"
                tapped = tapped_datagram(each.at, peer, each.data, self._wire, each.reason)
                if self._is_wanted(tapped, each.at):
                    shown.append(tapped)
            yield shown

    def _is_wanted(self, tapped: TappedDatagram, at: int) -> bool:
        if tapped.decoded is None:
            return not self._cases and self._condition is None
        case, payload = tapped.decoded.case.name, tapped.decoded.message
        if self._cases and case not in self._cases:
            return False
        return self._condition is None or self._condition.holds(case, payload, tapped.peer, at)


def listen_to_topic(listener: TopicListener) -> Iterator[list[TappedMessage]]:
    """Yield messages without end; after PATIENCE without one, an empty list."""
    while True:
        yield [
            TappedMessage(local_time(arrived), listener.type_name, cdr, listener.message(cdr))
            for cdr, arrived in listener.take(PATIENCE)
        ]


def listen(
    receiver: socket.socket, wire: Wire, name_of: Callable[[tuple[str, int]], str]
) -> Iterator[list[TappedDatagram]]:
    """Yield datagrams one by one without end; after PATIENCE without one, an empty list."""
    receiver.settimeout(PATIENCE)
    while True:
        try:
            data, peer = receiver.recvfrom(LARGEST_DATAGRAM)
        except TimeoutError:
            yield []
        else:
            yield [tapped_datagram(wall_ns(), name_of(peer), data, wire)]


def tapped_datagram(at: int, peer: str, data: bytes, wire: Wire, rejected: str = "") -> TappedDatagram:
    """Return a datagram that was received at `at`, ns since 1970."""
    try:
        return TappedDatagram(local_time(at), peer, data, wire.decode(data), rejected=rejected)
    except DecodeError as error:
        return TappedDatagram(local_time(at), peer, data, None, str(error), rejected)
