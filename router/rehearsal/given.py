"""`given:` of a test as data, and as the bytes that come in."""

from __future__ import annotations

from router.engine.wire import Wire, framed
from router.errors import Code, Located, SourceSpan, UsageError
from router.rehearsal.matching import MessageMatch, Moments
from router.rehearsal.messages import fill, values
from router.rehearsal.model import Given, GivenDatagram, GivenMessage, Repetition
from router.rehearsal.names import Names, unsound
from router.rehearsal.values import FieldReader
from router.table.nodes import MappingNode, Node
from router.table.reading import boolean, integer, optional_text, parsed
from router.table.units import parse_duration
from router.types.protobuf import PayloadCase
from tests.oracles import reference_cdr

_OF_DATAGRAMS = ("case", "fields", "from", "listener", "trim", "pad")
_OF_MESSAGES = ("topic", "message")


class GivenReader:
    def __init__(self, names: Names) -> None:
        self._names = names
        self._fields = FieldReader(names.enums, given=True)

    def given(self, node: Node) -> Given:
        """Raises InvalidValueError."""
        assert isinstance(node, MappingNode)  # noqa: S101 - the schema saw to it
        span = next(iter(node.entries.values())).key.span if node.entries else node.span
        is_message = "topic" in node.entries
        _only(node, _OF_DATAGRAMS if is_message else ("message",), is_message)
        return self._message(span, node) if is_message else self._datagram(span, node)

    def _datagram(self, span: SourceSpan, node: MappingNode) -> GivenDatagram:
        sender = optional_text(node, "from")
        if sender is None:
            raise unsound(span, Code.MISSING_KEY, "it is not said who sends this", "add 'from: ENDPOINT'")
        case, data = optional_text(node, "case"), _hex(node)
        if (case is None) == (data is None):
            message = "a datagram is given as 'case' with 'fields', or as 'hex'; a ROS message has a 'topic'"
            raise unsound(span, Code.BAD_VALUE, message)
        if case is None and (fields := node.entries.get("fields")):
            raise unsound(fields.key.span, Code.UNKNOWN_KEY, "'fields' belongs to 'case'")
        pad = integer(node, "pad")
        return GivenDatagram(
            span=span,
            peer=self._names.peer(sender.value, sender.span),
            listener=self._listener(span, node, sender.value),
            content=data if data is not None else self._payload(node, case),
            trim=boolean(node, "trim"),
            pad=pad.value if pad else 0,
            repetition=_repetition(node),
        )

    def _payload(self, node: MappingNode, named: Located[str] | None) -> tuple[PayloadCase, MessageMatch]:
        assert named is not None  # noqa: S101 - the caller has seen to it
        case = self._names.case(named.value, named.span)
        fields = node.get("fields")
        return case, self._fields.message(case.type, fields) if fields else MessageMatch({}, named.span)

    def _listener(self, span: SourceSpan, node: MappingNode, sender: str) -> str:
        """The one that is named, else the one by which the sender is believed, else the only one."""
        named = optional_text(node, "listener")
        if named is not None:
            return self._names.listener(named.value, named.span)
        if (believed_by := self._names.believed_by(sender)) is not None:
            return believed_by
        if len(self._names.listeners) > 1:
            raise unsound(span, Code.MISSING_KEY, f"say which listener: {', '.join(self._names.listeners)}")
        return self._names.listeners[0]

    def _message(self, span: SourceSpan, node: MappingNode) -> GivenMessage:
        topic = optional_text(node, "topic")
        assert topic is not None  # noqa: S101 - the caller has seen to it
        kind = self._names.subscribed(topic.value, topic.span)
        data, fields = _hex(node), node.get("message")
        if data is not None and fields is not None:
            raise unsound(span, Code.BAD_VALUE, "a ROS message is given as 'message' or as 'hex', not both")
        match = self._fields.message(kind, fields) if fields else MessageMatch({}, topic.span)
        return GivenMessage(span, topic.value, kind, match if data is None else data, _repetition(node))


def datagram(given: GivenDatagram, wire: Wire, moments: Moments) -> bytes:
    """What arrives. Raises InvalidValueError where a padded datagram is longer than that."""
    if isinstance(given.content, bytes):
        data = given.content
    else:
        case, fields = given.content
        payload = case.message_class()
        fill(payload, case.type, fields, moments)
        data = wire.encode(case, payload)
    try:
        return framed(data, given.trim, given.pad)
    except UsageError as error:
        raise unsound(given.span, Code.BAD_VALUE, str(error)) from error


def message(given: GivenMessage, moments: Moments) -> bytes:
    """The CDR bytes that arrive."""
    if isinstance(given.content, bytes):
        return given.content
    return reference_cdr.cdr(given.type, dict(values(given.type, given.content, moments)))


def _only(node: MappingNode, others: tuple[str, ...], is_message: bool) -> None:
    for name in others:
        if entry := node.entries.get(name):
            kind = "a ROS message" if is_message else "a datagram"
            keys = (*_OF_MESSAGES, "hex") if is_message else (*_OF_DATAGRAMS, "hex")
            hint = f"it has {', '.join(keys)}"
            raise unsound(entry.key.span, Code.UNKNOWN_KEY, f"{kind} has no key '{name}'", hint)


def _repetition(node: MappingNode) -> Repetition:
    times, every, age = integer(node, "times"), optional_text(node, "every"), optional_text(node, "age")
    if every is not None and times is None:
        raise unsound(every.span, Code.MISSING_KEY, "'every' without 'times'", "say how often it is given")
    return Repetition(
        times=times.value if times else 1,
        every=parsed(parse_duration, every) if every else 0,
        age=parsed(parse_duration, age) if age else 0,
    )


def _hex(node: MappingNode) -> bytes | None:
    text = optional_text(node, "hex")
    return bytes.fromhex(text.value) if text else None
