"""Names: fields of the source message, what else an expression can see, enum values and ROS constants."""

from __future__ import annotations

import ast
from collections.abc import Mapping

from router.compiler.expressions.literals import constant
from router.compiler.expressions.parsing import Parsed, dotted
from router.compiler.expressions.scope import MESSAGE, SOURCE, Scope
from router.compiler.expressions.typed import Finding, Typed
from router.compiler.functions import FUNCTIONS, HAS, NOT_FINITE
from router.compiler.kinds import BoolKind, EnumKind, FloatKind, MessageKind, StringKind, TimeKind
from router.compiler.syntax import attribute, load
from router.errors import Code, SourceSpan, did_you_mean, nearest
from router.types.model import Enum, MessageType, String, Type


def named(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> Typed:
    """A name that stands alone. `expected` is what it is to fill."""
    if text in scope.names:
        return scope.variable(text, span)
    if member := scope.message.field(text):
        return scope.read((), member, span)
    if text in scope.given:
        return _given(text, span, scope)
    if text in ("true", "false"):  # as YAML spells them
        return constant(text == "true", span)
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    if isinstance(expected, Enum) and text in values:
        return Typed.at(span, EnumKind(expected), ast.Constant(values[text]))
    if text in NOT_FINITE:
        return Typed.at(span, FloatKind(32), ast.Constant(NOT_FINITE[text]))
    raise _unknown(text, span, scope, expected)


def _unknown(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> Finding:
    if text in FUNCTIONS or text == HAS:
        return Finding(span, Code.WRONG_ARGUMENTS, f"'{text}' is a function", f"call it: {text}(...)")
    if scope.holders(text):
        return Finding(span, Code.TYPE_MISMATCH, f"'{text}' is an enum, not a value", f"name one: {text}.VALUE")
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    known = [*scope.field_names(), *scope.given, *values]
    if text.lower() in NOT_FINITE:
        known = [text.lower()]
    hint = _of_an_enum(text, scope) or did_you_mean(text, known) or "only constants can stand here"
    if isinstance(expected, String) and not nearest(text, known):
        hint = f"text has quotes of its own: \"'{text}'\""
    return Finding(span, Code.UNKNOWN_FIELD, f"{scope.message} has no field '{text}'", hint)


def _of_an_enum(text: str, scope: Scope) -> str:
    """A hint for an enum's value that stands without its enum; one of the message's own fields comes first."""
    homes = [enum for enum in scope.enums if text in dict(enum.values)]
    types = [member.type for member in scope.message.fields]
    own = [home for home in homes if home in types] or homes
    return f"did you mean '{own[0]}.{text}'?" if own else ""


def _given(text: str, span: SourceSpan, scope: Scope) -> Typed:
    if text == MESSAGE:
        return scope.whole_message(span)
    return Typed.at(span, StringKind() if text == SOURCE else TimeKind(), load(text))


def constant_path(node: ast.Attribute, scope: Scope) -> tuple[str, ...] | None:
    """The parts of `a.b.C` when it is to be looked up among enums and ROS types: no field or variable is `a`."""
    path = dotted(node)
    if path is None or path[0] in (*scope.given, *scope.field_names()):
        return None
    return path


def field_of(holder: Typed, node: ast.Attribute, text: Parsed, scope: Scope) -> Typed:
    """`holder.name`."""
    span = text.span(node)
    if not isinstance(holder.kind, MessageKind):
        hint = "only messages have fields"
        raise Finding(span, Code.FORBIDDEN_EXPRESSION, f"'.{node.attr}' of a {holder.kind}", hint)
    member = holder.kind.type.field(node.attr)
    if member is None:
        hint = did_you_mean(node.attr, [known.name for known in holder.kind.type.fields])
        message = f"{holder.kind.type} has no field '{node.attr}'"
        raise Finding(text.last_span(node), Code.UNKNOWN_FIELD, message, hint)
    return scope.field_of(holder, member, span)


def constant_of(path: tuple[str, ...], node: ast.Attribute, text: Parsed, scope: Scope) -> Typed:
    """`SensorState.SENSOR_ERROR`: an enum's value or a ROS type's constant, at `path`."""
    holder_name = ".".join(path[:-1])
    holders = scope.holders(holder_name)
    if not holders:
        message = f"{scope.message} has no field or enum '{holder_name}'"
        hint = did_you_mean(holder_name, scope.holder_names() | set(scope.field_names()))
        raise Finding(text.span(node.value), Code.UNKNOWN_FIELD, message, hint)
    found = [(holder, constants[node.attr]) for holder in holders if node.attr in (constants := _constants(holder))]
    if not found:
        known = {value for holder in holders for value in _constants(holder)}
        message = f"'{holder_name}' has no value '{node.attr}'"
        raise Finding(text.last_span(node), Code.UNKNOWN_ENUM_VALUE, message, did_you_mean(node.attr, known))
    if len({value for _, value in found}) > 1:
        names = ", ".join(sorted(holder.name for holder, _ in found))
        message = f"'{holder_name}.{node.attr}' may be of {names}"
        raise Finding(text.span(node), Code.UNKNOWN_ENUM_VALUE, message, "write the enum's full name")
    holder, value = found[0]
    literal = constant(value, text.span(node))
    return Typed(EnumKind(holder), literal.node, literal.span) if isinstance(holder, Enum) else literal


def _constants(holder: Enum | MessageType) -> Mapping[str, object]:
    return dict(holder.values) if isinstance(holder, Enum) else holder.constants


def field_path(node: ast.expr, scope: Scope) -> tuple[str, ...] | None:
    """The names that lead from the source message to what `node` looks like; None when it is no chain of names."""
    path = dotted(node)
    if path is None or path[0] in scope.names:
        return None
    return path[1:] if path[0] == MESSAGE and scope.message.field(MESSAGE) is None else path


def presence(path: tuple[str, ...], field_span: SourceSpan, span: SourceSpan, scope: Scope) -> Typed:
    """`has(path)`. Raises Finding for a path that is no field which can be missing."""
    holder = scope.message
    for part in path[:-1]:
        inner = holder.field(part)
        if inner is None or not isinstance(inner.type, MessageType):
            raise Finding(span, Code.WRONG_ARGUMENTS, "has() takes a field of the message")
        holder = inner.type
    member = holder.field(path[-1])
    if member is None or not member.has_presence:
        hint = "has() is for a payload's submessages and optional fields"
        raise Finding(field_span, Code.WRONG_ARGUMENTS, f"'{path[-1]}' is always there", hint)
    has_field = attribute(scope.reads.message(path[:-1]), "HasField")
    return Typed.at(span, BoolKind(), ast.Call(has_field, [ast.Constant(path[-1])], []))
