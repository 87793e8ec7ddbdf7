"""Fields of a test file as what a message is expected, or given, to hold.

Knows nodes and types. What does not fit is raised as InvalidValueError, with its place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator

from router.errors import Code, SourceSpan, UsageError, did_you_mean
from router.rehearsal.matching import AnyValue, Exactly, ListMatch, Match, MessageMatch, Moment, Near
from router.rehearsal.names import unsound
from router.rehearsal.shown import TIMES
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.units import parse_duration
from router.types.model import Bytes, Enum, Float, Int, List, MessageType, Type
from router.values import parse

RECEIVED_AT = "received_at"
ANY = "any"
_ROUGHLY = re.compile(r"~ ?([-+]?[0-9]+(?:\.([0-9]*))?(?:[eE]([-+]?[0-9]+))?)")
_WITHIN = re.compile(r"(\S+) *(?:\+-|\+/-|±) *(\S+)")


class FieldReader:
    """`enums` are those whose values may be named. Of what is `given`, every value is said exactly."""

    def __init__(self, enums: Iterable[Enum], given: bool = False) -> None:
        self._numbers: dict[str, set[int]] = {}
        for enum in enums:
            for name, number in enum.values:
                for known in (name, f"{enum.name.rpartition('.')[2]}.{name}"):
                    self._numbers.setdefault(known, set()).add(number)
        self._given = given

    def message(self, kind: MessageType, node: Node) -> MessageMatch:
        if not isinstance(node, MappingNode):
            raise unsound(node.span, Code.WRONG_TYPE, f"{kind} is a message: write its fields, {{name: value}}")
        members: dict[str, Match] = {}
        for path, span, value in _flat(node):
            self._put(members, kind, path, span, value)
        return MessageMatch(members, node.span)

    def _put(self, members: dict[str, Match], kind: MessageType, path: str, span: SourceSpan, value: Node) -> None:
        name, dot, rest = path.partition(".")
        field = kind.field(name)
        if field is None:
            hint = did_you_mean(name, [member.name for member in kind.fields])
            raise unsound(span, Code.UNKNOWN_FIELD, f"{kind} has no field '{name}'", hint)
        if not dot:
            if name in members:
                raise unsound(span, Code.DUPLICATE_FIELD, f"'{name}' is given twice")
            members[name] = self.value(field.type, value, kind)
            return
        if not isinstance(field.type, MessageType):
            raise unsound(span, Code.UNKNOWN_FIELD, f"'{name}' is {field.type} and has no fields")
        inner = members.get(name)
        if inner is not None and not isinstance(inner, MessageMatch):
            raise unsound(span, Code.DUPLICATE_FIELD, f"'{name}' is given twice")
        below = dict(inner.members) if inner else {}
        self._put(below, field.type, rest, span, value)
        members[name] = MessageMatch(below, span)

    def value(self, kind: Type, node: Node, holder: MessageType) -> Match:
        if not self._given and _is_word(node, ANY):
            return AnyValue(node.span)
        if isinstance(kind, MessageType):
            return self._submessage(kind, node)
        if isinstance(kind, List):
            return self._list(kind, node, holder)
        if not isinstance(node, ScalarNode):
            raise unsound(node.span, Code.WRONG_TYPE, f"a {kind} takes one value")
        return self._scalar(kind, node, holder)

    def _submessage(self, kind: MessageType, node: Node) -> Match:
        if isinstance(node, ScalarNode) and kind.name in TIMES:
            return Moment(_offset(node), node.span)
        if isinstance(node, ScalarNode) and len(kind.fields) == 1:  # as a table fills it
            (only,) = kind.fields
            return MessageMatch({only.name: self.value(only.type, node, kind)}, node.span)
        return self.message(kind, node)

    def _list(self, kind: List, node: Node, holder: MessageType) -> Match:
        if not isinstance(node, SequenceNode):
            raise unsound(node.span, Code.WRONG_TYPE, f"a {kind} is a list: write [a, b]")
        if kind.length is not None and len(node.items) != kind.length:
            message = f"{kind} has {kind.length} elements, not {len(node.items)}"
            raise unsound(node.span, Code.TYPE_MISMATCH, message)
        return ListMatch(tuple(self.value(kind.element, item, holder) for item in node.items), node.span)

    def _scalar(self, kind: Type, node: ScalarNode, holder: MessageType) -> Match:
        text = node.text
        if isinstance(kind, (Int, Float)) and not self._given and (near := _near(text, node.span)):
            return near
        if isinstance(kind, Int) and (number := self._named(text, holder, node.span)) is not None:
            text = str(number)
        if isinstance(kind, Bytes):
            text = text.replace(" ", "")
        try:
            return Exactly(parse(kind, text, ""), node.span)
        except UsageError as error:
            raise unsound(node.span, Code.BAD_VALUE, str(error).removeprefix(": ")) from error

    def _named(self, text: str, holder: MessageType, span: SourceSpan) -> int | None:
        """The value of a ROS constant of the message, or of a protobuf enum: `STATUS_FIX`, `GPSFixQuality.RTK_FIX`."""
        found = holder.constants.get(text.removeprefix(f"{holder.short_name}."))
        if isinstance(found, int):
            return found
        numbers = self._numbers.get(text, set())
        if len(numbers) > 1:
            message = f"several enums have a value '{text}', with different numbers"
            raise unsound(span, Code.BAD_VALUE, message, f"say of which enum, as in State.{text}")
        return next(iter(numbers), None)


def _flat(node: MappingNode) -> Iterator[tuple[str, SourceSpan, Node]]:
    for name, entry in node.entries.items():
        yield name, entry.key.span, entry.value


def _near(text: str, span: SourceSpan) -> Near | None:
    """`~1.571` is what rounds to that, `1.57 +- 0.01` what is that near."""
    if found := _ROUGHLY.fullmatch(text):
        value = _finite(found[1], "number to be near", span)
        digits = len(found[2] or "") - int(found[3] or 0)
        return Near(value, float(f"0.5e{-digits}"), text, span)
    if found := _WITHIN.fullmatch(text):
        value = _finite(found[1], "number to be near", span)
        tolerance = _finite(found[2], "tolerance", span)
        if tolerance < 0:
            raise unsound(span, Code.BAD_VALUE, f"'{found[2]}' is no tolerance, which is not negative")
        return Near(value, tolerance, text, span)
    return None


def _finite(text: str, what: str, span: SourceSpan) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise unsound(span, Code.BAD_VALUE, f"'{text}' is no {what}", "write a number, as in 1.57 +- 0.01")
    return value


def _offset(node: ScalarNode) -> int | None:
    if node.text == RECEIVED_AT:
        return None
    if node.value == 0:
        return 0
    try:
        return parse_duration(node.text)
    except ValueError as error:
        hint = f"a time is '{RECEIVED_AT}', or so long after the beginning of the test, such as 300ms"
        raise unsound(node.span, Code.BAD_VALUE, str(error), hint) from error


def _is_word(node: Node, word: str) -> bool:
    """The word without quotes: with them it is text."""
    return isinstance(node, ScalarNode) and node.text == word and node.place.is_whole_line
