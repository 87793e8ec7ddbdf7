"""What `router tap` and `listen` show: datagrams of a running router or a UDP port, messages of a ROS topic."""

from __future__ import annotations

import datetime as dt
import json
import socket
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import TYPE_CHECKING, Any

from router.carrier.conditions import NativeCondition
from router.clock import wall_ns
from router.compiler.compiled_table import is_service
from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import BoolKind
from router.compiler.expressions.tree import ENVELOPE, Node
from router.compiler.lowering import lower_condition
from router.compiler.lowering.names import TooLargeError
from router.datagrams import Decoded, Peer, Wire
from router.errors import Code, DecodeError, Diagnostic, SourceSpan, UsageError
from router.library import library
from router.net.addresses import host_and_port
from router.observe.tap import Lost
from router.recording.mirror import BRAKED, FED, LOST, RELEASED, RETURNED, SENT, TRIPPED, Action, MirroredDatagram
from router.table.addresses import Address
from router.table.model.expressions import Expression
from router.table.nodes import TextSpan
from router.table.units import LARGEST_DATAGRAM
from router.types.model import Enum, List, MessageType, Type
from router.types.protobuf import Envelope, PayloadCase
from router.types.table_envelopes import Envelopes
from router.values.printing import clock_text, one_line, protobuf_json, protobuf_tree, ros_json, ros_tree, words

if TYPE_CHECKING:
    from router.recording.reader import Recorded
    from router.ros.topics import TopicListener


class Condition:
    """One expression for several payload cases; it may use fields that not all of them have, and `envelope`.

    The library evaluates it like `when`. `failure` names the first case with a payload for which it has no value, for
    example because of a division by zero: there it counts as false.
    """

    def __init__(self, text: str, envelopes: Envelopes, cases: Sequence[PayloadCase]) -> None:
        """Parse the expression. Raises UsageError if it fits none of the cases, StartError without a library."""
        self.failure = ""
        self._conditions: dict[str, NativeCondition] = {}
        findings: dict[str, Diagnostic] = {}
        for case in cases:
            envelope = envelopes.of(case.name)
            try:
                lowered = lower_condition(_checked(text, case.type, envelope), case, envelope)
                self._conditions[case.name] = NativeCondition(library(), lowered)
            except (ExpressionError, TooLargeError) as error:
                findings[case.name] = error.diagnostic
        if not self._conditions:
            # The hint closest to what was written.
            likely = max(findings.values(), key=lambda finding: SequenceMatcher(a=finding.hint, b=text).ratio())
            raise UsageError(f"--where: {likely.message}", likely.hint)

    @property
    def cases(self) -> frozenset[str]:
        """The payload cases that have all fields of the expression."""
        return frozenset(self._conditions)

    def holds(self, decoded: Decoded, source: str, received_at: int) -> bool:
        case = decoded.case.name
        if (condition := self._conditions.get(case)) is None:
            return False
        beside = decoded.beside.SerializePartialToString() if decoded.beside is not None else b""
        holds = condition.holds(decoded.message.SerializePartialToString(), beside, source, received_at)
        if holds is None:
            self.failure = self.failure or f"{case}: for example, because of a division by zero"
        return bool(holds)


def _checked(text: str, message: MessageType, envelope: Envelope) -> Node:
    """Parse a condition on a message. Raises ExpressionError if it is not a valid one."""
    span = SourceSpan("--where", 1, 1, len(text) + 1)
    scope = Scope(message, tuple(_enums(message, envelope.beside)), (), envelope=envelope)
    node = check(Expression(text, TextSpan(span, ((0, span),))), scope)
    if not isinstance(node.kind, BoolKind):
        raise ExpressionError(
            span, Code.TYPE_MISMATCH, f"it is {node.kind}, not a bool", "compare something, as in speed > 0"
        )
    return node


def _enums(*messages: MessageType) -> Iterator[Enum]:
    """Return the enum types of all fields of the messages and of the messages in them, each once."""
    waiting: list[Type] = [*messages]
    types: dict[str, Type] = {}
    while waiting:
        current = waiting.pop()
        if isinstance(current, List):
            waiting.append(current.element)
        elif isinstance(current, (Enum, MessageType)) and current.name not in types:
            types[current.name] = current
            if isinstance(current, MessageType):
                waiting += [member.type for member in current.fields]
    return (kind for kind in types.values() if isinstance(kind, Enum))


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
        line = f"{start} {self.decoded.case.name} {_one_line(self.decoded)}"
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
            document |= _json(self.decoded)
            document["zeros_restored"] = self.decoded.zeros
            if self.decoded.superseded:
                document["superseded"] = self.decoded.superseded
        if with_hex or self.decoded is None:
            document["hex"] = self.data.hex()
        return json.dumps(document)


@dataclass(frozen=True, slots=True)
class ShownAction:
    """An action: its time (local time), and what it sent, if it did."""

    at: dt.datetime
    action: Action
    decoded: Decoded | None

    def line(self, with_hex: bool) -> str:
        """Return one line: `12:00:00.123+0200 sent to driving_board (drive from topic cmd): drive left=5`."""
        del with_hex  # nothing is shown in hexadecimal
        return f"{clock_text(self.at)} {self._what()}"

    def _what(self) -> str:
        it = self.action
        deadman = f"the deadman of {it.route}"
        if it.what == TRIPPED:
            return f"{deadman} tripped"
        if it.what == RELEASED:
            return f"{deadman} was released: a command was sent"
        if it.what == FED:
            return f"{deadman} was fed by a client's message"
        if it.what == RETURNED:
            return f"{it.target} was silent for {it.detail} and is back"
        source = f" from topic {it.topic}" if it.topic else ""
        if is_service(it.topic):
            source = f" from {it.topic}" if it.topic != it.route else ""
        if it.what == LOST:
            return f"not sent to {it.target} ({it.route}{source}): {self._why_not()}"
        by = deadman if it.what == BRAKED else f"{it.route}{source}"
        if it.reason:
            return f"not sent to {it.target} ({by}): {self._why_not()}"
        return f"sent to {it.target} ({by}): {self._payload()}"

    def _why_not(self) -> str:
        return ": ".join(filter(None, (self.action.reason, self.action.detail)))

    def _payload(self) -> str:
        if self.decoded is None:
            return f"undecodable: {self.action.data.hex()}"
        return f"{self.decoded.case.name} {_one_line(self.decoded)}"

    def json(self, with_hex: bool) -> str:
        """Return one JSON object."""
        del with_hex
        it = self.action
        document: dict[str, object] = {"time": utc_text(self.at), "action": it.what}
        texts = {"route": it.route, "endpoint": it.target, "topic": it.topic, "reason": it.reason, "detail": it.detail}
        document |= {key: text for key, text in texts.items() if text}
        if self.decoded is not None:
            document |= _json(self.decoded)
        return json.dumps(document)


def _one_line(decoded: Decoded) -> str:
    """Return the fields that are set as `router send` takes them: `speed=1 envelope.seq=5`."""
    listed = [*words(protobuf_tree(decoded.message, decoded.case.type))]
    if decoded.beside is not None and (beside := protobuf_tree(decoded.beside, decoded.beside_type)):
        listed += words(beside, ENVELOPE)
    return one_line(listed)


def _json(decoded: Decoded) -> dict[str, object]:
    document: dict[str, object] = {"case": decoded.case.name, "fields": protobuf_json(decoded.message)}
    if decoded.beside is not None:
        document[ENVELOPE] = protobuf_json(decoded.beside)
    return document


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


class Filter:
    """Selects payloads of `cases` that fulfil `condition`; without either, everything, even without a payload."""

    def __init__(self, cases: Collection[str] = (), condition: Condition | None = None) -> None:
        self._cases = cases
        self._condition = condition

    def takes(self, shown: TappedDatagram | ShownAction, at: int) -> bool:
        """`at`: its time in ns since 1970."""
        if not self._cases and self._condition is None:
            return True
        if (decoded := shown.decoded) is None or (self._cases and decoded.case.name not in self._cases):
            return False
        sender = shown.peer if isinstance(shown, TappedDatagram) else ""
        return self._condition is None or self._condition.holds(decoded, sender, at)


class RunningTap:
    """Decodes what a running router receives and does. `missed` counts what it did not send to a slow reader."""

    def __init__(self, wire: Wire, chosen: Filter) -> None:
        self.missed = 0
        self._wire = wire
        self._filter = chosen

    def take(
        self, batches: Iterable[list[MirroredDatagram | Action | Lost]]
    ) -> Iterator[list[TappedDatagram | ShownAction]]:
        """Yield the part of each batch that is to be shown, which may be empty."""
        for batch in batches:
            self.missed += sum(item.number for item in batch if isinstance(item, Lost))
            mirrored = [item for item in batch if not isinstance(item, Lost)]
            mirrored.sort(key=lambda item: item.at)  # actions come apart from datagrams
            items = [(each, item.at) for item in mirrored for each in shown(item, self._wire)]
            yield [item for item, at in items if self._filter.takes(item, at)]


def listen_to_topic(listener: TopicListener) -> Iterator[list[TappedMessage]]:
    """Yield messages without end; after PATIENCE without one, an empty list."""
    while True:
        yield [
            TappedMessage(local_time(arrived), listener.type_name, cdr, listener.message(cdr))
            for cdr, arrived in listener.take(PATIENCE)
        ]


def listen(
    receiver: socket.socket, wire: Wire, envelope: Envelope, name_of: Callable[[Peer], str]
) -> Iterator[list[TappedDatagram]]:
    """Yield datagrams one by one without end; after PATIENCE without one, an empty list."""
    receiver.settimeout(PATIENCE)
    while True:
        try:
            data, peer = receiver.recvfrom(LARGEST_DATAGRAM)
        except TimeoutError:
            yield []
        else:
            yield tapped_datagram(wall_ns(), name_of(host_and_port(peer)), data, wire, envelope=envelope)


def tapped_datagram(
    at: int, peer: str, data: bytes, wire: Wire, rejected: str = "", envelope: Envelope | None = None
) -> list[TappedDatagram]:
    """Return a datagram that was received at `at`, ns since 1970, once for each of its messages.

    `envelope` is as in `Wire.decode`.
    """
    try:
        found = wire.decode_all(data, envelope)
    except DecodeError as error:
        return [TappedDatagram(local_time(at), peer, data, None, str(error), rejected)]
    return [TappedDatagram(local_time(at), peer, data, decoded, rejected=rejected) for decoded in found]


def shown(it: MirroredDatagram | Recorded | Action, wire: Wire) -> Sequence[TappedDatagram | ShownAction]:
    """Return each message of a datagram, or an action, as it is printed."""
    if not isinstance(it, Action):
        peer, envelope = it.endpoint or str(Address(*it.peer)), wire.envelopes.at(it.listener)
        return tapped_datagram(it.at, peer, it.data, wire, it.reason, envelope)
    try:
        decoded = wire.decode(it.data, wire.envelopes.to(it.target)) if it.what in (SENT, BRAKED) else None
    except DecodeError:
        decoded = None
    return [ShownAction(local_time(it.at), it, decoded)]
