"""Resolves names: variables, fields, constants of enums and ROS types; and has()."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import replace

from router.compiler.expressions import foreign_syntax
from router.compiler.expressions.functions import FUNCTIONS, HAS, NOT_FINITE
from router.compiler.expressions.kinds import (
    BoolKind,
    EnumKind,
    FloatKind,
    ListKind,
    MessageKind,
    StringKind,
    TimeKind,
    element_of,
)
from router.compiler.expressions.lists import elementwise
from router.compiler.expressions.operators import constant
from router.compiler.expressions.scope import BrokenStateError, ExpressionError, Scope, field_of, require_readable
from router.compiler.expressions.syntax import Parsed, dotted
from router.compiler.expressions.tree import (
    ENVELOPE,
    MESSAGE,
    SOURCE,
    STATE,
    Constant,
    ListLiteral,
    Node,
    Present,
    Read,
    Variable,
    constant_of,
)
from router.errors import Code, SourceSpan, did_you_mean, nearest, one_of
from router.types.model import Enum, MessageType, String, Type
from router.types.paths import leads, ways


def named(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> Node:
    """Resolve a single name. `expected` is the type of the field to be filled."""
    if text in scope.names:
        return scope.variable(text, span)
    if member := scope.message.field(text):
        return _readable(field_of(scope.whole_message(span), member, span))
    if text in scope.given:
        return _given(text, span, scope)
    if text == ENVELOPE and (envelope := scope.whole_envelope(span)):
        return envelope
    if text in ("true", "false"):  # as YAML spells them
        return constant(text == "true", span)
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    if isinstance(expected, Enum) and text in values:
        return Constant(EnumKind(expected), span, values[text])
    if text in NOT_FINITE:
        return Constant(FloatKind(32), span, NOT_FINITE[text])
    raise _unknown(text, span, scope, expected)


def _unknown(text: str, span: SourceSpan, scope: Scope, expected: Type | None) -> ExpressionError:
    if text in scope.absent:
        return ExpressionError(span, Code.UNKNOWN_FIELD, *scope.absent[text])
    if text in FUNCTIONS or text == HAS:
        return ExpressionError(span, Code.WRONG_ARGUMENTS, f"'{text}' is a function", f"call it: {text}(...)")
    if scope.holders(text):
        return ExpressionError(span, Code.TYPE_MISMATCH, f"'{text}' is an enum, not a value", f"name one: {text}.VALUE")
    message = f"{scope.message} has no field '{text}'"
    values = dict(expected.values) if isinstance(expected, Enum) else {}
    known = [*scope.field_names(), *scope.given, *values]
    if text.lower() in NOT_FINITE:
        known = [text.lower()]
    if not scope.given:
        return _no_constant(text, span, _of_an_enum(text, scope, expected), expected)
    if isinstance(expected, String):
        close = one_of(_ways(scope, (text,))) or (f"did you mean '{near}'?" if (near := nearest(text, known)) else "")
        literal = f"'{text}' in quotes" if scope.reads_states else f"{{text: {text}}}"
        hint = f"{close} for text, write {literal}".strip()
        return ExpressionError(span, Code.UNKNOWN_FIELD, message, hint)
    hint = (
        _of_an_enum(text, scope, expected)
        or foreign_syntax.NAMES.get(text.lower())
        or (f"quote the name of an endpoint: '{text}'" if text in scope.sources else "")
        or _presence(text, scope)
        or (one_of(_ways(scope, (text,))) if not nearest(text, known, _MISSPELT) else "")
        or did_you_mean(text, known)
    )
    return ExpressionError(span, Code.UNKNOWN_FIELD, message, hint)


_MISSPELT = 0.8
"""Minimum similarity of a name that can only be a misspelt field of the message."""


def _ways(scope: Scope, names: Sequence[str]) -> list[str]:
    """Return the paths that `names` may mean: from a variable, or else nested in the message or a variable."""
    own = [prefix + ".".join(names) for prefix, message in scope.messages() if prefix and leads(message, names)]
    return own or [
        prefix + way for prefix, message in scope.messages() for way in ways(message, names, with_lists=True)
    ]


def _presence(text: str, scope: Scope) -> str:
    """Return a hint for `has_air`, as protobuf spells has(air) in C and C++."""
    member = scope.message.field(text.removeprefix("has_"))
    return f"did you mean 'has({member.name})'?" if member and member.has_presence else ""


def _no_constant(text: str, span: SourceSpan, hint: str, expected: Type | None) -> ExpressionError:
    """Return the error for a name in a message of constants."""
    example = f"{expected}.{expected.values[0][0]}" if isinstance(expected, Enum) else "0"
    message = f"'{text}' is not a constant"
    if isinstance(expected, String):
        hint = f"quote a text twice: \"'{text}'\""
    return ExpressionError(
        span,
        Code.UNKNOWN_FIELD,
        message,
        hint or f"write a constant such as {example}: there is no message to read",
    )


def _of_an_enum(text: str, scope: Scope, expected: Type | None = None) -> str:
    """Return a hint for a value without its enum or ROS type; enums of the message's own fields come first."""
    if isinstance(expected, Enum) and text.isupper() and (near := nearest(text, dict(expected.values))):
        return f"did you mean '{near}'?"
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
        return scope.source_message(span)
    return Variable(StringKind() if text == SOURCE else TimeKind(), span, text)


def is_source(operand: Node) -> bool:
    """Return whether an operand is SOURCE, the name of the endpoint that sent the message."""
    return isinstance(operand, Variable) and operand.name == SOURCE


def require_senders(operands: Sequence[Node], scope: Scope) -> None:
    """Reject a comparison of the sender's name with a text that is not the name of a possible sender."""
    if not scope.sources or not any(map(is_source, operands)):
        return
    items = (
        item for operand in operands for item in (operand.items if isinstance(operand, ListLiteral) else (operand,))
    )
    for item in items:
        name = constant_of(item)
        if isinstance(name, str) and name not in scope.sources:
            message = f"'{name}' is not a source of this route"
            raise ExpressionError(item.span, Code.UNKNOWN_ENDPOINT, message, did_you_mean(name, scope.sources))


def constant_path(node: ast.Attribute, scope: Scope) -> tuple[str, ...] | None:
    """Return the parts of `a.b.C` if it refers to an enum or ROS type: `a` is neither a field nor a variable."""
    path = dotted(node)
    if path is None or path[0] in (*scope.given, *scope.field_names()):
        return None
    return None if path[0] == ENVELOPE and scope.envelope is not None else path


def whole_message(holder: ast.expr, text: Parsed, scope: Scope) -> Node | None:
    """Return the source message or its envelope if `holder` names it and no submessage; otherwise None."""
    if not isinstance(holder, ast.Name) or holder.id not in (MESSAGE, ENVELOPE):
        return None
    member = scope.message.field(holder.id)
    if isinstance(member and member.type, MessageType):
        return None
    span = text.span(holder)
    return scope.source_message(span) if holder.id == MESSAGE else scope.whole_envelope(span)


def state_named(node: ast.expr, text: Parsed, scope: Scope) -> Variable | None:
    """Return the state that `state.NAME` names; None if it names none, or a field of the message."""
    if not scope.states or not isinstance(node, ast.Attribute) or STATE in scope.names:
        return None
    if not isinstance(node.value, ast.Name) or node.value.id != STATE:
        return None
    name, span = node.attr, text.span(node)
    member = scope.message.field(STATE)
    inner = member.type if member is not None else None
    if isinstance(inner, MessageType):
        if not scope.reads_states or name not in scope.states:
            return None
        if inner.field(name) is not None:
            message = f"'state.{name}' is a field of {scope.message} and a state of the table"
            hint = f"write message.state.{name} for the field; give the state another name to read it here"
            raise ExpressionError(span, Code.FORBIDDEN_EXPRESSION, message, hint)
    if name not in scope.states:
        message = f"there is no state '{name}'"
        raise ExpressionError(text.last_span(node), Code.UNKNOWN_STATE, message, did_you_mean(name, scope.states))
    if not scope.reads_states:
        message, hint = "only conditions can read a state", "read it in `when` of a destination or topic"
        raise ExpressionError(span, Code.FORBIDDEN_EXPRESSION, message, hint)
    kind = scope.states[name]
    if kind is None:
        raise BrokenStateError(span, Code.UNKNOWN_STATE, f"'state.{name}' has a finding")
    return Variable(kind, span, f"{STATE}.{name}")


def is_null(node: ast.expr, scope: Scope) -> bool:
    """Return whether a node is `None`, or `null` and the like without a field of that name."""
    if isinstance(node, ast.Constant):
        return node.value is None
    return isinstance(node, ast.Name) and node.id.lower() in foreign_syntax.NULLS and node.id not in scope.field_names()


def no_null(compared: Node, written: str, span: SourceSpan, *, is_equal: bool) -> ExpressionError:
    """Return the error for a comparison of `written` with null."""
    hint = f"remove the comparison: '{written}' is always present"
    if isinstance(compared, Read) and compared.field.has_presence:
        hint = f"write `{'not ' * is_equal}has({written})`"
    elif not isinstance(compared.kind, MessageKind):
        hint = f"compare '{written}' with its default, which it has if the sender omits it"
    return ExpressionError(span, Code.FORBIDDEN_EXPRESSION, "expressions have no null", hint)


_LENGTHS = ("length", "size", "count")


def member_of(holder: Node, node: ast.Attribute, text: Parsed, scope: Scope) -> Node:
    """Resolve `holder.name`. For a list of messages, it is a list: this field of each element."""
    span = text.span(node)
    element = element_of(holder.kind)
    if isinstance(element, MessageKind) and (node.attr not in _LENGTHS or element.type.field(node.attr)):
        return elementwise(lambda parts: _of_element(parts[0], node, text, scope), [holder], span, scope)
    if not isinstance(holder.kind, MessageKind):
        hint = f"remove '.{node.attr}': only messages have fields"
        if isinstance(holder.kind, TimeKind):
            hint = "convert a time with seconds(x)"
        elif element is not None and node.attr in _LENGTHS:
            hint = f"write len({ast.unparse(node.value)})"
        raise ExpressionError(span, Code.FORBIDDEN_EXPRESSION, f"{holder.kind} has no '.{node.attr}'", hint)
    member = holder.kind.type.field(node.attr)
    if member is None:
        message = f"{holder.kind.type} has no field '{node.attr}'"
        envelope = scope.envelope
        if envelope is not None and holder.kind.type is envelope.beside and node.attr in envelope.numbers:
            message = f"'{node.attr}' is a payload, not a field beside it"
            hint = f"name fields of the payload without '{ENVELOPE}.{node.attr}.'; another payload has its own route"
            raise ExpressionError(text.last_span(node), Code.UNKNOWN_FIELD, message, hint)
        if further := _further(holder.kind.type, node, text):
            raise ExpressionError(text.span(text.outermost(node)), Code.UNKNOWN_FIELD, message, one_of(further))
        hint = did_you_mean(node.attr, holder.kind.type.names)
        raise ExpressionError(text.last_span(node), Code.UNKNOWN_FIELD, message, hint)
    return _readable(field_of(holder, member, span))


def _of_element(element: Node, node: ast.Attribute, text: Parsed, scope: Scope) -> Node:
    """Resolve `list.name` for an element of the list. Raises ExpressionError if it is a list itself."""
    member = member_of(element, node, text, scope)
    if isinstance(member.kind, ListKind):
        message = f"'{ast.unparse(node)}' would be a list of lists"
        hint = f"name one element, as in {ast.unparse(node.value)}[0].{node.attr}"
        raise ExpressionError(member.span, Code.TYPE_MISMATCH, message, hint)
    return member


def _further(holder: MessageType, node: ast.Attribute, text: Parsed) -> list[str]:
    """Return what `a.b.c` may mean if the message `a` has no `b`: `a.x.b.c`, or `a.c`."""
    before = ast.unparse(node.value)
    *_, names = ast.unparse(text.outermost(node)).partition(f"{before}.")
    wanted = names.split(".")
    if nearest(node.attr, [known.name for known in holder.fields], _MISSPELT):
        return []
    paths = ways(holder, wanted, with_lists=True)
    if not paths and len(wanted) > 1 and leads(holder, wanted[1:]):
        paths = [".".join(wanted[1:])]
    return [f"{before}.{way}" for way in paths]


def _readable(field: Read) -> Read:
    require_readable(field)
    return field


def constant_at(path: tuple[str, ...], node: ast.Attribute, text: Parsed, scope: Scope) -> Node:
    """Resolve an enum's value or a ROS type's constant at `path`: `SensorState.SENSOR_ERROR`."""
    holder_name = ".".join(path[:-1])
    holders = scope.holders(holder_name)
    if not holders:
        raise _unknown_path(path, node, text, scope)
    values = [(holder, constants[node.attr]) for holder in holders if node.attr in (constants := _constants(holder))]
    if not values:
        known = {value for holder in holders for value in _constants(holder)}
        message = f"'{holder_name}' has no value '{node.attr}'"
        elsewhere = "" if nearest(node.attr, known) else _of_an_enum(node.attr, scope)
        hint = elsewhere or did_you_mean(node.attr, known)
        raise ExpressionError(text.last_span(node), Code.UNKNOWN_ENUM_VALUE, message, hint)
    if len({value for _, value in values}) > 1:
        names = ", ".join(sorted(holder.name for holder, _ in values))
        message = f"'{holder_name}.{node.attr}' is ambiguous between {names}"
        raise ExpressionError(text.span(node), Code.UNKNOWN_ENUM_VALUE, message, "write the enum's full name")
    holder, value = values[0]
    literal = constant(value, text.span(node))
    return replace(literal, kind=EnumKind(holder)) if isinstance(holder, Enum) else literal


def _unknown_path(path: tuple[str, ...], node: ast.Attribute, text: Parsed, scope: Scope) -> ExpressionError:
    """Return the error for `a.b.c` if nothing is named `a`."""
    whole, holder_name = text.span(node), ".".join(path[:-1])
    if path[0] in scope.absent:
        return ExpressionError(whole, Code.UNKNOWN_FIELD, *scope.absent[path[0]])
    if not scope.given and not path[0][0].isupper():
        return _no_constant(".".join(path), whole, _of_an_enum(path[-1], scope), None)
    message = f"{scope.message} has no field or enum '{holder_name}'"
    fields, enums = scope.field_names(), scope.holder_names()
    if not nearest(path[0], fields, _MISSPELT) and (paths := _ways(scope, path) or _without_root(path, scope)):
        return ExpressionError(whole, Code.UNKNOWN_FIELD, message, one_of(paths))
    if paths := ways(scope.message, path[:1]):
        first = replace(whole, end_column=whole.column + len(path[0]))
        return ExpressionError(first, Code.UNKNOWN_FIELD, message, one_of(paths))
    hint = foreign_syntax.NAMES.get(path[-1].lower(), "")
    if not hint and (near := nearest(path[0], fields)) and not nearest(holder_name, enums):
        first = replace(whole, end_column=whole.column + len(path[0]))
        return ExpressionError(first, Code.UNKNOWN_FIELD, message, f"did you mean '{near}'?")
    known = enums if path[0][0].isupper() else {*fields, *enums} if nearest(holder_name, enums) else fields
    return ExpressionError(text.span(node.value), Code.UNKNOWN_FIELD, message, hint or did_you_mean(holder_name, known))


def _without_root(path: tuple[str, ...], scope: Scope) -> list[str]:
    """Return what `msg.accel_x` may mean without the first name."""
    for rest in (path[start:] for start in range(1, len(path))):
        if paths := [".".join(rest)] if leads(scope.message, rest) else _ways(scope, rest):
            return paths
    return []


def _constants(holder: Enum | MessageType) -> Mapping[str, object]:
    return dict(holder.values) if isinstance(holder, Enum) else holder.constants


def field_path(node: ast.expr, scope: Scope) -> tuple[str, ...] | None:
    """Return the path of `node` from the source message; None if it is not a chain of names."""
    path = dotted(node)
    if path is None or path[0] in scope.names:
        return None
    return path[1:] if path[0] == MESSAGE and scope.message.field(MESSAGE) is None else path


def presence(argument: Node, path: tuple[str, ...], span: SourceSpan) -> Present:
    """Return `has(path)`. Raises ExpressionError unless it is a field that can be missing."""
    if not isinstance(argument, Read) and len(path) > 1:
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, "has() takes a field of the message")
    if not isinstance(argument, Read) or not argument.field.has_presence:
        hint = "use has() for submessages and optional fields of a payload"
        raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, f"'{path[-1]}' is always present", hint)
    return Present(BoolKind(), span, argument.holder, argument.field)
