"""The judge of the language: random mappings and messages, with the results of the oracle and of a plane compared.

A question is a mapping with a condition, from a payload to a ROS message or in the other direction, or a condition for
forwarding a payload. A plane answers with bytes, FILTERED, or the reason of a refusal; with `for_each`, once per
element. The oracle gives the permitted answers. A message is bytes, or the payloads of a frame.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple, Union

from google.protobuf.message import DecodeError

from router.compiler.expressions import ExpressionError, Scope, check
from router.compiler.expressions.kinds import UINT32, BoolKind, Kind, ListKind, MessageKind, element_of
from router.compiler.expressions.lists import as_value
from router.compiler.expressions.tree import COUNT, INDEX, ITEM, ITEMS, Node, Variable
from router.compiler.mapping import build
from router.compiler.plan import Record
from router.errors import Code, Diagnostic
from router.rehearsal.cdr import deserialize
from router.rehearsal.cdr import serialize as cdr
from router.table.model.expressions import Expression, FieldEntry, FieldMap
from router.types.model import Enum, MessageType, Type
from router.types.protobuf import PayloadCase
from tests.carrier.messages import some_payloads
from tests.compiler.comparing import same
from tests.compiler.compiling import SPAN, context_of, written
from tests.compiler.language import Language, as_written, language_wire, protobuf_fields, ros_message, ros_target
from tests.compiler.machine import FAILURES
from tests.compiler.payloads import Wire
from tests.compiler.reading import plain
from tests.oracles.reference import fill, fill_given
from tests.oracles.reference_expressions import Context, meaning_of
from tests.oracles.reference_kinds import Listing, Message, Refused, View, Whole
from tests.oracles.reference_protobuf import envelope_of

FILTERED = "filtered"
Answer = Union[bytes, str]
Sent = Union[bytes, tuple[bytes, ...]]
Plane = Callable[["Question"], Callable[[Any], "list[Answer]"]]
"""Makes a function of the messages of a question. Raises Misfit if the compiler refuses the question."""

_ABOUT_VALUES = {
    Code.TOO_LARGE,
    Code.OUT_OF_RANGE,
    Code.WRONG_ARGUMENTS,
    Code.LOSSY_CONVERSION,
    Code.UNKNOWN_ENUM_VALUE,
}
_ABOUT_LENGTHS = ("elements", "length", "nan equals nothing", "no field can hold both", " to float")


def is_about_values(finding: Diagnostic) -> bool:
    """Whether a well-typed question can have this finding, about ranges, lengths, sizes, NaN or names of an enum."""
    return finding.code in _ABOUT_VALUES or any(word in finding.message for word in _ABOUT_LENGTHS)


class Misfit(Exception):
    """The compiler's findings about a question."""

    def __init__(self, findings: Collection[Diagnostic]) -> None:
        super().__init__(*findings)
        self.findings = findings


class Checked(NamedTuple):
    """A question as the compiler's trees."""

    for_each: Node | None
    condition: Node | None
    plan: Record | None


def _element_names(for_each: Node) -> dict[str, Node]:
    element = element_of(for_each.kind)
    assert element is not None
    return {name: Variable(kind, SPAN, name) for name, kind in ((ITEM, element), (INDEX, UINT32), (COUNT, UINT32))}


def _frame_names(source: MessageType) -> dict[str, Node]:
    kinds: dict[str, Kind] = {ITEMS: ListKind(MessageKind(source)), COUNT: UINT32}
    return {name: Variable(kind, SPAN, name) for name, kind in kinds.items()}


@dataclass(frozen=True, slots=True)
class Question:
    language: Language
    fields: FieldMap
    when: Expression | None
    target: MessageType | None
    """None if the payload is forwarded."""

    @property
    def for_each(self) -> Expression | None:
        return written(self.language.for_each) if self.language.for_each else None

    @property
    def source(self) -> MessageType:
        return self.language.source

    @property
    def case(self) -> PayloadCase:
        """The payload case that a message from ROS fills."""
        return language_wire()[1].cases["target"]

    @property
    def enums(self) -> tuple[Enum, ...]:
        return tuple(language_wire()[0].enums.values())

    def checked(self) -> Checked:
        """The compiler's trees. Raises Misfit."""
        scope = Scope(self.source, self.enums, ())
        try:
            for_each = as_value(check(self.for_each, scope), scope) if self.for_each else None
            if for_each is not None:
                scope = Scope(self.source, self.enums, (), _element_names(for_each))
            elif self.language.is_frame:
                scope = Scope(self.source, self.enums, (), _frame_names(self.source))
            condition = check(self.when, scope) if self.when else None
        except ExpressionError as error:
            raise Misfit([error.diagnostic]) from None
        if condition is not None and not isinstance(condition.kind, BoolKind):
            raise Misfit([Diagnostic(condition.span, Code.TYPE_MISMATCH, "a condition is a bool")])
        if self.target is None:
            return Checked(for_each, condition, None)
        mapping = build(self.fields, self.target, scope, SPAN)
        if mapping.findings:
            raise Misfit(mapping.findings)
        assert isinstance(mapping.plan, Record)
        return Checked(for_each, condition, mapping.plan)

    def __str__(self) -> str:
        fields = ", ".join(f"{entry.path[-1]}: {entry.value}" for entry in self.fields.entries)
        types = ", ".join(str(self._type_of(entry.path[-1])) for entry in self.fields.entries)
        of = f"ros, for_each {self.language.for_each}" if self.language.for_each else "ros"
        from_udp = "frames" if self.language.is_frame else "udp"
        return f"{of if self.language.is_ros else from_udp}: {{{fields}}} into {types}, when {self.when}"

    def _type_of(self, name: str) -> Type | None:
        field = self.target.field(name) if self.target else None
        return field.type if field else None


def question(noise: random.Random, language: Language) -> Question:
    is_forwarded = not language.is_ros and not language.is_frame and not language.for_each and noise.randrange(8) == 0
    when = None
    if is_forwarded or noise.randrange(4) == 0:
        when = written(language.text(noise, "b", noise.choice((1, 2, 3))))
    if is_forwarded:
        return Question(language, FieldMap(SPAN, False, ()), when, None)
    if language.is_ros:
        target, fields = language_wire()[1].cases["target"].type, protobuf_fields(noise)
    else:
        target = ros_target(noise, is_frame=language.is_frame)
        fields = [*target.fields[1:]]
    entries = [FieldEntry((each.name,), (SPAN,), language.filled(noise, each.type)) for each in fields]
    return Question(language, FieldMap(SPAN, False, tuple(entries)), when, target)


# ---- messages


def messages(noise: random.Random, language: Language) -> Iterator[tuple[Sent, View]]:
    """Random messages, each with the oracle's view of it, or of the first payload of a frame."""
    if language.is_ros:
        for _ in range(10):
            value = ros_message(noise, language.source)
            yield cdr(language.source, as_written(value)), View(value, language.source)
        return
    payloads = iter(some_payloads(language_wire()[1].cases["source"], noise.getrandbits(64)))
    if not language.is_frame:
        for payload in payloads:
            yield payload, _view(payload)
        return
    while frame := [*islice(payloads, noise.choice((1, 2, 2, 3, 4)))]:
        numbered = tuple(_numbered(payload, len(frame), place) for place, payload in enumerate(frame))
        yield numbered, _view(numbered[0])


def _view(payload: bytes) -> View:
    case = language_wire()[1].cases["source"]
    return View(case.message_class.FromString(payload), case.type)


def _numbered(payload: bytes, count: int, place: int) -> bytes:
    """The payload with the fields `from` and `in`, which a plane can use to make frames."""
    made: Any = language_wire()[1].cases["source"].message_class()
    setattr(made, "from", count)
    setattr(made, "in", place)
    zero = b"\xe8\x01\x00" if place == 0 else b""  # it may stand in the payload
    return payload + bytes(made.SerializeToString()) + zero


# ---- the oracle


@dataclass(frozen=True, slots=True)
class Verdict:
    """A permitted answer: one message, which `read` converts to a tree of values, or the reasons why there is none."""

    message: bytes | None
    reasons: frozenset[str] = frozenset()
    read: Callable[[bytes], Any] | None = None

    def allows(self, answer: Answer) -> bool:
        if isinstance(answer, str):
            return answer in self.reasons
        return self.message is not None and (answer == self.message or self._is_same(answer))

    def __str__(self) -> str:
        return self.message.hex() if self.message is not None else "|".join(sorted(self.reasons))

    def _is_same(self, answer: bytes) -> bool:
        """Whether two trees are equal, ignoring the bits of NaNs and map entries that later ones replace."""
        assert self.message is not None
        if self.read is None:
            return False
        try:
            found, expected = self.read(answer), self.read(self.message)
            return same(found, expected) and (len(answer) == len(self.message) or _has_map(expected))
        except (*FAILURES, DecodeError):
            return False


def oracle(asked: Question) -> Callable[[Sent, View], list[Verdict]]:
    """The permitted answers for a message. The compiler has accepted the question."""

    def judge(message: Sent, view: View) -> list[Verdict]:
        context = context_of(view.message, view.type, asked.enums)
        if isinstance(message, tuple):
            items, of = [*map(_view, message)], Message(view.type)
            count = (len(items), Whole(0, (1 << 32) - 1))
            context = replace(context, names={ITEMS: (items, Listing(of)), COUNT: count})
        if asked.for_each is None:
            return [_verdict(asked, message, context)]
        meaning = meaning_of(asked.for_each, context)
        assert isinstance(meaning.kind, Listing)
        assert meaning.kind.element is not None
        try:
            elements = meaning.give(context)
        except Refused as refused:
            return [Verdict(None, refused.reasons)]
        if not elements and not asked.language.is_ros:
            return [Verdict(None, frozenset([FILTERED]))]
        count = (len(elements), Whole(0, (1 << 32) - 1))
        return [
            _verdict(asked, message, replace(context, names={
                ITEM: (element, meaning.kind.element), INDEX: (index, count[1]), COUNT: count}))
            for index, element in enumerate(elements)
        ]  # fmt: skip

    return judge


def _verdict(asked: Question, message: Sent, context: Context) -> Verdict:
    def make() -> Verdict:
        if asked.target is None:
            assert isinstance(message, bytes)
            return Verdict(message)
        if asked.language.is_ros:
            return sent(language_wire(), asked.case, asked.fields, context)
        return published(asked.target, asked.fields, context)

    return verdict(make, asked.when, context)


def verdict(make: Callable[[], Verdict], when: Expression | None, context: Context) -> Verdict:
    """The result of `make`, unless the condition filters the message or a value is refused."""
    try:
        if when and not meaning_of(when, context).give(context):
            return Verdict(None, frozenset([FILTERED]))
        return make()
    except Refused as refused:
        return Verdict(None, refused.reasons)


def published(target: MessageType, fields: FieldMap, context: Context) -> Verdict:
    """The message of a topic."""
    return Verdict(
        cdr(target, fill(fields, target, context)), read=lambda data: plain(deserialize(target, data), target)
    )


def sent(wire: Wire, case: PayloadCase, fields: FieldMap, context: Context) -> Verdict:
    """The envelope for an endpoint."""
    message = envelope_of(*wire, case, fill_given(fields, case.type, context))
    return Verdict(message, read=lambda data: _listed(wire[1].message_class.FromString(data)))


class _Map(dict[Any, Any]):
    """A protobuf map."""


def _has_map(tree: Any) -> bool:
    inner = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return isinstance(tree, _Map) or any(map(_has_map, inner))


def _listed(value: Any) -> Any:
    """Protobuf objects as dictionaries and lists."""
    if hasattr(value, "ListFields"):
        return {field.name: _listed(inner) for field, inner in value.ListFields()}
    if hasattr(value, "items"):
        return _Map({key: _listed(inner) for key, inner in value.items()})
    return [*map(_listed, value)] if hasattr(value, "append") else value


# ---- the judge


def disagreement(asked: Question, plane: Plane, noise: random.Random) -> str | None:
    """The first forbidden answer of a plane, with its message; None if all answers are permitted.

    Raises Misfit if the compiler refuses the question.
    """
    serve, judge = plane(asked), oracle(asked)
    for message, view in messages(noise, asked.language):
        answers, verdicts = serve(message), judge(message, view)
        is_right = len(answers) == len(verdicts) and all(
            verdict.allows(answer) for verdict, answer in zip(verdicts, answers, strict=True)
        )
        if not is_right:
            shown = " ".join(str(view.message).split())
            found = [answer.hex() if isinstance(answer, bytes) else answer for answer in answers]
            sent = message if isinstance(message, tuple) else (message,)
            as_hex = " ".join(each.hex() for each in sent)
            return f"{asked}\n  is {found}\n  not {[*map(str, verdicts)]}\n  of {shown}\n  {as_hex}"
    return None


def judged_findings(asked: Question, plane: Plane, noise: random.Random) -> Collection[Diagnostic]:
    """The compiler's findings if it refuses the question; otherwise assert that the plane's answers are right."""
    try:
        assert disagreement(asked, plane, noise) is None
    except Misfit as misfit:
        return misfit.findings
    return []
