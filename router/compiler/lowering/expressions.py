"""From the Python syntax of a checked expression to operations that give the same value, or refuse the same messages.

`compiler.expressions` has made the syntax, `compiler.conversion` has put checks and conversions around it. Whatever has
no operation raises NeedsPython.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from google.protobuf.descriptor import FieldDescriptor

from router.compiler.expressions.functions import NS_PER_MILLISECOND, NS_PER_SECOND
from router.compiler.lowering.operations import (
    MAX_DATAGRAM,
    MOST_TEXT,
    Code,
    Compared,
    Node,
    Op,
    Operation,
    Relation,
    Slot,
)
from router.compiler.lowering.values import (
    EXACT,
    INT64,
    Integer,
    NeedsPython,
    Octets,
    Real,
    Rounded,
    Text,
    Truth,
    Type,
    Value,
    alike,
    common,
    in_range,
    integer,
    joined,
    real,
    signed,
    text,
    to_real,
    unsigned,
    want_signed,
)
from router.types.descriptors import message_of

_ELEMENTS = 0, 0xFFFF_FFFF

_RELATIONS = {
    ast.Eq: Relation.EQUAL,
    ast.NotEq: Relation.UNEQUAL,
    ast.Lt: Relation.LESS,
    ast.LtE: Relation.LESS_OR_EQUAL,
    ast.Gt: Relation.MORE,
    ast.GtE: Relation.MORE_OR_EQUAL,
}
_INTEGERS: Mapping[type[ast.operator], Op] = {ast.Add: Op.ADD, ast.Sub: Op.SUBTRACT, ast.Mult: Op.MULTIPLY}
_REALS: Mapping[type[ast.operator], Op] = {
    ast.Add: Op.REAL_ADD,
    ast.Sub: Op.REAL_SUBTRACT,
    ast.Mult: Op.REAL_MULTIPLY,
    ast.Div: Op.REAL_DIVIDE,
    ast.FloorDiv: Op.REAL_FLOOR_DIVIDE,
    ast.Mod: Op.REAL_MODULO,
    ast.Pow: Op.REAL_POWER,
}
_ROUNDINGS = {"round": Op.ROUND, "trunc": Op.TRUNCATE, "floor": Op.FLOOR, "ceil": Op.CEIL}
_OF_ONE = {"sqrt": Op.SQRT, "sin": Op.SIN, "cos": Op.COS, "tan": Op.TAN}
_OF_TWO = {"atan2": Op.ATAN2, "hypot": Op.HYPOT}
_FACTORS = {"radians": math.pi / 180, "degrees": 180 / math.pi}
_TIMES = {"time_from_seconds": NS_PER_SECOND, "time_from_milliseconds": NS_PER_MILLISECOND}

_RANGES = {
    FieldDescriptor.TYPE_ENUM: (-(1 << 31), (1 << 31) - 1),
    FieldDescriptor.TYPE_INT32: (-(1 << 31), (1 << 31) - 1),
    FieldDescriptor.TYPE_SINT32: (-(1 << 31), (1 << 31) - 1),
    FieldDescriptor.TYPE_SFIXED32: (-(1 << 31), (1 << 31) - 1),
    FieldDescriptor.TYPE_UINT32: (0, (1 << 32) - 1),
    FieldDescriptor.TYPE_FIXED32: (0, (1 << 32) - 1),
    FieldDescriptor.TYPE_INT64: INT64,
    FieldDescriptor.TYPE_SINT64: INT64,
    FieldDescriptor.TYPE_SFIXED64: INT64,
    FieldDescriptor.TYPE_UINT64: (0, (1 << 64) - 1),
    FieldDescriptor.TYPE_FIXED64: (0, (1 << 64) - 1),
}


@dataclass(frozen=True, slots=True)
class Listed:
    """A repeated field, or bytes: `code` goes where it is, `slot` holds it, `field` declares its elements."""

    code: Code
    slot: Slot
    field: FieldDescriptor

    @property
    def is_octets(self) -> bool:
        return not self.field.is_repeated


@dataclass(slots=True)
class Names:
    """What names mean in the expressions of a target: messages, and values in slots.

    `temporaries` are slots beside those of fields, `elements` the nodes that elements of lists are read into. `joined`
    counts the bytes of text that is put together.
    """

    messages: dict[str, Node]
    values: dict[str, tuple[Slot, Type]]
    temporaries: list[Slot] = field(default_factory=list)
    elements: list[Node] = field(default_factory=list)
    joined: int = 0

    def temporary(self) -> Slot:
        self.temporaries.append(Slot(0))
        return self.temporaries[-1]

    def element(self, declared: FieldDescriptor) -> Node:
        self.elements.append(Node(message_of(declared)))
        return self.elements[-1]


@dataclass(frozen=True, slots=True)
class Lowering:
    """Lowers the expressions of a target."""

    names: Names

    def value(self, node: ast.expr) -> Value:  # noqa: C901, PLR0912 - a case a syntax
        match node:
            case ast.Constant():
                return _constant(node.value)
            case ast.Name():
                return self._name(node.id)
            case ast.NamedExpr(ast.Name(name), inner):
                return self._named(name, self.value(inner))
            case ast.UnaryOp():
                return _unary(node.op, self.value(node.operand))
            case ast.BinOp():
                return self._binary(node)
            case ast.BoolOp():
                op = Op.AND if isinstance(node.op, ast.And) else Op.OR
                return Value(_chained(op, [self.value(each).code for each in node.values]), Truth())
            case ast.Compare():
                return self._compare(node)
            case ast.IfExp():
                return self._choice(node)
            case ast.Call(ast.Attribute(holder, "HasField"), [ast.Constant(str(member))]):
                code, message = self.message(holder)
                return Value((*code, Operation(Op.LOAD, message.presence(member))), Truth())
            case ast.Attribute() | ast.Call(ast.Name("getattr")):
                return self._field(node)
            case ast.Subscript(holder, ast.Constant(int(index))):
                return self._element(self.listed(holder), index)
            case ast.Call(ast.Name(name)):
                return self._call(name, node.args)
            case _:
                raise NeedsPython(f"{type(node).__name__} has no operation")

    # fields

    def message(self, node: ast.expr) -> tuple[Code, Node]:
        """The message that an expression is, and what has to be done before its fields are there."""
        match node:
            case ast.Name(name) if name in self.names.messages:
                return (), self.names.messages[name]
            case ast.Subscript(holder, ast.Constant(int(index))):
                listed = self.listed(holder)
                entered = self.names.element(listed.field)
                operations = Operation(Op.ELEMENT, listed.slot, number=index), Operation(Op.ENTER, entered)
                return (*listed.code, *operations), entered
            case _ if (member := _member(node)) is not None:
                code, holder_node = self.message(member[0])
                return code, holder_node.message(readable(holder_node, member[1]).name)
        raise NeedsPython("it uses whole messages")

    def listed(self, node: ast.expr) -> Listed:
        """The list that an expression is."""
        match node:
            case ast.Call(ast.Name("checked_texts"), [inner]):
                made = self.listed(inner)
                check = Operation(Op.EACH, made.slot, size=3), *map(Operation, (Op.UTF8, Op.DROP, Op.AGAIN))
                return replace(made, code=(*made.code, *check))
        if (member := _member(node)) is None:
            is_map = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "entries"
            raise NeedsPython("it reads a map" if is_map else "it makes a list")
        code, holder = self.message(member[0])
        declared = readable(holder, member[1])
        is_octets = declared.type == FieldDescriptor.TYPE_BYTES
        if not declared.is_repeated and not is_octets:
            raise NeedsPython("it uses whole messages")
        return Listed(code, holder.value(declared.name), declared)

    def _field(self, node: ast.expr) -> Value:
        member = _member(node)
        assert member is not None  # noqa: S101 - its callers have matched one
        code, holder = self.message(member[0])
        declared = readable(holder, member[1])
        if declared.is_repeated or declared.message_type is not None:
            raise NeedsPython("it uses whole messages")
        return Value((*code, Operation(Op.LOAD, holder.value(declared.name))), type_of(declared))

    def _element(self, listed: Listed, index: int) -> Value:
        if listed.is_octets or listed.field.message_type is not None:
            raise NeedsPython("it uses whole messages")
        return Value((*listed.code, Operation(Op.ELEMENT, listed.slot, number=index)), type_of(listed.field))

    # names

    def _name(self, name: str) -> Value:
        if name not in self.names.values:
            raise NeedsPython("it uses whole messages" if name in self.names.messages else f"it uses {name}")
        slot, kind = self.names.values[name]
        return Value((Operation(Op.LOAD, slot),), kind)

    def _named(self, name: str, value: Value) -> Value:
        slot = self.names.temporary()
        self.names.values[name] = slot, value.type
        return value.then(Op.KEEP, slot=slot)  # type: ignore[arg-type]

    # operators

    def _binary(self, node: ast.BinOp) -> Value:
        left, right = self.value(node.left), self.value(node.right)
        if isinstance(left.type, Text) and isinstance(right.type, Text):
            return self._joined(left, right)
        if isinstance(left.type, Integer) and isinstance(right.type, Integer):
            if isinstance(node.op, ast.Pow):
                assert isinstance(node.right, ast.Constant)  # noqa: S101 - exponents are literals
                return self._power(left, left.type, node.right.value)  # type: ignore[arg-type]
            return _of_integers(node.op, left, left.type, right, right.type)
        is_rounded = not isinstance(left.type, Real) and not isinstance(right.type, Real)
        if is_rounded and not isinstance(node.op, ast.Div):
            raise NeedsPython("it computes with a rounded number, which has no bounds: clamp() gives it some")
        left, right = to_real(left, exactly=is_rounded), to_real(right, exactly=is_rounded)
        return Value((*left.code, *right.code, Operation(_REALS[type(node.op)])), Real())

    def _joined(self, left: Value, right: Value) -> Value:
        assert isinstance(left.type, Text)  # noqa: S101 - seen by the caller
        assert isinstance(right.type, Text)  # noqa: S101
        most = left.type.most + right.type.most
        self._count_text(most)
        return Value((*left.code, *right.code, Operation(Op.JOIN)), Text(most))

    def _count_text(self, most: int) -> None:
        self.names.joined += most
        if self.names.joined > MOST_TEXT:
            raise NeedsPython("its text may be too long")

    def _power(self, base: Value, kind: Integer, exponent: int) -> Value:
        if exponent == 0:
            return Value((*base.then(Op.DROP).code, *integer(1).code), Integer(1, 1))
        powers = [kind.low**exponent, kind.high**exponent, *[0] * (kind.low < 0 < kind.high)]
        result = in_range(min(powers), max(powers))
        slot = self.names.temporary()
        again = (Operation(Op.LOAD, slot), Operation(Op.MULTIPLY)) * (exponent - 1)
        return Value((*base.code, Operation(Op.KEEP, slot), *again), result)

    def _compare(self, node: ast.Compare) -> Value:
        """Each operand is evaluated once, and none behind a comparison that is false."""
        if any(isinstance(op, (ast.In, ast.NotIn)) for op in node.ops):
            return self._contains(node)
        operands = [self.value(each) for each in (node.left, *node.comparators)]
        inner = [self._named(f"compared {len(self.names.temporaries)}", each) for each in operands[1:-1]]
        kept = [operands[0], *inner, operands[-1]]
        parts = []
        for place, (op, (left, right)) in enumerate(zip(node.ops, pairwise(kept), strict=True)):
            first = left if place == 0 else Value((Operation(Op.LOAD, left.code[-1].slot),), left.type)
            parts.append(_compared(_RELATIONS[type(op)], first, right).code)
        return Value(_chained(Op.AND, parts), Truth())

    def _contains(self, node: ast.Compare) -> Value:
        """`x in [a, b]`: all elements are evaluated, as Python makes the list first."""
        match node.ops, node.comparators:
            case [ast.In() | ast.NotIn() as op], [ast.List(elements)]:
                pass
            case _:
                raise NeedsPython("it looks into a list of the message")
        sought = self._named(f"sought {len(self.names.temporaries)}", self.value(node.left))
        again = Value((Operation(Op.LOAD, sought.code[-1].slot),), sought.type)
        found = [*sought.code, Operation(Op.DROP), *integer(0).code]
        for each in elements:
            found += *_compared(Relation.EQUAL, again, self.value(each)).code, Operation(Op.EITHER)
        made = Value(tuple(found), Truth())
        return made.then(Op.NOT) if isinstance(op, ast.NotIn) else made

    def _choice(self, node: ast.IfExp) -> Value:
        test = self.value(node.test)
        body, orelse = alike([self.value(node.body), self.value(node.orelse)])
        skip_body = Operation(Op.UNLESS, len(body.code) + 1)
        skip_else = Operation(Op.JUMP, len(orelse.code))
        return Value((*test.code, skip_body, *body.code, skip_else, *orelse.code), common([body, orelse]))

    # functions

    def _call(self, name: str, arguments: Sequence[ast.expr]) -> Value:
        if name == "len":
            return self._length(arguments[0])
        if name == "entries":
            raise NeedsPython("it reads a map")
        values = [self.value(each) for each in arguments]
        if name in _ROUNDINGS:
            return _rounded(_ROUNDINGS[name], values[0])
        if name in _OF_ONE:
            return to_real(values[0]).then(_OF_ONE[name])
        if name in _OF_TWO:
            return Value((*joined(*(to_real(each).code for each in values)), Operation(_OF_TWO[name])), Real())
        if name in _FACTORS:
            return Value((*to_real(values[0]).code, *real(_FACTORS[name]).code, Operation(Op.REAL_MULTIPLY)), Real())
        if name in _TIMES:
            return _time(values[0], _TIMES[name])
        if name == "str":
            return self._text(values[0])
        if name in _FUNCTIONS:
            return _FUNCTIONS[name](*values)
        raise NeedsPython(f"{name}() has no operation")

    def _length(self, node: ast.expr) -> Value:
        try:
            listed = self.listed(node)
        except NeedsPython:
            measured = self.value(node)
            if not isinstance(measured.type, Text):
                raise
            return measured.then(Op.CHARACTERS, Integer(*_ELEMENTS))
        return Value((*listed.code, Operation(Op.COUNT, listed.slot)), Integer(*_ELEMENTS))

    def _text(self, value: Value) -> Value:
        match value.type:
            case Text():
                return value
            case Integer() as kind:
                self._count_text(most := 20)
                return value.then(Op.DECIMAL, Text(most), flag=not kind.is_signed)
            case Truth():
                yes, no = text("True"), text("False")
                code = Operation(Op.UNLESS, len(yes.code) + 1), *yes.code, Operation(Op.JUMP, len(no.code)), *no.code
                return Value((*value.code, *code), Text(len("False")))
            case _:
                raise NeedsPython("only Python writes a float as text")


# ---- fields


def _member(node: ast.expr) -> tuple[ast.expr, str] | None:
    """The holder and the name of a field."""
    match node:
        case ast.Attribute(holder, name):
            return holder, name
        case ast.Call(ast.Name("getattr"), [holder, ast.Constant(str(name))]):
            return holder, name
    return None


def readable(holder: Node, name: str) -> FieldDescriptor:
    """The field of a message, if the carrier reads it as protobuf does."""
    declared = holder.descriptor.fields_by_name[name]
    if declared.type == FieldDescriptor.TYPE_GROUP:
        raise NeedsPython(f"{name} is a group")
    if declared.message_type is not None and declared.message_type.GetOptions().map_entry:
        raise NeedsPython(f"{name} is a map")
    together = declared.containing_oneof.fields if declared.containing_oneof is not None else [declared]
    if any(each.enum_type is not None and each.enum_type.is_closed for each in together):
        raise NeedsPython(f"{name} is, or excludes, a closed enum")
    return declared


def type_of(declared: FieldDescriptor) -> Type:
    """The type of a scalar field, or of an element of it."""
    if declared.type in _RANGES:
        return Integer(*_RANGES[declared.type])
    match declared.type:
        case FieldDescriptor.TYPE_BOOL:
            return Truth()
        case FieldDescriptor.TYPE_STRING:
            return Text(MAX_DATAGRAM)
        case FieldDescriptor.TYPE_BYTES:
            return Octets()
        case _:
            return Real()


# ---- operators


def _constant(value: object) -> Value:
    match value:
        case bool():
            return Value(integer(value).code, Truth())
        case int():
            return integer(value)
        case float():
            return real(value)
        case str():
            return text(value)
    raise NeedsPython("it has bytes in it")


def _chained(op: Op, codes: Sequence[Code]) -> Code:
    """Several truths, of which those behind a decision are not evaluated."""
    left, made = sum(map(len, codes)) + len(codes) - 1, list[Operation]()
    for code in codes[:-1]:
        left -= len(code) + 1
        made += *code, Operation(op, left)
    return (*made, *codes[-1])


def _unary(op: ast.unaryop, value: Value) -> Value:
    match op, value.type:
        case ast.Not(), _:
            return value.then(Op.NOT)
        case ast.UAdd(), _:
            return value
        case _, Integer(low, high):
            return value.then(Op.NEGATE, in_range(-high, -low))
        case _, Rounded():
            return Value((*real(0.0).code, *value.code, Operation(Op.REAL_SUBTRACT)), Rounded())
        case _:
            return value.then(Op.REAL_NEGATE)


def _of_integers(op: ast.operator, left: Value, a: Integer, right: Value, b: Integer) -> Value:
    code = (*left.code, *right.code)
    if kind := _INTEGERS.get(type(op)):
        compute: Callable[[int, int], int] = {
            Op.ADD: int.__add__, Op.SUBTRACT: int.__sub__, Op.MULTIPLY: int.__mul__
        }[kind]  # fmt: skip
        results = [compute(x, y) for x in (a.low, a.high) for y in (b.low, b.high)]
        return Value((*code, Operation(kind)), in_range(min(results), max(results)))
    if isinstance(op, ast.Div):
        exact = to_real(left, exactly=True), to_real(right, exactly=True)
        return Value((*joined(*(each.code for each in exact)), Operation(Op.REAL_DIVIDE)), Real())
    if not signed(left, right) and not unsigned(left, right):
        raise NeedsPython("an integer in it may have more than 63 bits")
    flag = not signed(left, right)
    if isinstance(op, ast.Mod):
        return Value((*code, Operation(Op.MODULO, flag=flag)), in_range(min(b.low + 1, 0), max(b.high - 1, 0)))
    divisors = [y for y in (b.low, b.high, -1, 1) if b.low <= y <= b.high and y != 0]
    quotients = [x // y for x in (a.low, a.high) for y in divisors] or [0]
    return Value((*code, Operation(Op.DIVIDE, flag=flag)), in_range(min(quotients), max(quotients)))


def _compared(relation: Relation, left: Value, right: Value) -> Value:
    left, right = alike([left, right])
    if isinstance(left.type, (Text, Octets)):
        how = Compared.TEXTS
    elif isinstance(left.type, (Real, Rounded)):
        how = Compared.REALS
    elif isinstance(left.type, Truth) or signed(left, right):
        how = Compared.SIGNED_INTEGERS
    elif unsigned(left, right):
        how = Compared.UNSIGNED_INTEGERS
    else:
        raise NeedsPython("an integer in it may have more than 63 bits")
    return Value((*left.code, *right.code, Operation(Op.COMPARE, int(how), flag=relation)), Truth())


# ---- functions


def _rounded(kind: Op, value: Value) -> Value:
    return value.then(kind, Rounded()) if isinstance(value.type, Real) else value


def _absolute(value: Value) -> Value:
    match value.type:
        case Integer(low, high):
            least = 0 if low <= 0 <= high else min(abs(low), abs(high))
            made = in_range(least, max(abs(low), abs(high)))
            return value.then(Op.ABSOLUTE, made) if low < 0 else value
        case _:
            return value.then(Op.REAL_ABSOLUTE)


def _extreme(integers: Op, reals: Op, pick: Callable[[list[int]], int]) -> Callable[..., Value]:
    def lowered(*values: Value) -> Value:
        first, *others = alike(values)
        made, result = [*first.code], common([first, *others])
        is_integer = isinstance(result, Integer)
        if isinstance(result, Integer):
            want_signed(first, *others)
            bounds = [each.type for each in (first, *others) if isinstance(each.type, Integer)]
            result = Integer(pick([each.low for each in bounds]), pick([each.high for each in bounds]))
        for each in others:
            made += *each.code, Operation(integers if is_integer else reals)
        return Value(tuple(made), result)

    return lowered


def _clamped(x: Value, low: Value, high: Value) -> Value:
    code = joined(x.code, low.code, high.code)
    if isinstance(low.type, Integer) and isinstance(high.type, Integer) and isinstance(x.type, (Integer, Rounded)):
        want_signed(low, high)
        result = Integer(min(low.type.low, high.type.low), max(low.type.high, high.type.high))
        if isinstance(x.type, Rounded):
            return Value((*code, Operation(Op.REAL_CLAMP_TO_INTEGER)), result)
        want_signed(x)
        return Value((*code, Operation(Op.CLAMP)), result)
    values = alike([x, low, high])
    return Value((*joined(*(each.code for each in values)), Operation(Op.REAL_CLAMP)), common(values))


def fit(x: Value, low: Value, high: Value) -> Value:
    """An integer that is refused outside of two bounds, which are constants."""
    assert isinstance(low.type, Integer)  # noqa: S101 - both are limits of a field's type
    assert isinstance(high.type, Integer)  # noqa: S101
    if isinstance(x.type, Integer):
        if low.type.low <= x.type.low and x.type.high <= high.type.high:
            return x
        want_signed(x)
    want_signed(low, high)
    op = Op.FIT if isinstance(x.type, Integer) else Op.REAL_FIT_TO_INTEGER
    return Value((*x.code, *low.code, *high.code, Operation(op)), Integer(low.type.low, high.type.high))


def _wrapped(x: Value, low: Value, high: Value) -> Value:
    want_signed(low, high)
    assert isinstance(low.type, Integer)  # noqa: S101 - the last line wants it
    assert isinstance(high.type, Integer)  # noqa: S101
    if low.type.high > high.type.low:
        raise NeedsPython("the bounds of wrap() may be in the wrong order")
    size = in_range(high.type.low - low.type.high + 1, high.type.high - low.type.low + 1)
    if not size.is_signed:
        raise NeedsPython("the bounds of wrap() are too far from each other")
    if isinstance(x.type, Rounded):
        if size.low != size.high or size.high > EXACT:
            raise NeedsPython("wrap() of a rounded number has bounds that are no constants")
        remainder = (*x.code, *real(size.high).code, Operation(Op.REAL_REMAINDER))
        x = fit(Value(remainder, Rounded()), integer(-size.high), integer(size.high))
    assert isinstance(x.type, Integer)  # noqa: S101 - wrap() takes integers
    want_signed(x)
    in_range(x.type.low - low.type.high, INT64[1])
    in_range(INT64[0], x.type.high - low.type.low)
    return Value((*x.code, *low.code, *high.code, Operation(Op.WRAP)), Integer(low.type.low, high.type.high))


def _time(value: Value, factor: int) -> Value:
    """Nanoseconds. Beyond 64 bits there is no time."""
    match value.type:
        case Integer() as kind:
            operation = Operation(Op.TIME, flag=not kind.is_signed, number=factor)
            return Value((*value.code, operation), Integer(*INT64))
        case Rounded():
            return _time(fit(value, integer(INT64[0]), integer(INT64[1])), factor)
        case _:
            product = Value((*value.code, *real(factor).code, Operation(Op.REAL_MULTIPLY)), Real())
            return fit(_rounded(Op.ROUND, product), integer(INT64[0]), integer(INT64[1]))


def _int(value: Value) -> Value:
    return Value(value.code, Integer(0, 1)) if isinstance(value.type, Truth) else value


def _fit_text(value: Value, most: Value) -> Value:
    assert isinstance(most.type, Integer)  # noqa: S101 - the limit of a field's type
    operation = Operation(Op.FIT_SIZE, number=most.type.high)
    return Value((*value.code, operation), value.type)


_FUNCTIONS: Mapping[str, Callable[..., Value]] = {
    "abs": _absolute,
    "checked_text": lambda text: text.then(Op.UTF8),
    "min": _extreme(Op.LEAST, Op.REAL_LEAST, min),
    "max": _extreme(Op.GREATEST, Op.REAL_GREATEST, max),
    "clamp": _clamped,
    "wrap": _wrapped,
    "fit": fit,
    "fit_text": _fit_text,
    "float32": lambda x: to_real(x).then(Op.FLOAT32),
    "float64": to_real,
    "int": _int,
    "seconds": lambda time: time.then(Op.SECONDS, Real()),
}
