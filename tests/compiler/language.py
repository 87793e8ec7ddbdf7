"""Random expressions and messages for the judge of the language (`judging`).

Expressions are well-typed except for ranges and lengths, which the compiler may refuse. Everything is drawn from a
`random.Random`, because a script tries millions of them.
"""

from __future__ import annotations

import math
import random
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from router.table.model.expressions import Elements, Expression, FieldMap
from router.types.model import Bool, Bytes, Enum, Field, Float, Int, List, MessageType, String, Type
from tests.compiler.compiling import chosen, each, field_map, listed, written
from tests.compiler.payloads import Wire, wire_of


@cache
def language_wire() -> Wire:
    return wire_of(Path(__file__).parent / "protos" / "language", "language.Envelope")


# ---- a ROS message with a field of each kind

I8, U8, I16, U16, I32, U32, I64, U64 = (Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (True, False))
F32, F64 = Float(32), Float(64)
TIME = MessageType("builtin_interfaces/msg/Time", (Field("sec", I32), Field("nanosec", U32)))
DURATION = MessageType("builtin_interfaces/msg/Duration", (Field("sec", I32), Field("nanosec", U32)))
INNER = MessageType(
    "made/msg/Inner", (Field("value", I32), Field("in", String()), Field("ratio", F64), Field("many", List(I64)))
)
PAIR = MessageType("made/msg/Pair", (Field("key", String()), Field("value", String())))
_ROS_FIELDS = (
    Field("flag", Bool()), Field("i32", I32), Field("u8", U8), Field("i64", I64), Field("names", List(String())),
    Field("u32", U32), Field("i16", I16), Field("u64", U64), Field("f32", F32), Field("name", String()),
    Field("f64", F64), Field("raw", List(U8)), Field("i32s", List(I32)), Field("i64s", List(I64)),
    Field("stamp", TIME), Field("span", DURATION), Field("u64s", List(U64)), Field("f32s", List(F32)),
    Field("f64s", List(F64)), Field("flags", List(Bool())), Field("i16x3", List(I16, 3)), Field("inner", INNER),
    Field("f64x3", List(F64, 3)), Field("u64x2", List(U64, 2)), Field("inners", List(INNER)),
    Field("textx2", List(String(), 2)), Field("from", I32), Field("in", U64), Field("class", F64),
    Field("is", Bool()), Field("few", List(U16, None, 4)), Field("pairs", List(PAIR)),
)  # fmt: skip

DEEP = MessageType("made/msg/Deep", (Field("a", U8), Field("inners", List(INNER)), Field("b", List(String()))))
_OTHER_FIELDS = (
    Field("wide", String(wide=True)), Field("wides", List(String(wide=True))), Field("byte", U8),
    Field("none", MessageType("made/msg/None")), Field("deep", List(DEEP)),
)  # fmt: skip
"""Fields that no expression reads."""

ORDERS = 40


@cache
def ros_source(order: int) -> MessageType:
    """A ROS message with a field of each kind and some others, in random order."""
    noise = random.Random(order)
    fields = [*_ROS_FIELDS, *noise.sample(_OTHER_FIELDS, noise.randrange(len(_OTHER_FIELDS) + 1))]
    return MessageType("made/msg/Source", tuple(noise.sample(fields, len(fields))))


# ---- expressions: templates by kind, with places for expressions of other kinds
#
# i, f, b, s, t: an integer, float, bool, text, time; I, F, B, S: lists of them. k, q: a small literal integer, float.

_TEMPLATES: Mapping[str, Sequence[str]] = {
    "i": (
        "({i} + {i})", "({i} - {i})", "({i} * {i})", "({i} // {i})", "({i} % {i})", "(-{i})", "(+{i})", "({i} ** 2)",
        "({i} ** 3)", "({i} ** 8)", "abs({i})", "min({i}, {i})", "max({i}, {i}, {i})", "clamp({i}, {i}, {i})",
        "clamp({i}, -100, 100)", "wrap({i}, -180, 179)", "wrap({i}, {i}, {i})", "wrap({i}, 0, 255)", "round({f})",
        "trunc({f})", "floor({f})", "ceil({f})", "round(clamp({f}, -100, 100))", "round(clamp({f}, 0.0, 1e9))",
        "int({b})", "int({i})", "round({i})", "({i} if {b} else {i})", "len({s})", "len({I})", "len({S})", "{I}[0]",
        "{I}[1]", "min({I})", "max({I})", "sum({I})", "len({F})", "[{i}, {i}][1]", "sum([{i}, {i}, {i}])",
        "max([{i}, {i}])",
    ),
    "f": (
        "({f} + {i})", "({i} - {f})", "({f} * {f})", "({i} / {i})", "({f} / {f})", "({f} // {i})", "({f} % {f})",
        "({i} % {f})", "(-{f})", "abs({f})", "min({f}, {i})", "max({f}, {f})", "clamp({f}, -1.5, 1.5)",
        "clamp({f}, {f}, {f})", "clamp({i}, {q}, {f})", "radians({f})", "degrees({i})", "sqrt({f})", "sin({f})",
        "cos({f})", "tan({f})", "atan2({f}, {f})", "float32({f})", "float64({i})", "({f} if {b} else {i})",
        "({f} ** 2)", "({f} ** 5)", "seconds({t})", "{F}[0]", "{F}[2]", "min({F})", "max({F})", "sum({F})",
        "[{f}, {i}][1]", "sum([{f}, {i}])", "({f} if {b} else {f})",
    ),
    "b": (
        "({i} < {i})", "({f} <= {i} < {f})", "({i} == {f})", "({i} >= {f})", "({s} == {s})", "({s} < {s})", "(not {b})",
        "({b} and {b})", "({b} or {b} or {b})", "({i} in [{i}, {i}, {i}])", "({i} not in {I})", "({f} in {I})",
        "({i} in {F})", "({s} in {S})", "({b} if {b} else {b})", "({b} == {b})", "({b} != {b})", "({i} != {i} > {i})",
        "(source == {s})", "({t} == {t})", "({t} < {t} <= {t})", "{B}[0]", "({f} != {f})", "({f} > {f})",
        "({f} in [{f}, {i}])",
    ),
    "s": (
        "({s} + {s})", "str({i})", "str({b})", "str({s})", "({s} if {b} else {s})", "text({f}, 0)", "text({f}, 2)",
        "text({f}, 17)", "text({i}, 1)", "{S}[0]", "{S}[1]", "strip({s})",
    ),
    "t": ("({t} if {b} else {t})", "time_from_seconds({f})", "time_from_milliseconds({f})", "time_from_seconds({k})"),
    "I": (
        "({I} + {i})", "({i} - {I})", "({I} * {I})", "({I} - {I})", "({I} // {i})", "({i} % {I})", "({I} % {I})",
        "(-{I})", "({I} ** 2)", "abs({I})", "min({I}, {i})", "max({i}, {I})", "max({I}, {I})", "clamp({I}, {i}, {I})",
        "clamp({I}, -100, 100)", "wrap({I}, -180, 179)", "wrap({i}, {I}, {I})", "round({F})", "trunc({F})",
        "floor({F})", "ceil({F})", "round(clamp({F}, -100, 100))", "int({B})", "({I} if {b} else {I})", "[{i}, {i}]",
        "([{i}, {i}, {i}] * {i})", "int({I})", "round({I})", "({I})",
    ),
    "F": (
        "({F} + {I})", "({I} / {i})", "({F} * {f})", "({F} / {F})", "({i} / {I})", "({F} // {f})", "({F} % {F})",
        "(-{F})", "abs({F})", "radians({F})", "degrees({I})", "sqrt({F})", "sin({F})", "cos({I})", "tan({F})",
        "atan2({F}, {f})", "float32({F})", "float64({I})", "clamp({F}, -1.5, 1.5)", "clamp({F}, {f}, {F})",
        "min({F}, {I})", "max({f}, {I})", "({F} if {b} else {F})", "({F} if {b} else {I})", "[{f}, {f}, {i}]",
        "([{f}, {i}] / {i})", "({F} ** 2)",
    ),
    "B": ("[{b}, {b}]", "({B} if {b} else {B})"),
    "S": (
        "str({I})", "str({B})", "({S} + {s})", "({s} + {S})", "({S} + {S})", "str({S})", "text({F}, 2)",
        "text({I}, 0)", "[{s}, {s}]", "({S} if {b} else {S})", "strip({S})",
    ),
}  # fmt: skip

_SHARED: Mapping[str, Sequence[str]] = {
    "i": ("i32", "u32", "i64", "u64", "message.u64", "inner.value", "message.inner.value", "inners[0].value", "from",
          "message.from", "message.in", "inner.many[0]", "inners[1].many[0]"),
    "f": ("f32", "f64", "inner.ratio", "class", "message.class", "inners[0].ratio", "f32s[0]"),
    "b": ("flag", "message.is", "True", "false"),
    "s": ("name", "source", "inner.in", "names[0]", "'ab'", "'é'", "''", "inners[0].in"),
    "t": ("received_at",),
    "I": ("i32s", "i64s", "u64s", "raw", "inner.many", "inners[0].many", "inners.value", "message.inners.value",
          "[inner, inners[1]].value"),
    "F": ("f32s", "f64s", "inners.ratio"),
    "B": ("flags",),
    "S": ("names", "inners.in"),
}  # fmt: skip
_PROTOBUF: Mapping[str, Sequence[str]] = {
    "i": ("mode", "grade", "Mode.LESS", "Grade.POOR", "left", "opt", "modes[0]", "inner.grade", "third.value",
          "message.not", "with.value",
          "int(grade)", "fourth"),
    "f": ("third.ratio", "message.None"),
    "b": ("has(inner)", "has(opt)", "has(grade)", "has(left)", "has(third.grade)", "has(fourth)",
          "has(message.third)", "has(message.not)", "has(with)", "has(with.grade)",
          "(mode == Mode.ON)", "(grade in [Grade.FAIR, Grade.GOOD])", "(Mode.LOUD in modes)"),
    "s": ("right", "loose", "str(mode)", "message.with.in"),
    "t": (),
    "I": ("modes", "grades", "packed", "expanded", "inners.grade"),
    "F": (),
    "B": (),
    "S": ("str(grades)",),
}  # fmt: skip
_ROS: Mapping[str, Sequence[str]] = {
    "i": ("u8", "i16", "few[0]", "u64x2[1]"),
    "f": ("f64x3[1]",),
    "b": (),
    "s": ("textx2[1]",),
    "t": ("stamp", "span"),
    "I": ("few", "i16x3", "u64x2"),
    "F": ("f64x3",),
    "B": (),
    "S": ("textx2",),
}
ITEMS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "inners": {"i": ("item.value", "item.many[0]", "len(item.many)"), "f": ("item.ratio",), "s": ("item.in",),
               "I": ("item.many",)},
    "i64s": {"i": ("item",)}, "message.u64s": {"i": ("item",)}, "raw": {"i": ("item",)}, "names": {"s": ("item",)},
    "f64x3": {"f": ("item",)}, "u64s * 2": {"i": ("item",)}, "radians(f32s)": {"f": ("item",)},
    "[i32, u64]": {"i": ("item",)}, "i16x3 if flag else few": {"i": ("item",)},
}  # fmt: skip
"""Lists for `for_each`, and the fields of their elements in expressions."""
_ITEMS_OF_ROS = ("f64x3", "i16x3 if flag else few")

FRAME: Mapping[str, Sequence[str]] = {
    "i": ("items[0].i32", "items[1].u64", "items[2].inner.value", "items[0].inners[1].value", "items[1].grade", "count",
          "len(items)", "items[0].modes[0]", "items[2].left", "len(items[1].names)", "items[1].inner.many[0]",
          "items.inner[1].value", "len(items.inner)", "items.third[0].many[0]"),
    "f": ("items[0].f32", "items[1].f64", "items[2].third.ratio", "items[1].class"),
    "b": ("items[1].flag", "has(items[0].inner)", "has(items[1].grade)", "has(items[2].opt)", "items[0].is"),
    "s": ("items[0].name", "items[1].inner.in", "items[2].names[0]", "items[0].loose", "items[1].right"),
    "t": (),
    "I": ("items[0].i32s", "items[1].modes", "items[2].inner.many", "items[0].raw", "items[1].u64s", "items.u64",
          "items.inner.value", "items.grade", "items[1].inners.value"),
    "F": ("items[1].f64s", "items[0].f32s", "items.f32", "items.third.ratio"),
    "B": ("items[1].flags", "items.flag"),
    "S": ("items[1].names", "str(items[0].grades)", "items.name", "items.inner.in"),
}  # fmt: skip
"""The names for the payloads of a frame in expressions, in addition to the fields of the first one."""

ELEMENT: Mapping[str, Sequence[str]] = {
    "i": ("value", "many[0]", "item.value", "len(many)", "message.i32", "message.inner.value", "message.u64",
          "message.inners[1].value"),
    "f": ("ratio", "item.ratio", "message.f64"),
    "b": ("message.flag", "message.is", "(ratio > 1)"),
    "s": ("item.in", "message.name", "message.inner.in", "source"),
    "t": ("received_at",),
    "I": ("many", "item.many", "message.i32s", "message.inners.value"),
    "F": ("message.f32s", "message.inners.ratio"),
    "B": ("message.flags",),
    "S": ("message.names",),
}  # fmt: skip
"""The names in the fields of `each`, for a list of Inner."""
_ELEMENT_OF_PROTOBUF: Mapping[str, Sequence[str]] = {"i": ("grade", "message.mode"), "b": ("has(grade)",)}

_INTEGERS = (0, 1, 2, 3, 7, 100, 255, 256, -1, -7, -128, 65536, (1 << 24) + 1, (1 << 31) - 1, -(1 << 31), 1 << 32,
             1 << 53, (1 << 53) + 1, (1 << 63) - 1, 1 << 63, -(1 << 63), (1 << 64) - 1)  # fmt: skip
_FLOATS = ("0.5", "1e6", "2.0", "(-0.0)", "1e300", "9007199254740992.0", "9.3e18", "-2.5", "nan", "inf", "0.1")


@dataclass(frozen=True, slots=True)
class Language:
    """A source message, and expressions over it. With `is_wild`, some expressions have the wrong kind.

    `for_each` is one of ITEMS, or empty. `order` is the order of the fields of a ROS message. `is_frame`: several
    payloads are one message. `is_element`: the expressions are the fields of `each`, for a list of Inner.
    """

    is_ros: bool
    is_wild: bool = False
    for_each: str = ""
    order: int = 0
    is_frame: bool = False
    is_element: bool = False

    @property
    def source(self) -> MessageType:
        return ros_source(self.order) if self.is_ros else language_wire()[1].cases["source"].type

    def text(self, noise: random.Random, kind: str, depth: int) -> str:
        """An expression of a kind."""
        if self.is_wild and noise.randrange(8) == 0:
            kind = noise.choice([*_TEMPLATES])
        if kind == "k":
            return _bracketed(noise.choice((0, 1, 2, 5, -3, 1_700_000_000)))
        if kind == "q":
            return noise.choice(("0", "0.5", "-1.5", "10"))
        if depth == 0 or noise.randrange(4) == 0:
            return self._leaf(noise, kind)
        return self._completed(noise, noise.choice(_TEMPLATES[kind]), depth - 1)

    def _leaf(self, noise: random.Random, kind: str) -> str:
        if kind == "i" and noise.randrange(3) == 0:
            return _bracketed(noise.choice(_INTEGERS))
        if kind == "f" and noise.randrange(3) == 0:
            return noise.choice(_FLOATS)
        if self.for_each and not self.is_element and noise.randrange(2):
            of_item: list[str] = [*ITEMS[self.for_each].get(kind, ()), *(("index", "count") if kind == "i" else ())]
            if of_item:
                return noise.choice(of_item)
        if self.is_frame and FRAME[kind] and noise.randrange(2):
            return noise.choice(FRAME[kind])
        if self.is_element:
            seen: list[str] = [*ELEMENT[kind], *(("index", "count") if self.for_each and kind == "i" else ())]
            return noise.choice([*seen, *(() if self.is_ros else _ELEMENT_OF_PROTOBUF.get(kind, ()))])
        known: list[str] = [*_SHARED[kind], *(_ROS if self.is_ros else _PROTOBUF)[kind]]
        return noise.choice(known)

    def filled(self, noise: random.Random, target: Type) -> Expression | Elements:
        """What fills a field, or is refused for its range or length."""
        if noise.randrange(12) == 0 and not isinstance(_innermost(target), MessageType):
            return self._choices(noise, target)
        if isinstance(target, List) and isinstance(target.element, MessageType) and noise.randrange(4) == 0:
            if noise.randrange(2):
                inner = replace(self, is_element=True)
                return each(noise.choice(self._lists_of_inner()), inner._fields(noise, target.element))
            return listed(*(self._fields(noise, target.element) for _ in range(noise.choice((1, 2)))))
        return written(self._value(noise, target, noise.choice((1, 2, 2, 3, 4))))

    def _lists_of_inner(self) -> Sequence[str]:
        return (
            *(("message.inners",) if self.is_element else ("inners", "message.inners")),
            *(("items[1].inners", "items.inner") if self.is_frame else ()),
        )

    def _fields(self, noise: random.Random, target: MessageType) -> FieldMap:
        """Fields of a list element; a oneof gets one member."""
        members = {member.oneof or member.name: member for member in target.fields}.values()
        return field_map(**{member.name: self.filled(noise, member.type) for member in members})

    def _value(self, noise: random.Random, target: Type, depth: int) -> str:
        if not self.is_ros and not self.is_element and str(target) in _OF_PROTOBUF and noise.randrange(2):
            return noise.choice(_OF_PROTOBUF[str(target)])
        templates = _of_frames(target) if self.is_frame else _filling(target)
        return self._completed(noise, noise.choice(_in_elements(templates) if self.is_element else templates), depth)

    def _completed(self, noise: random.Random, template: str, depth: int) -> str:
        parts = template.split("{")
        return parts[0] + "".join(self.text(noise, part[0], depth) + part[2:] for part in parts[1:])

    def _choices(self, noise: random.Random, target: Type) -> Expression:
        otherwise = self._value(noise, target, 2)
        if not self.is_ros and noise.randrange(2):
            values = {"OFF": 1, "ON": 1, "LOUD": 1, "LESS": 1}
            subject, is_whole = "message.mode", noise.randrange(2) == 1
            if noise.randrange(2):
                values, subject = {"NONE": 1, "FAIR": 1, "GOOD": 1, "POOR": 1}, "message.grade"
        elif noise.randrange(2):
            values, subject, is_whole = {"true": 1, "false": 1}, self.text(noise, "b", 2), True
        else:
            values, subject, is_whole = {"0": 1, "1": 1, "-7": 1}, self.text(noise, "i", 1), False
        chosen_values = {name: self._value(noise, target, 1) for name in values}
        return chosen(subject, chosen_values, None if is_whole else otherwise)


def some_language(noise: random.Random, *, is_wild: bool = False) -> Language:
    """A language over datagrams, frames, ROS messages, or the elements of a list in a datagram or ROS message."""
    is_ros, has_more = noise.randrange(2) == 1, noise.randrange(3) == 0
    is_frame = has_more and not is_ros and noise.randrange(2) == 1
    lists = [each for each in ITEMS if is_ros or each not in _ITEMS_OF_ROS]
    for_each = noise.choice(lists) if has_more and not is_frame else ""
    return Language(is_ros, is_wild, for_each, noise.randrange(ORDERS), is_frame=is_frame)


def _bracketed(number: int) -> str:
    return f"({number})" if number < 0 else str(number)


def _filling(target: Type) -> Sequence[str]:  # noqa: C901 - a case a type
    """Templates of expressions that fill a type."""
    match target:
        case Bool():
            return ("{b}",)
        case Int():
            least = max(target.low, -9)
            return ("clamp({i})", "wrap({i})", "round(float64({i}))", "round({f})", "{i}", f"clamp({{i}}, {least}, 99)")
        case Float(64):
            return ("{f}", "{f}", "float64({i})")
        case Float():
            return ("float32({f})", "{f}", "float32({i})")
        case String():
            return ("{s}",)
        case Bytes():
            return ("raw", "clamp({I}, 0, 255)", "wrap({I}, 0, 255)", "round({F})")
        case Enum():
            return ("round(float64({i}))", "clamp({i}, -8, 301)", "{i}", "wrap({i}, 0, 5)", "name", "{s}")
        case MessageType():
            if target in (TIME, DURATION) or target.name.startswith("google.protobuf."):
                return ("{t}",)
            return ("inner", "message.inner", "inners[0]", "inners[1]")
        case List(MessageType() as of) if of == DURATION:
            return ("[{t}, {t}]", "[]")
        case List(MessageType() as of):
            return ("pairs",) if of.is_map_entry else ("inners", "[inner, inners[0]]", "[inner]")
        case List():
            return [_raised(template) for template in _filling(target.element)]


_OF_PROTOBUF: Mapping[str, Sequence[str]] = {
    str(TIME): ("moment", "message.moment"),
    str(DURATION): ("lapse", "lapses[1]"),
    str(List(DURATION)): ("lapses", "[lapse, lapses[0]]"),
}
"""Times and durations of protobuf, by the type that they fill."""


def _of_frames(target: Type) -> Sequence[str]:
    """Templates of expressions that fill a type in the topics of a frame."""
    match target:
        case MessageType() if target == PART:
            return ("items[1]", "message", "items[0]")
        case MessageType() if target == INNER:
            return (*_filling(target), "items[1].inner", "items[0].inners[0]")
        case List(MessageType() as of) if of == PART:
            return ("items", "items", "[message, items[1]]")
        case List(MessageType() as of) if of == INNER:
            return (*_filling(target), "items[1].inners", "[items[1].inner, inner]", "items.inner")
        case _:
            return _filling(target)


def _in_elements(templates: Sequence[str]) -> Sequence[str]:
    """The templates with the fields of the source message as `message.inner`, for the fields of `each`."""
    return [_FIELDS.sub(r"message.\1", template) for template in templates]


_FIELDS = re.compile(r"(?<![\w.{])(inners?|pairs|names?|raw)\b")


def _innermost(declared: Type) -> Type:
    return declared.element if isinstance(declared, List) else declared


def _raised(template: str) -> str:
    """A template with lists in place of scalars."""
    return re.sub(r"\{(\w)\}", lambda match: f"{{{match[1].upper()}}}", template).replace("name", "names")


# ---- what is filled

_SCALARS: Sequence[Type] = (
    Bool(), I8, U8, I16, U16, I32, U32, I64, U64, F32, F64, F64, String(), String(5), TIME, DURATION, INNER,
)  # fmt: skip
_LISTS: Sequence[Type] = (
    List(U8), List(I16, 2), List(I32), List(I64), List(U64, None, 2), List(F32), List(F64), List(F64, 3), List(Bool()),
    List(String()), List(String(4), None, 3), List(DURATION), List(INNER), List(INNER, 2), List(INNER, None, 2),
)  # fmt: skip


PART = MessageType(
    "made/msg/Part",
    (Field("flag", Bool()), Field("i32", I32), Field("name", String()), Field("f64", F64), Field("inner", INNER),
     Field("i64s", List(I64)), Field("inners", List(INNER)), Field("names", List(String())), Field("is", Bool())),
)  # fmt: skip
"""Messages that a payload of a frame can fill as a whole."""

_PARTS: Sequence[Type] = (PART, List(PART), List(PART), List(PART, 2), List(PART, None, 2))


def ros_target(noise: random.Random, *, is_frame: bool = False) -> MessageType:
    """One to three fields, behind one that shifts their alignment."""
    kinds = (_SCALARS, _LISTS, *([_PARTS] if is_frame else ()))
    types = [noise.choice(noise.choice(kinds)) for _ in range(noise.choice((1, 1, 2, 3)))]
    return MessageType(
        "made/msg/Target", (Field("before", U8), *(Field(f"it_{place}", each) for place, each in enumerate(types)))
    )


def protobuf_fields(noise: random.Random) -> list[Field]:
    """Some fields of the payload `target`."""
    fields = language_wire()[1].cases["target"].type.fields
    return noise.sample(fields, noise.choice((1, 1, 2, 3)))


# ---- messages from ROS

_TEXTS = ("", "a", "ab", "é", "wheel", "\U0001f600", "abcdefgh" * 3, "\t a b\n", "ab\0\0", " \0")
_EDGES = (0.0, -0.0, 0.5, 1.0, -1.5, 2.5, 90.0, 1e-45, 3.4028234663852886e38, 1e9, 9007199254740992.0, 1.7e308,
          -1e300, 9.223372036854775e18, 2.0**63, 2.0**64, math.inf, -math.inf, math.nan)  # fmt: skip


def ros_message(noise: random.Random, declared: MessageType) -> dict[str, Any]:
    """A message of a `ros_source`. Text that is not UTF-8 is bytes."""
    made = {field.name: ros_value(noise, field.type) for field in declared.fields}
    if noise.randrange(4) == 0:
        made["name"] = b"\xffa"
        made["names"].insert(0, b"\xed\xa0\x80")
    return made


def ros_value(noise: random.Random, declared: Type) -> Any:
    match declared:
        case Bool():
            return noise.randrange(2) == 1
        case Int():
            low, high = declared.low, declared.high
            edges = [each for each in (*_INTEGERS, low, high) if low <= each <= high]
            return noise.choice(edges) if noise.randrange(2) else noise.randint(low, high)
        case Float(32):
            real = noise.choice([each for each in _EDGES if not 3.5e38 < abs(each) < math.inf])
            return struct.unpack("<f", struct.pack("<f", real))[0]
        case Float():
            return noise.choice(_EDGES) if noise.randrange(2) else round(noise.uniform(-1000, 1000), 2)
        case String():
            return noise.choice(_TEXTS)
        case List(element, length, bound):
            most = 5 if bound is None else bound
            count = noise.choice([0, 1, 2, 2, 2, 3, most]) if length is None else length
            return [ros_value(noise, element) for _ in range(count)]
        case MessageType():
            return {field.name: ros_value(noise, field.type) for field in declared.fields}
        case _:
            raise TypeError(declared)


class _NotUtf8(str):
    """Text that is encoded as other bytes."""

    __slots__ = ("octets",)

    octets: bytes

    def encode(self, encoding: str = "utf-8", errors: str = "strict") -> bytes:
        return self.octets


def as_written(value: Any) -> Any:
    """A value of `ros_value` for router.rehearsal.cdr, which encodes text itself."""
    match value:
        case bytes():
            made = _NotUtf8()
            made.octets = value
            return made
        case list():
            return [as_written(each) for each in value]
        case dict():
            return {name: as_written(each) for name, each in value.items()}
        case _:
            return value
