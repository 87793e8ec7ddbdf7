"""The meaning of names: variables, fields, constants of enums and ROS types; and has()."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import replace

from router.compiler.expressions import spellings
from router.compiler.expressions.functions import FUNCTIONS, HAS, NOT_FINITE
from router.compiler.expressions.kinds import BoolKind, EnumKind, FloatKind, ListKind, MessageKind, StringKind, TimeKind
from router.compiler.expressions.operators import constant
from router.compiler.expressions.scope import ExpressionError, Scope, field_of, want_readable
from router.compiler.expressions.syntax import Parsed, dotted
from router.compiler.expressions.tree import (
    MESSAGE,
    SOURCE,
    Constant,
    Listed,
    Node,
    Present,
    Read,
    Variable,
    constant_of,
)
from router.errors import Code, SourceSpan, did_you_mean, nearest
from router.types.model import Enum, MessageType, String, Type


def named(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> Node:
    """A name that stands alone. `expected` is the type of the field that it fills."""
    if text in scope.names:
        return scope.variable(text, span)
    if member := scope.message.field(text):
        return _readable(field_of(scope.whole_message(span), member, span))
    if text in scope.given:
        return _given(text, span, scope)
    if text in ("true", "false"):  # as YAML spells them
        return constant(text == "true", span)
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    if isinstance(expected, Enum) and text in values:
        return Constant(EnumKind(expected), span, values[text])
    if text in NOT_FINITE:
        return Constant(FloatKind(32), span, NOT_FINITE[text])
    raise _unknown(text, span, scope, expected)


def _unknown(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> ExpressionError:
    if text in FUNCTIONS or text == HAS:
        return ExpressionError(span, Code.WRONG_ARGUMENTS, f"'{text}' is a function", f"call it: {text}(...)")
    if scope.holders(text):
        return ExpressionError(span, Code.TYPE_MISMATCH, f"'{text}' is an enum, not a value", f"name one: {text}.VALUE")
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    known = [*scope.field_names(), *scope.given, *values]
    if text.lower() in NOT_FINITE:
        known = [text.lower()]
    hint = (
        _of_an_enum(text, scope)
        or spellings.NAMES.get(text.lower())
        or (f"an endpoint's name is text: '{text}'" if text in scope.sources else "")
        or did_you_mean(text, known)
        or "only constants can stand here"
    )
    if isinstance(expected, String):
        close = nearest(text, known)
        hint = (f"did you mean the field '{close}'? " if close else "") + f"as text it is {{text: {text}}}"
    return ExpressionError(span, Code.UNKNOWN_FIELD, f"{scope.message} has no field '{text}'", hint)


def _of_an_enum(text: str, scope: Scope) -> str:
    """A hint for a value without its enum or ROS type; enums of the message's own fields come first."""
    homes = [enum for enum in scope.enums if text in dict(enum.values)]
    types = [member.type for member in scope.message.fields]
    own = [home for home in homes if home in types] or homes
    names = [enum.name for enum in own] or [ros.short_name for ros in scope.ros_types if text in ros.constants]
    if names:
        return f"did you mean '{names[0]}.{text}'?"
    values = {value: enum for enum in types if isinstance(enum, Enum) for value, _ in enum.values}
    near = nearest(text, values, 0.8) if text.isupper() else None
    return f"did you mean '{values[near]}.{near}'?" if near else ""


def _given(text: str, span: SourceSpan, scope: Scope) -> Node:
    if text == MESSAGE:
        return scope.whole_message(span)
    return Variable(StringKind() if text == SOURCE else TimeKind(), span, text)


def is_source(operand: Node) -> bool:
    """Whether an operand is the name of the endpoint that sent the message."""
    return isinstance(operand, Variable) and operand.name == SOURCE


def want_senders(operands: Sequence[Node], scope: Scope) -> None:
    """Refuse a comparison of the sender's name with a text that is the name of no possible sender."""
    if not scope.sources or not any(map(is_source, operands)):
        return
    for each in (
        each for operand in operands for each in (operand.items if isinstance(operand, Listed) else (operand,))
    ):
        name = constant_of(each)
        if isinstance(name, str) and name not in scope.sources:
            message = f"'{name}' is no source of this route"
            raise ExpressionError(each.span, Code.UNKNOWN_ENDPOINT, message, did_you_mean(name, scope.sources))


def constant_path(node: ast.Attribute, scope: Scope) -> tuple[str, ...] | None:
    """The parts of `a.b.C` when it is to be looked up among enums and ROS types: no field or variable is `a`."""
    path = dotted(node)
    if path is None or path[0] in (*scope.given, *scope.field_names()):
        return None
    return path


def whole_message(holder: ast.expr, text: Parsed, scope: Scope) -> Node | None:
    """The message for the `message` of `message.name`, unless it has a submessage of that name; None for all else."""
    member = scope.message.field(MESSAGE)
    is_meant = (
        isinstance(holder, ast.Name) and holder.id == MESSAGE and not isinstance(member and member.type, MessageType)
    )
    return scope.whole_message(text.span(holder)) if is_meant else None


_OF_OTHERS = {
    ListKind: "only messages have fields: name an element, as in x[0].y",
    TimeKind: "seconds(x) makes a number of a time",
}


def member_of(holder: Node, node: ast.Attribute, text: Parsed) -> Node:
    """`holder.name`."""
    span = text.span(node)
    if not isinstance(holder.kind, MessageKind):
        hint = _OF_OTHERS.get(type(holder.kind), "only messages have fields")
        raise ExpressionError(span, Code.FORBIDDEN_EXPRESSION, f"{holder.kind} has no '.{node.attr}'", hint)
    member = holder.kind.type.field(node.attr)
    if member is None:
        hint = did_you_mean(node.attr, [known.name for known in holder.kind.type.fields])
        message = f"{holder.kind.type} has no field '{node.attr}'"
        raise ExpressionError(text.last_span(node), Code.UNKNOWN_FIELD, message, hint)
    return _readable(field_of(holder, member, span))


def _readable(field: Read) -> Read:
    want_readable(field)
    return field


def constant_at(path: tuple[str, ...], node: ast.Attribute, text: Parsed, scope: Scope) -> Node:
    """`SensorState.SENSOR_ERROR`: an enum's value or a ROS type's constant, at `path`."""
    holder_name = ".".join(path[:-1])
    holders = scope.holders(holder_name)
    if not holders:
        message = f"{scope.message} has no field or enum '{holder_name}'"
        hint = _without_root(path, scope) or did_you_mean(holder_name, scope.holder_names() | set(scope.field_names()))
        raise ExpressionError(text.span(node.value), Code.UNKNOWN_FIELD, message, hint)
    found = [(holder, constants[node.attr]) for holder in holders if node.attr in (constants := _constants(holder))]
    if not found:
        known = {value for holder in holders for value in _constants(holder)}
        message = f"'{holder_name}' has no value '{node.attr}'"
        elsewhere = "" if nearest(node.attr, known) else _of_an_enum(node.attr, scope)
        hint = elsewhere or did_you_mean(node.attr, known)
        raise ExpressionError(text.last_span(node), Code.UNKNOWN_ENUM_VALUE, message, hint)
    if len({value for _, value in found}) > 1:
        names = ", ".join(sorted(holder.name for holder, _ in found))
        message = f"'{holder_name}.{node.attr}' may be of {names}"
        raise ExpressionError(text.span(node), Code.UNKNOWN_ENUM_VALUE, message, "write the enum's full name")
    holder, value = found[0]
    literal = constant(value, text.span(node))
    return replace(literal, kind=EnumKind(holder)) if isinstance(holder, Enum) else literal


def _without_root(path: tuple[str, ...], scope: Scope) -> str:
    """A hint for `msg.accel_x` and `math.pi`, which are written here without the first name."""
    if path[1] in scope.field_names():
        return f"write {'.'.join(path[1:])}: a name is a field of the message"
    return spellings.NAMES.get(path[-1].lower(), "")


def _constants(holder: Enum | MessageType) -> Mapping[str, object]:
    return dict(holder.values) if isinstance(holder, Enum) else holder.constants


def field_path(node: ast.expr, scope: Scope) -> tuple[str, ...] | None:
    """The path from the source message that `node` stands for; None if it is no chain of names."""
    path = dotted(node)
    if path is None or path[0] in scope.names:
        return None
    return path[1:] if path[0] == MESSAGE and scope.message.field(MESSAGE) is None else path


def presence(argument: Node, path: tuple[str, ...], span: SourceSpan) -> Present:
    """`has(path)`. Raises ExpressionError for what is no field that can be missing."""
    if not isinstance(argument, Read) and len(path) > 1:
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, "has() takes a field of the message")
    if not isinstance(argument, Read) or not argument.field.has_presence:
        hint = "has() is for a payload's submessages and optional fields"
        raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, f"'{path[-1]}' is always there", hint)
    return Present(BoolKind(), span, argument.holder, argument.field)
