"""Checks an expression of the table and turns it into Python syntax: names resolved, kinds inferred.

A closed subset of Python. The result is a syntax tree whose nodes carry the line and column of the
route table, ready to be grafted into a generated function. Knows nothing of targets; `mapping` does.
"""

from __future__ import annotations

import ast
import keyword
import math
import operator
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from router.compiler.functions import FUNCTIONS, Function
from router.compiler.kinds import (
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    MessageKind,
    Number,
    StringKind,
    TimeKind,
    as_int,
    float_bits,
    join,
    kind_of,
)
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean
from router.table.model import Expression
from router.types.model import Enum, Field, Int, MessageType, Type

MESSAGE, SOURCE, RECEIVED_AT = "message", "source", "received_at"
ALLOWED = "allowed: fields, literals, arithmetic, comparison, and/or/not, if/else, functions"
LARGEST_EXPONENT = 8
DEEPEST = 60
"""How deep an expression may nest: what handles syntax trees, ours and Python's own, does so recursively."""
WIDEST = 512
"""How many bits an integer may have on the way to a field."""


class Finding(Exception):
    """Ends the check of one expression with the first thing that is wrong in it."""

    def __init__(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.diagnostic = Diagnostic(span, code, message, hint)


@dataclass(frozen=True, slots=True)
class Typed:
    """A checked expression: what it is, as Python, and which stretch of the table says so.

    `items` are the elements of a list literal; `path` leads to a submessage of the source message.
    """

    kind: Kind
    node: ast.expr
    span: SourceSpan
    items: tuple[Typed, ...] | None = None
    path: tuple[str, ...] | None = None

    @property
    def constant(self) -> object:
        """The value of a literal, None for everything else (there is no None in the language)."""
        return self.node.value if isinstance(self.node, ast.Constant) else None


@dataclass(slots=True)
class Locals:
    """Submessages that expressions of one target look into, each bound once to a local variable."""

    message: str = "m"
    bound: dict[tuple[str, ...], str] = field(default_factory=dict)

    def name(self, path: tuple[str, ...]) -> str:
        """The variable that holds the submessage at this path; the empty path is the message."""
        if not path:
            return self.message
        if path not in self.bound:
            self.name(path[:-1])  # a submessage's own holder comes before it
            name = "_".join((self.message, *path))
            while name in self.bound.values():  # a.b_c and a_b.c
                name += "_"
            self.bound[path] = name
        return self.bound[path]


@dataclass(slots=True)
class Scope:
    """What names mean in the expressions of one target.

    `enums` are the protobuf enums by full name, `ros_types` the ROS types whose constants are visible.
    """

    message: MessageType
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    locals: Locals

    def field_names(self) -> list[str]:
        return [member.name for member in self.message.fields]

    def holders(self, name: str) -> list[Enum | MessageType]:
        """The enums, else ROS types, that `name` may mean; an enum of the message itself comes first."""
        named = [enum for enum in self.enums if enum.name == name or enum.name.endswith(f".{name}")]
        own = [enum for enum in named if enum.name == f"{self.message.name}.{name}"]
        exact = [enum for enum in named if enum.name == name]
        return list(own or exact or named) + [ros for ros in self.ros_types if ros.short_name == name]


def check(expression: Expression, scope: Scope, expected: Type | None = None) -> Typed:
    """Raises Finding. `expected` is the field to be filled, which gives clamp() and wrap() their bounds."""
    if expression.items is not None:
        items = [check(item, scope) for item in expression.items]
        return _Checker(expression, scope).list_of(items, expression.span)
    return _Checker(expression, scope).check(_parse(expression), expected)


def _parse(expression: Expression) -> ast.expr:
    text = expression.text.replace("\n", " ")
    indent = len(text) - len(text.lstrip())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            return ast.parse(text.strip(), mode="eval").body
    except SyntaxError as error:
        start = max(error.offset or 1, 1) - 1 + indent
        end = error.end_offset - 1 + indent if error.end_offset and error.end_lineno == error.lineno else start + 1
        reason = (error.msg or "cannot be read").removesuffix(" (<unknown>, line 1)")
        raise Finding(expression.part(start, end), Code.EXPRESSION_SYNTAX, f"not an expression: {reason}") from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise Finding(expression.span, Code.EXPRESSION_SYNTAX, f"not an expression: {error}") from None


_ARITHMETIC: dict[type[ast.operator], Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
_OPERATORS = (*_ARITHMETIC, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow)
_COMPARISONS = (ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.In, ast.NotIn)
_HINTS = {
    ast.Lambda: "expressions have no lambda",
    ast.ListComp: "expressions have no loops",
    ast.GeneratorExp: "expressions have no loops",
    ast.SetComp: "expressions have no loops",
    ast.DictComp: "expressions have no loops",
    ast.NamedExpr: "expressions assign nothing",
    ast.JoinedStr: "join strings with + and str()",
    ast.Tuple: "write a list, [a, b]",
}


class _Checker:
    """One expression. Each method takes a syntax node of the user's and returns it checked and resolved."""

    def __init__(self, expression: Expression, scope: Scope) -> None:
        self.expression = expression
        self.scope = scope
        self.indent = len(expression.text) - len(expression.text.lstrip())
        self.encoded = expression.text.lstrip().encode(errors="replace")
        self.depth = 0

    def check(self, node: ast.expr, expected: Type | None = None) -> Typed:
        method = getattr(self, f"check_{type(node).__name__}", None)
        if method is None:
            hint = _HINTS.get(type(node), ALLOWED)
            raise self.finding(node, Code.FORBIDDEN_EXPRESSION, f"{_describe(node)} is not part of the language", hint)
        self.depth += 1
        if self.depth > DEEPEST:
            raise self.finding(node, Code.EXPRESSION_SYNTAX, "not an expression: nested too deeply")
        typed: Typed = method(node, expected) if isinstance(node, (ast.Call, ast.IfExp)) else method(node)
        self.depth -= 1
        return typed

    # positions

    def span(self, node: ast.expr) -> SourceSpan:
        end = node.end_col_offset if node.end_col_offset is not None else node.col_offset + 1
        return self.expression.part(self._characters(node.col_offset), self._characters(end))

    def _characters(self, offset: int) -> int:
        """ast counts UTF-8 bytes, people count characters."""
        return self.indent + len(self.encoded[:offset].decode(errors="replace"))

    def finding(self, node: ast.expr, code: Code, message: str, hint: str = "") -> Finding:
        return Finding(self.span(node), code, message, hint)

    def typed(self, kind: Kind, made: ast.expr, origin: ast.expr) -> Typed:
        span = self.span(origin)
        return Typed(kind, placed(made, span), span)

    # literals and names

    def check_Constant(self, node: ast.Constant) -> Typed:
        match node.value:
            case bool():
                kind: Kind = BoolKind()
            case int(number):
                kind = self._within_bounds(IntKind(number, number), node)
            case float(number):
                if not math.isfinite(number):
                    raise self.finding(node, Code.OUT_OF_RANGE, "a literal this large is infinite")
                kind = FloatKind(32)
            case str():
                kind = StringKind()
            case _:
                raise self.finding(node, Code.FORBIDDEN_EXPRESSION, f"{_describe(node)} is not part of the language",
                                   "literals are numbers, strings, True and False")  # fmt: skip
        return self.typed(kind, ast.Constant(node.value), node)

    def check_List(self, node: ast.List) -> Typed:
        return self.list_of([self.check(item) for item in node.elts], self.span(node))

    def list_of(self, items: Sequence[Typed], span: SourceSpan) -> Typed:
        element: Kind | None = items[0].kind if items else None
        for item in items[1:]:
            element = join(element, item.kind) if element else None
            if element is None:
                raise Finding(item.span, Code.TYPE_MISMATCH, f"a list of {items[0].kind} cannot hold {item.kind}")
        made = ast.List([item.node for item in items], ast.Load())
        place(made, span)
        return Typed(ListKind(element, len(items)), made, span, items=tuple(items))

    def check_Name(self, node: ast.Name) -> Typed:
        name = node.id
        if member := self.scope.message.field(name):
            return self._read((), member, node)
        if name == MESSAGE:
            typed = self.typed(MessageKind(self.scope.message), _name(self.scope.locals.name(())), node)
            return replace(typed, path=())
        if name == SOURCE:
            return self.typed(StringKind(), _name(SOURCE), node)
        if name == RECEIVED_AT:
            return self.typed(TimeKind(), _name(RECEIVED_AT), node)
        if name in ("true", "false"):
            return self.typed(BoolKind(), ast.Constant(name == "true"), node)
        if name in FUNCTIONS or name == "has":
            raise self.finding(node, Code.WRONG_ARGUMENTS, f"'{name}' is a function", f"call it: {name}(...)")
        if self.scope.holders(name):
            raise self.finding(node, Code.TYPE_MISMATCH, f"'{name}' is an enum, not a value", f"name one: {name}.VALUE")
        known = [*self.scope.field_names(), MESSAGE, SOURCE, RECEIVED_AT]
        raise self.finding(node, Code.UNKNOWN_FIELD, f"{self.scope.message} has no field '{name}'",
                           did_you_mean(name, known))  # fmt: skip

    def _read(self, holder: tuple[str, ...], member: Field, origin: ast.expr) -> Typed:
        """A field of the submessage at path `holder`."""
        return read(self.scope, holder, member, self.span(origin))

    def check_Attribute(self, node: ast.Attribute) -> Typed:
        dotted = _dotted(node)
        if dotted and not self._is_field_path(dotted[0]):
            return self._enum_value(node, dotted)
        holder = self.check(node.value)
        if not isinstance(holder.kind, MessageKind):
            raise self.finding(node, Code.FORBIDDEN_EXPRESSION, f"'.{node.attr}' of a {holder.kind}",
                               "only messages have fields")  # fmt: skip
        member = holder.kind.type.field(node.attr)
        if member is None:
            names = [member.name for member in holder.kind.type.fields]
            raise Finding(self._last(node), Code.UNKNOWN_FIELD, f"{holder.kind.type} has no field '{node.attr}'",
                          did_you_mean(node.attr, names))  # fmt: skip
        path = self._path(node.value)
        if path is not None:
            return self._read(path, member, node)
        return self.typed(kind_of(member.type), attribute(holder.node, member.name), node)

    def _is_field_path(self, name: str) -> bool:
        return name in (MESSAGE, SOURCE, RECEIVED_AT) or self.scope.message.field(name) is not None

    def _path(self, node: ast.expr) -> tuple[str, ...] | None:
        """The field path that a chain of names stands for, None when it goes through an index."""
        dotted = _dotted(node)
        if dotted is None:
            return None
        return dotted[1:] if dotted[0] == MESSAGE and self.scope.message.field(MESSAGE) is None else dotted

    def _last(self, node: ast.Attribute) -> SourceSpan:
        end = self._characters(node.end_col_offset or 0)
        return self.expression.part(end - len(node.attr), end)

    def _enum_value(self, node: ast.Attribute, dotted: tuple[str, ...]) -> Typed:
        name, value = ".".join(dotted[:-1]), dotted[-1]
        holders = self.scope.holders(name)
        if not holders:
            known = {known for enum in self.scope.enums for known in (enum.name, enum.name.rpartition(".")[2])}
            known |= {ros.short_name for ros in self.scope.ros_types if ros.constants}
            raise self.finding(node.value, Code.UNKNOWN_FIELD, f"{self.scope.message} has no field or enum '{name}'",
                               did_you_mean(name, known | set(self.scope.field_names())))  # fmt: skip
        found = [(holder, dict(_values(holder))[value]) for holder in holders if value in dict(_values(holder))]
        if not found:
            known = {value for holder in holders for value, _ in _values(holder)}
            raise Finding(self._last(node), Code.UNKNOWN_ENUM_VALUE, f"'{name}' has no value '{value}'",
                          did_you_mean(value, known))  # fmt: skip
        if len({number for _, number in found}) > 1:
            names = ", ".join(sorted(holder.name for holder, _ in found))
            raise self.finding(node, Code.UNKNOWN_ENUM_VALUE, f"'{name}.{value}' may be of {names}",
                               "write the enum's full name")  # fmt: skip
        holder, number = found[0]
        assert isinstance(number, (int, float, str))  # noqa: S101 - what constants can be
        if isinstance(holder, Enum):
            return self.typed(EnumKind(holder), ast.Constant(number), node)
        return self.check_Constant(ast.copy_location(ast.Constant(number), node))

    def check_Subscript(self, node: ast.Subscript) -> Typed:
        holder, index = self.check(node.value), self.check(node.slice)
        if not isinstance(holder.kind, ListKind) or holder.kind.element is None:
            raise self.finding(node, Code.TYPE_MISMATCH, f"a {holder.kind} has no elements", "only lists are indexed")
        if not isinstance(index.constant, int) or isinstance(index.constant, bool) or index.constant < 0:
            raise self.finding(node.slice, Code.FORBIDDEN_EXPRESSION, "an index is a literal integer from 0")
        if holder.kind.length is not None and index.constant >= holder.kind.length:
            message = f"index {index.constant} of {holder.kind.length} elements"
            raise self.finding(node.slice, Code.OUT_OF_RANGE, message)
        return self.typed(holder.kind.element, ast.Subscript(holder.node, index.node, ast.Load()), node)

    # operators

    def check_UnaryOp(self, node: ast.UnaryOp) -> Typed:
        operand = self.check(node.operand)
        if isinstance(node.op, ast.Not):
            self._want_bool(operand, "not")
            return self.typed(BoolKind(), ast.UnaryOp(node.op, operand.node), node)
        if not isinstance(node.op, (ast.USub, ast.UAdd)):
            raise self.finding(node, Code.FORBIDDEN_EXPRESSION, f"{_describe(node.op)} is not part of the language")
        self._want_number(operand)
        negative = isinstance(node.op, ast.USub)
        kind: Kind = as_int(operand.kind) or operand.kind
        if isinstance(kind, IntKind) and negative and kind.low is not None and kind.high is not None:
            kind = IntKind(-kind.high, -kind.low)
        if isinstance(operand.constant, (int, float)):
            return self.typed(kind, ast.Constant(-operand.constant if negative else operand.constant), node)
        return self.typed(kind, ast.UnaryOp(node.op, operand.node), node)

    def check_BinOp(self, node: ast.BinOp) -> Typed:
        if not isinstance(node.op, _OPERATORS):
            raise self.finding(node, Code.FORBIDDEN_EXPRESSION, f"{_describe(node.op)} is not part of the language")
        left, right = self.check(node.left), self.check(node.right)
        made = ast.BinOp(left.node, node.op, right.node)
        if isinstance(node.op, ast.Add) and isinstance(left.kind, StringKind) and isinstance(right.kind, StringKind):
            return self.typed(StringKind(), made, node)
        if isinstance(left.kind, TimeKind) or isinstance(right.kind, TimeKind):
            raise self.finding(node, Code.TYPE_MISMATCH, "times are not computed with", "use seconds(time) and back")
        self._want_number(left)
        self._want_number(right)
        if (
            isinstance(right.constant, (int, float))
            and right.constant == 0
            and isinstance(node.op, (ast.Div, ast.FloorDiv, ast.Mod))
        ):
            raise self.finding(node, Code.OUT_OF_RANGE, "division by zero")
        if isinstance(node.op, ast.Pow):
            self._want_small_exponent(right, node)
        kind = self._within_bounds(self._arithmetic(node, left.kind, right), node)
        return self._folded(self.typed(kind, made, node), left, right)

    def _folded(self, result: Typed, left: Typed, right: Typed) -> Typed:
        """Literals are computed here, so that what they come to is checked against the target."""
        if left.constant is None or right.constant is None:
            return result
        try:
            value = eval(compile(ast.Expression(result.node), "<literal>", "eval"), {})  # noqa: S307 - two literals
        except ArithmeticError as error:
            raise Finding(result.span, Code.OUT_OF_RANGE, str(error)) from None
        if isinstance(value, float) and not math.isfinite(value):
            raise Finding(result.span, Code.OUT_OF_RANGE, f"this is {value}")
        kind: Kind = IntKind(value, value) if isinstance(value, int) else result.kind
        made = ast.Constant(value)
        place(made, result.span)
        return Typed(kind, made, result.span)

    def _within_bounds(self, kind: Kind, node: ast.expr) -> Kind:
        """Keeps powers of powers from taking all memory, here and at run time."""
        if isinstance(kind, IntKind) and max((kind.low or 0).bit_length(), (kind.high or 0).bit_length()) > WIDEST:
            raise self.finding(node, Code.OUT_OF_RANGE, f"an integer has at most {WIDEST} bits")
        return kind

    def _arithmetic(self, node: ast.BinOp, left: Kind, right: Typed) -> Kind:
        op, a, b = node.op, as_int(left), as_int(right.kind)
        if a is None or b is None or isinstance(op, ast.Div):
            return FloatKind(max(float_bits(left), float_bits(right.kind)))
        if a.low is None or a.high is None or b.low is None or b.high is None:
            return IntKind(None, None)
        if compute := _ARITHMETIC.get(type(op)):
            corners = [compute(x, y) for x in (a.low, a.high) for y in (b.low, b.high)]
        elif isinstance(op, ast.Pow):
            assert isinstance(right.constant, int)  # noqa: S101 - _want_small_exponent() saw to it
            corners = [x**right.constant for x in (a.low, a.high)] + [0] * (a.low < 0 < a.high)
        elif b.low == b.high == 0:
            raise self.finding(node, Code.OUT_OF_RANGE, "division by zero")
        elif isinstance(op, ast.Mod):
            corners = [min(b.low + 1, 0), max(b.high - 1, 0)]
        else:
            divisors = [y for y in (b.low, b.high, -1, 1) if b.low <= y <= b.high and y != 0]
            corners = [x // y for x in (a.low, a.high) for y in divisors]
        return IntKind(min(corners), max(corners))

    def _want_small_exponent(self, exponent: Typed, node: ast.BinOp) -> None:
        value = exponent.constant
        if not isinstance(value, int) or not 0 <= value <= LARGEST_EXPONENT:
            message = f"an exponent is a literal integer from 0 to {LARGEST_EXPONENT}"
            raise self.finding(node.right, Code.FORBIDDEN_EXPRESSION, message, "use sqrt() for roots")

    def check_BoolOp(self, node: ast.BoolOp) -> Typed:
        word = "and" if isinstance(node.op, ast.And) else "or"
        values = [self.check(value) for value in node.values]
        for value in values:
            self._want_bool(value, word)
        return self.typed(BoolKind(), ast.BoolOp(node.op, [value.node for value in values]), node)

    def check_Compare(self, node: ast.Compare) -> Typed:
        operands = [self.check(operand) for operand in (node.left, *node.comparators)]
        for op, (left, right) in zip(node.ops, pairwise(operands), strict=True):
            self._want_comparable(node, op, left, right)
        made = ast.Compare(operands[0].node, node.ops, [operand.node for operand in operands[1:]])
        return self.typed(BoolKind(), made, node)

    def _want_comparable(self, node: ast.Compare, op: ast.cmpop, left: Typed, right: Typed) -> None:
        if not isinstance(op, _COMPARISONS):
            message = f"{_describe(op)} is not part of the language"
            raise self.finding(node, Code.FORBIDDEN_EXPRESSION, message, "use ==")
        other: Kind | None = right.kind
        if isinstance(op, (ast.In, ast.NotIn)):
            if not isinstance(right.kind, ListKind):
                raise Finding(right.span, Code.TYPE_MISMATCH, f"'in' looks into a list, not into {right.kind}")
            other = right.kind.element
        if other is None or isinstance(left.kind, (MessageKind, ListKind)) or join(left.kind, other) is None:
            raise self.finding(node, Code.TYPE_MISMATCH, f"{left.kind} cannot be compared with {right.kind}")
        if isinstance(op, (ast.Lt, ast.LtE, ast.Gt, ast.GtE)) and isinstance(left.kind, BoolKind):
            raise self.finding(node, Code.TYPE_MISMATCH, "bools have no order", "use == or !=")

    def check_IfExp(self, node: ast.IfExp, expected: Type | None) -> Typed:
        test = self.check(node.test)
        self._want_bool(test, "if")
        body, orelse = self.check(node.body, expected), self.check(node.orelse, expected)
        kind = join(body.kind, orelse.kind)
        if kind is None:
            raise self.finding(node, Code.TYPE_MISMATCH, f"this is {body.kind} or {orelse.kind}, which no field holds")
        return self.typed(kind, ast.IfExp(test.node, body.node, orelse.node), node)

    def _want_bool(self, operand: Typed, word: str) -> None:
        if not isinstance(operand.kind, BoolKind):
            hint = "compare it, as in x != 0" if isinstance(operand.kind, Number) else ""
            raise Finding(operand.span, Code.TYPE_MISMATCH, f"'{word}' takes a bool, not {operand.kind}", hint)

    def _want_number(self, operand: Typed) -> None:
        if not isinstance(operand.kind, Number):
            hint = {BoolKind: "int() makes a number of a bool", StringKind: "str() makes text of a number"}
            raise Finding(operand.span, Code.TYPE_MISMATCH, f"arithmetic takes numbers, not {operand.kind}",
                          hint.get(type(operand.kind), ""))  # fmt: skip

    # calls

    def check_Call(self, node: ast.Call, expected: Type | None) -> Typed:
        if not isinstance(node.func, ast.Name):
            hint = did_you_mean("", FUNCTIONS)
            raise self.finding(node.func, Code.FORBIDDEN_EXPRESSION, "only listed functions are called", hint)
        name = node.func.id
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self.finding(node, Code.WRONG_ARGUMENTS, f"{name}() takes its arguments by position")
        if name == "has":
            return self._has(node)
        function = FUNCTIONS.get(name)
        if function is None:
            raise self.finding(node.func, Code.UNKNOWN_FUNCTION, f"there is no function '{name}'",
                               did_you_mean(name, [*FUNCTIONS, "has"]))  # fmt: skip
        arguments = [self.check(argument) for argument in node.args]
        if function.optional and len(arguments) == len(function.parameters) - function.optional:
            arguments += self._bounds(node, function, expected)
        self._want_arguments(node, function, arguments)
        try:
            kind = function.result([argument.kind for argument in arguments])
        except ValueError as error:
            raise self.finding(node, Code.WRONG_ARGUMENTS, f"{name}(): {error}") from None
        return self.typed(kind, ast.Call(_name(name), [argument.node for argument in arguments], []), node)

    def _want_arguments(self, node: ast.Call, function: Function, arguments: Sequence[Typed]) -> None:
        takes = len(function.parameters)
        if len(arguments) < takes or (len(arguments) > takes and not function.variadic):
            count = f"{takes} argument{'s' * (takes != 1)}" + " or more" * function.variadic
            message = f"{function.name}() takes {count}, not {len(node.args)}"
            raise self.finding(node, Code.WRONG_ARGUMENTS, message, f"write {function.signature}")
        parameters = (*function.parameters, *[function.parameters[-1]] * (len(arguments) - takes))
        for parameter, argument in zip(parameters, arguments, strict=True):
            if not isinstance(argument.kind, parameter.accepts):
                message = f"{function.name}() takes {parameter.wanted} as '{parameter.name}', not {argument.kind}"
                raise Finding(argument.span, Code.WRONG_ARGUMENTS, message)

    def _bounds(self, node: ast.Call, function: Function, expected: Type | None) -> list[Typed]:
        if not isinstance(expected, Int):
            message = f"{function.name}() needs bounds here, where no integer field is filled"
            raise self.finding(node, Code.WRONG_ARGUMENTS, message, f"write {function.name}(x, low, high)")
        return [self.typed(IntKind(bound, bound), ast.Constant(bound), node) for bound in (expected.low, expected.high)]

    def _has(self, node: ast.Call) -> Typed:
        if len(node.args) != 1 or (path := self._path(node.args[0])) is None or not path:
            raise self.finding(node, Code.WRONG_ARGUMENTS, "has() takes one field")
        argument = self.check(node.args[0])
        holder: MessageType = self.scope.message
        for name in path[:-1]:
            inner = holder.field(name)
            if inner is None or not isinstance(inner.type, MessageType):
                raise self.finding(node, Code.WRONG_ARGUMENTS, "has() takes a field of the message")
            holder = inner.type
        member = holder.field(path[-1])
        if member is None or not member.has_presence:
            raise Finding(argument.span, Code.WRONG_ARGUMENTS, f"'{path[-1]}' is always there",
                          "has() is for submessages and optional fields")  # fmt: skip
        self_ = _name(self.scope.locals.name(path[:-1]))
        return self.typed(BoolKind(), ast.Call(attribute(self_, "HasField"), [ast.Constant(path[-1])], []), node)


def read(scope: Scope, holder: tuple[str, ...], member: Field, span: SourceSpan) -> Typed:
    """Reads a field of the submessage of the source message at path `holder`."""
    kind = kind_of(member.type)
    if isinstance(kind, MessageKind):
        path = (*holder, member.name)
        return Typed(kind, placed(_name(scope.locals.name(path)), span), span, path=path)
    return Typed(kind, placed(attribute(_name(scope.locals.name(holder)), member.name), span), span)


def placed(made: ast.expr, span: SourceSpan) -> ast.expr:
    """The same expression, its new nodes placed at `span`; nodes that have a place keep it."""
    for node in ast.walk(made):
        if isinstance(node, ast.expr) and not hasattr(node, "lineno"):
            place(node, span)
    return made


def place(node: ast.AST, span: SourceSpan) -> None:
    """Gives a syntax node the table's line and columns, for tracebacks."""
    node.lineno = node.end_lineno = span.line  # type: ignore[attr-defined]
    node.col_offset, node.end_col_offset = span.column - 1, span.end_column - 1  # type: ignore[attr-defined]


def attribute(holder: ast.expr, name: str) -> ast.expr:
    """`holder.name`, also where the protobuf field has the name of a Python keyword."""
    if keyword.iskeyword(name):
        return ast.Call(_name("getattr"), [holder, ast.Constant(name)], [])
    return ast.Attribute(holder, name, ast.Load())


def _name(name: str) -> ast.Name:
    return ast.Name(name, ast.Load())


def _dotted(node: ast.expr) -> tuple[str, ...] | None:
    """`a.b.c` as its parts, None for anything else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return (node.id, *reversed(parts)) if isinstance(node, ast.Name) else None


def _values(holder: Enum | MessageType) -> Sequence[tuple[str, object]]:
    return holder.values if isinstance(holder, Enum) else tuple(holder.constants.items())


_WORDS = {
    "Constant": "this literal", "JoinedStr": "an f-string", "NamedExpr": "':='", "ListComp": "a comprehension",
    "SetComp": "a comprehension", "DictComp": "a comprehension", "GeneratorExp": "a comprehension",
    "Tuple": "a tuple", "Dict": "a dictionary", "Set": "a set", "Lambda": "lambda", "Starred": "'*'",
    "BitAnd": "'&'", "BitOr": "'|'", "BitXor": "'^'", "LShift": "'<<'", "RShift": "'>>'", "Invert": "'~'",
    "MatMult": "'@'", "Is": "'is'", "IsNot": "'is not'", "Await": "await", "Yield": "yield", "Slice": "a slice",
}  # fmt: skip


def _describe(node: ast.AST) -> str:
    return _WORDS.get(type(node).__name__, type(node).__name__)
