"""Check an expression, innermost node first, and make a typed tree of it: names, fields, constants and calls."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from router.compiler.expressions import lists, operators, spellings
from router.compiler.expressions.functions import FUNCTIONS, HAS, NOT_FINITE, Function, Parameter
from router.compiler.expressions.kinds import (
    BoolKind,
    EnumKind,
    FloatKind,
    IntKind,
    MessageKind,
    StringKind,
    TimeKind,
    is_list,
)
from router.compiler.expressions.operators import constant
from router.compiler.expressions.scope import ExpressionError, Scope, field_of, want_readable
from router.compiler.expressions.syntax import Parsed, dotted, forbidden
from router.compiler.expressions.tree import (
    MESSAGE,
    SOURCE,
    Call,
    Constant,
    Listed,
    Node,
    Operator,
    Present,
    Read,
    Variable,
    constant_of,
)
from router.errors import Code, Located, SourceSpan, did_you_mean, nearest, plural
from router.table.model import Choices, Expression
from router.table.nodes import TextPlace
from router.types.model import Enum, Int, List, MessageType, String, Type

DEEPEST = 60
"""How deep an expression may nest, since Python's and our functions on syntax trees are recursive."""


MOST_CHOICES = 100
"""Values of a map, which nests as deep."""


def check(expression: Expression, scope: Scope, expected: Type | None = None) -> Node:
    """The typed tree of an expression. Raises ExpressionError.

    `expected` is the type of the field to be filled: clamp() and wrap() take their bounds from it, bare names are
    looked up among the values of an enum.
    """
    if expression.literal:
        return constant(expression.text, expression.span)
    if expression.choices is not None:
        return _chosen(expression.choices, expression.span, scope, expected)
    if expression.items is not None:
        items = [check(item, scope, _element(expected)) for item in expression.items]
        return lists.list_of(items, expression.span)
    text = Parsed(expression, scope.field_names())
    return _Checker(text, scope).check(text.tree, expected)


def _chosen(choices: Choices, span: SourceSpan, scope: Scope, expected: Type | None) -> Node:
    """A chain of comparisons with the value of the subject.

    Without `else`, the last value is for itself alone: any other one is refused at run time.
    """
    if len(choices.values) > MOST_CHOICES:
        raise ExpressionError(span, Code.EXPRESSION_SYNTAX, f"a map has at most {MOST_CHOICES} values")
    subject = check(choices.subject, scope)
    keys: list[Node] = [_key(name, subject, scope) for name, _ in choices.values]
    _want_different(choices, keys)
    values = [check(value, scope, expected) for _, value in choices.values]
    if choices.otherwise is not None:
        made = check(choices.otherwise, scope, expected)
    else:
        _want_all(subject, keys, span, scope)
        made, last = values[-1], keys[-1]
        if isinstance(subject.kind, EnumKind):
            keys[-1] = Call(last.kind, last.span, "fit", (subject, last, last))
    for (name, _), key, value in reversed(list(zip(choices.values, keys, values, strict=True))):
        made = operators.choice(operators.equality(subject, key, name.span), value, made, value.span, scope)
    return replace(made, span=span)


def _key(name: Located[str], subject: Node, scope: Scope) -> Node:
    """The value that a key of a map stands for: a name of the subject's enum, or a constant."""
    if isinstance(subject.kind, EnumKind):
        values = dict(subject.kind.enum.values)
        if name.value in values:
            return Constant(subject.kind, name.span, values[name.value])
        message = f"'{subject.kind.enum.name}' has no value '{name.value}'"
        raise ExpressionError(name.span, Code.UNKNOWN_ENUM_VALUE, message, _key_hint(name.value, values))
    if isinstance(subject.kind, StringKind):
        key = Constant(StringKind(), name.span, name.value)
        want_senders([subject, key], scope)
        return key
    if name.value in scope.message.constants:
        return constant(scope.message.constants[name.value], name.span)
    checked = check(Expression(name.value, TextPlace(name.span)), scope)
    if constant_of(checked) is None:
        message = f"'{name.value}' is no constant"
        raise ExpressionError(name.span, Code.TYPE_MISMATCH, message, "the keys of a map are values, not fields")
    return checked


def _key_hint(name: str, values: Mapping[str, int]) -> str:
    """What to write for a key that is no name of an enum with these values."""
    short = name.replace("::", ".").rpartition(".")[2]
    named = [short] if short in values else [value for value, number in values.items() if str(number) == name]
    if named:
        return f"did you mean '{named[0]}'?"
    return "write `else` for all other values" if name in ("default", "_", "*", "other") else did_you_mean(name, values)


def _want_different(choices: Choices, keys: Sequence[Node]) -> None:
    """Refuse a map in which two keys are one value, such as two names of an enum's number."""
    names: dict[object, str] = {}
    for (name, _), key in zip(choices.values, keys, strict=True):
        first = names.setdefault(constant_of(key), name.value)
        if first != name.value:
            message = f"'{name.value}' is the same value as '{first}'"
            raise ExpressionError(name.span, Code.DUPLICATE_KEY, message, "remove one of the two")


def _want_all(subject: Node, keys: Sequence[Node], span: SourceSpan, scope: Scope) -> None:
    """Refuse a map without `else` that leaves out values, or whose subject has no list of them."""
    hint = "list them, or say what they become: `else: VALUE`"
    covered = {constant_of(key) for key in keys}
    if isinstance(subject.kind, BoolKind) and covered == {True, False}:
        return
    if is_source(subject) and scope.sources and covered == {*scope.sources}:
        return
    if not isinstance(subject.kind, EnumKind):
        message = f"{subject.kind} has more values than those of this map"
        raise ExpressionError(span, Code.MISSING_ENUM_VALUE, message, hint)
    missing = [name for name, number in subject.kind.enum.values if number not in covered]
    if missing:
        names = ", ".join(missing)
        raise ExpressionError(span, Code.MISSING_ENUM_VALUE, f"the map has no value for {names}", hint)


def _element(expected: Type | None) -> Type | None:
    return expected.element if isinstance(expected, List) else None


@dataclass(slots=True)
class _Checker:
    """Checks one expression. Each method takes a syntax node of the user and returns it checked and resolved."""

    text: Parsed
    scope: Scope
    depth: int = 0

    def check(self, node: ast.expr, expected: Type | None = None) -> Node:
        span = self.text.span(node)
        self.depth += 1
        if self.depth > DEEPEST:
            raise ExpressionError(span, Code.EXPRESSION_SYNTAX, "not an expression: nested too deeply")
        checked = self._rule(node, span, expected)
        self.depth -= 1
        return checked

    def _rule(  # noqa: C901, PLR0912 - a case a syntax
        self, node: ast.expr, span: SourceSpan, expected: Type | None
    ) -> Node:
        match node:
            case ast.Constant():
                return operators.constant(node.value, span)
            case ast.List():
                return lists.list_of([self.check(item, _element(expected)) for item in node.elts], span)
            case ast.Name():
                return named(node.id, span, self.scope, expected)
            case ast.Attribute() if path := constant_path(node, self.scope):
                return constant_at(path, node, self.text, self.scope)
            case ast.Attribute():
                return member_of(self.check(node.value), node, self.text)
            case ast.Subscript():
                return lists.item_of(self.check(node.value), self.check(node.slice), span, self.scope)
            case ast.UnaryOp():
                return self._unary(node.op, self.check(node.operand), span)
            case ast.BinOp():
                return self._binary(operators.want_binary(node.op, span), node, span)
            case ast.BoolOp():
                return operators.boolean(node.op, [self.check(value) for value in node.values], span)
            case ast.Compare():
                operands = [self.check(operand) for operand in (node.left, *node.comparators)]
                want_senders(operands, self.scope)
                return operators.comparison(node.ops, operands, span, self.scope)
            case ast.IfExp():
                test = self.check(node.test)
                operators.want_bool(test, "if")
                body, orelse = self.check(node.body, expected), self.check(node.orelse, expected)
                return operators.choice(test, body, orelse, span, self.scope)
            case ast.Call():
                return self._call(node, span, expected)
            case _:
                raise forbidden(node, span)

    def _unary(self, op: ast.unaryop, operand: Node, span: SourceSpan) -> Node:
        if isinstance(op, ast.Not):
            return operators.unary(op, operand, span)
        return lists.elementwise(lambda parts: operators.unary(op, parts[0], span), [operand], span, self.scope)

    def _binary(self, op: Operator, node: ast.BinOp, span: SourceSpan) -> Node:
        operands = [self.check(node.left), self.check(node.right)]
        return lists.elementwise(
            lambda parts: operators.binary(op, parts[0], parts[1], span), operands, span, self.scope
        )

    def _call(self, node: ast.Call, span: SourceSpan, expected: Type | None) -> Node:
        name = called_name(node, self.text)
        if name == HAS:
            return self._has(node, span)
        function = function_named(name, self.text.span(node.func))
        arguments = [self.check(argument) for argument in node.args]
        return call_of(function, arguments, span, self.scope, expected)

    def _has(self, node: ast.Call, span: SourceSpan) -> Node:
        """`has(field)` takes the path of its argument instead of the value; the argument is checked as well."""
        path = field_path(node.args[0], self.scope) if len(node.args) == 1 else None
        if not path:
            raise ExpressionError(span, Code.WRONG_ARGUMENTS, "has() takes one field")
        return presence(self.check(node.args[0]), path, span)


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
    """Refuse texts that are compared with the name of the sender, and that no sender of the message has."""
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


def member_of(holder: Node, node: ast.Attribute, text: Parsed) -> Node:
    """`holder.name`."""
    span = text.span(node)
    if not isinstance(holder.kind, MessageKind):
        hint = "only messages have fields"
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
    """A hint for `msg.accel_x` and `math.pi`, which stand here without what they belong to elsewhere."""
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


def called_name(node: ast.Call, text: Parsed) -> str:
    """The name in front of the brackets. Raises ExpressionError for calls of another shape than `name(a, b)`."""
    if not isinstance(node.func, ast.Name):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        known = f"write {FUNCTIONS[name].signature}" if name in FUNCTIONS else spellings.FUNCTIONS.get(name.lower())
        hint = known or did_you_mean("", FUNCTIONS)
        raise ExpressionError(text.span(node.func), Code.FORBIDDEN_EXPRESSION, "only listed functions are called", hint)
    if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
        message = f"{node.func.id}() takes its arguments by position"
        hint = f"write {FUNCTIONS[node.func.id].signature}" if node.func.id in FUNCTIONS else ""
        raise ExpressionError(text.span(node), Code.WRONG_ARGUMENTS, message, hint)
    return node.func.id


def function_named(name: str, span: SourceSpan) -> Function:
    function = FUNCTIONS.get(name)
    if function is None:
        hint = spellings.FUNCTIONS.get(name.lower()) or did_you_mean(name, [*FUNCTIONS, HAS])
        raise ExpressionError(span, Code.UNKNOWN_FUNCTION, f"there is no function '{name}'", hint)
    return function


def call_of(
    function: Function, arguments: Sequence[Node], span: SourceSpan, scope: Scope, expected: Type | None
) -> Node:
    """The call as a checked expression; bounds that it leaves out are those of the field `expected`."""
    if function.of_list is not None and len(arguments) == 1 and is_list(arguments[0].kind):
        return _whole_list(function, arguments[0], span, scope)
    if function.optional and len(arguments) == len(function.parameters) - function.optional:
        is_of_list = isinstance(expected, List) and any(is_list(argument.kind) for argument in arguments)
        arguments = [*arguments, *_bounds(function, span, _element(expected) if is_of_list else expected)]
    _want_count(function, len(arguments), span)
    return lists.elementwise(lambda parts: _call_of_scalars(function, parts, span, scope), arguments, span, scope)


def _whole_list(function: Function, argument: Node, span: SourceSpan, scope: Scope) -> Call:
    assert function.of_list is not None  # noqa: S101 - see call_of
    kind = function.of_list(argument.kind)
    if kind is None:
        message = f"{function.name}() takes a list of numbers, not {argument.kind}"
        raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, message)
    return Call(kind, span, function.name, (lists.as_value(argument, scope),))


def _call_of_scalars(function: Function, arguments: Sequence[Node], span: SourceSpan, scope: Scope) -> Call:
    _want_accepted(function, arguments)
    try:
        kind = function.result(arguments)
    except ValueError as error:
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, f"{function.name}(): {error}") from None
    if function.gives_an_argument and isinstance(kind, FloatKind):
        arguments = [lists.as_kind(argument, kind, scope) for argument in arguments]
    becomes = [parameter.becomes for parameter in _parameters(function, len(arguments))]
    made = [lists.as_kind(each, kind, scope) if kind else each for each, kind in zip(arguments, becomes, strict=True)]
    return Call(kind, span, function.name, tuple(made))


def _parameters(function: Function, count: int) -> list[Parameter]:
    """The parameters of a call with so many arguments."""
    return [*function.parameters, *[function.parameters[-1]] * (count - len(function.parameters))]


def _bounds(function: Function, span: SourceSpan, expected: Type | None) -> list[Node]:
    if not isinstance(expected, Int):
        message = f"{function.name}() needs bounds here, where no integer field is filled"
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, message, f"write {function.name}(x, low, high)")
    return [Constant(IntKind(bound, bound), span, bound) for bound in (expected.low, expected.high)]


def _want_count(function: Function, count: int, span: SourceSpan) -> None:
    takes = len(function.parameters)
    if count < takes or (count > takes and not function.variadic):
        wanted = plural(takes, "argument") + " or more, or one list," * function.variadic
        message = f"{function.name}() takes {wanted}, not {count}"
        raise ExpressionError(span, Code.WRONG_ARGUMENTS, message, f"write {function.signature}")


_OF_FLOATS = {"int": spellings.INTEGERS, "str": spellings.DECIMALS}


def _want_accepted(function: Function, arguments: Sequence[Node]) -> None:
    for parameter, argument in zip(_parameters(function, len(arguments)), arguments, strict=True):
        if not isinstance(argument.kind, parameter.accepts):
            message = f"{function.name}() takes {parameter.wanted} as '{parameter.name}', not {argument.kind}"
            hint = _OF_FLOATS.get(function.name, "") if isinstance(argument.kind, FloatKind) else ""
            raise ExpressionError(argument.span, Code.WRONG_ARGUMENTS, message, hint)
