"""The oracle's expressions: walks the syntax that the user wrote, over a message, with Python's own values.

Expects expressions that the compiler has accepted; see `reference`.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Collection
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from router.compiler.expressions.functions import FUNCTIONS, NOT_FINITE
from router.compiler.expressions.kinds import TIME_TYPES
from router.errors import MappingError
from router.table.model import Choices, Expression
from router.types.model import Enum, Int, List, MessageType, Type

NS = 1_000_000_000


class Nanoseconds(int):
    """A time, told apart from a number."""


class EnumNumber(int):
    """The value of a protobuf enum, told apart from a number: it saturates."""


@dataclass(frozen=True, slots=True)
class View:
    """A message together with what its type model says about it."""

    message: Any
    type: MessageType

    def read(self, name: str) -> object:
        """The value of a field. Raises KeyError when the type has none of this name."""
        field = self.type.field(name)
        if field is None:
            raise KeyError(f"{self.type} has no field '{name}'")
        return _seen(getattr(self.message, name), field.type)


def _seen(raw: Any, declared: Type) -> object:
    """A field's value as expressions see it."""
    match declared:
        case MessageType() if declared.name in TIME_TYPES:
            return Nanoseconds(raw.sec * NS + raw.nanosec)
        case MessageType():
            return View(raw, declared)
        case Enum():
            return EnumNumber(raw)
        case List(MessageType(is_map_entry=True) as entry):
            return [View(SimpleNamespace(key=key, value=raw[key]), entry) for key in sorted(raw)]
        case List():
            return [_seen(element, declared.element) for element in raw]
        case _:
            return raw


@dataclass(frozen=True, slots=True)
class Context:
    """What expressions can see: a message, who sent it, when (ns since 1970), and the constants by holder."""

    view: View
    source: str
    received_at: int
    enums: Collection[Enum]
    ros_types: Collection[MessageType]


def evaluate(expression: Expression, context: Context, expected: Type | None = None) -> object:
    """The value of an expression that the compiler accepts; `expected` is the field that it fills.

    Raises MappingError where the value has no result.
    """
    if expression.items is not None:
        return [evaluate(item, context, _element(expected)) for item in expression.items]
    if expression.literal:
        return expression.text
    if expression.choices is not None:
        return evaluate(_chosen(expression.choices, context), context, expected)
    syntax = ast.parse(expression.text.replace("\n", " ").strip(), mode="eval").body
    try:
        return _Evaluator(context).visit(syntax, expected)
    except (ArithmeticError, ValueError, LookupError) as error:
        raise MappingError(str(error)) from error


def _chosen(choices: Choices, context: Context) -> Expression:
    subject = evaluate(choices.subject, context)
    for name, value in choices.values:
        named = [number for enum in context.enums for each, number in enum.values if each == name.value]
        if subject == (name.value if isinstance(subject, str) else (named or [ast.literal_eval(name.value)])[0]):
            return value
    if choices.otherwise is None:
        raise MappingError(f"the map has no value for {subject}")
    return choices.otherwise


def _element(expected: Type | None) -> Type | None:
    return expected.element if isinstance(expected, List) else None


_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow,
}  # fmt: skip
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.Not: operator.not_, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
_GIVE_FLOATS = frozenset(
    {"radians", "degrees", "sqrt", "sin", "cos", "tan", "atan2", "hypot", "float32", "float64", "seconds"}
)
_GIVE_AN_ARGUMENT = frozenset({"min", "max", "clamp"})
_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge, ast.In: lambda x, y: x in y, ast.NotIn: lambda x, y: x not in y,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Evaluator:
    context: Context

    def visit(  # noqa: C901, PLR0912 - a case a syntax
        self, node: ast.expr, expected: Type | None = None
    ) -> Any:
        match node:
            case ast.Constant():
                return node.value
            case ast.List():
                return [self.visit(item, _element(expected)) for item in node.elts]
            case ast.Name():
                return self._name(node.id, expected)
            case ast.Attribute():
                return self._attribute(node)
            case ast.Subscript():
                return self.visit(node.value)[self.visit(node.slice)]
            case ast.UnaryOp():
                return _UNARY[type(node.op)](self.visit(node.operand))
            case ast.BinOp():
                return _BINARY[type(node.op)](self.visit(node.left), self.visit(node.right))
            case ast.BoolOp(op=ast.And()):
                return all(self.visit(value) for value in node.values)
            case ast.BoolOp():
                return any(self.visit(value) for value in node.values)
            case ast.Compare():
                return self._compare(node)
            case ast.IfExp():
                chosen = self.visit(node.body if self.visit(node.test) else node.orelse, expected)
                return float(chosen) if self._is_float(node, expected) else chosen
            case ast.Call(func=ast.Name("has")):
                return self._has(node.args[0])
            case ast.Call(func=ast.Name(name)):
                value: Any = self._call(name, [self.visit(argument) for argument in node.args], expected)
                return float(value) if name in _GIVE_AN_ARGUMENT and self._is_float(node) else value
            case _:
                raise TypeError(f"{type(node).__name__} is not part of the language")

    def _is_float(self, node: ast.expr, expected: Type | None = None) -> bool:
        """Whether an expression gives a float, whatever is chosen in it."""
        match node:
            case ast.IfExp():
                return self._is_float(node.body, expected) or self._is_float(node.orelse, expected)
            case ast.UnaryOp():
                return self._is_float(node.operand)
            case ast.BinOp():
                return isinstance(node.op, ast.Div) or self._is_float(node.left) or self._is_float(node.right)
            case ast.Call(func=ast.Name(name)):
                return name in _GIVE_FLOATS or (
                    name in {"abs", *_GIVE_AN_ARGUMENT} and any(map(self._is_float, node.args))
                )
            case ast.Subscript(value=ast.List(elements)):
                return any(map(self._is_float, elements))
            case ast.Compare() | ast.BoolOp() | ast.Subscript():
                return False
            case _:
                return isinstance(self.visit(node, expected), float)

    def _name(self, name: str, expected: Type | None) -> object:
        view = self.context.view
        if view.type.field(name):
            return view.read(name)
        named = {
            "message": view,
            "source": self.context.source,
            "received_at": Nanoseconds(self.context.received_at),
            "true": True,
            "false": False,
        }
        values = dict(expected.values) if isinstance(expected, Enum) else {}
        if name not in named and name in values:
            return EnumNumber(values[name])
        return named[name] if name in named else NOT_FINITE[name]

    def _attribute(self, node: ast.Attribute) -> object:
        root: ast.expr = node
        while isinstance(root, ast.Attribute):
            root = root.value
        if isinstance(root, ast.Name) and root.id != "message" and not self.context.view.type.field(root.id):
            return self._constant(ast.unparse(node.value), node.attr)
        holder: View = self.visit(node.value)
        return holder.read(node.attr)

    def _constant(self, holder: str, name: str) -> object:
        """`SensorState.SENSOR_ERROR`: an enum of the message's own, one of exactly this name, or any."""
        own = f"{self.context.view.type.name}.{holder}"
        full_names = [own, holder, *(enum.name for enum in self.context.enums if enum.name.endswith(f".{holder}"))]
        for full_name in full_names:
            for enum in self.context.enums:
                if enum.name == full_name and name in dict(enum.values):
                    return EnumNumber(dict(enum.values)[name])
        for ros in self.context.ros_types:
            if ros.short_name == holder and name in ros.constants:
                return ros.constants[name]
        raise KeyError(f"there is no {holder}.{name}")

    def _compare(self, node: ast.Compare) -> bool:
        left = self.visit(node.left)
        for op, comparator in zip(node.ops, node.comparators, strict=True):
            right = self.visit(comparator)
            if not _COMPARE[type(op)](left, right):
                return False
            left = right
        return True

    def _call(self, name: str, arguments: list[Any], expected: Type | None) -> object:
        function = FUNCTIONS[name]
        if function.optional and len(arguments) < len(function.parameters) and isinstance(expected, Int):
            arguments += [expected.low, expected.high]
        result: Any = function.implementation(*arguments)
        return Nanoseconds(result) if name.startswith("time_from_") else result

    def _has(self, node: ast.expr) -> bool:
        if isinstance(node, ast.Attribute):
            holder, name = self.visit(node.value), node.attr
        else:
            holder, name = self.context.view, ast.unparse(node)
        return bool(holder.message.HasField(name))
