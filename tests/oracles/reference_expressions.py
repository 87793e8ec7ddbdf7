"""The oracle's expressions, as in docs/reference/table.md, with Python's exact integers and doubles.

Evaluates the user's syntax for a message. Expects expressions that the compiler has accepted; see `reference`. If
several parts of an expression have no result, the reason of any of them is correct, because the page does not define
the order of evaluation.
"""

from __future__ import annotations

import ast
import keyword
import math
import operator
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from router.table.model.expressions import Choices, Expression
from router.types.model import Enum, Int, List, MessageType, Type
from tests.oracles.reference_functions import (
    FUNCTIONS,
    OPERATORS,
    Rule,
    extreme_of,
    kind_of_sum,
    negate,
    same_number,
    sum_of,
)
from tests.oracles.reference_kinds import (
    MAPPING_ERROR,
    Computation,
    EnumNumber,
    Kind,
    Listing,
    Member,
    Message,
    Nanoseconds,
    Real,
    Refused,
    Text,
    Time,
    Truth,
    View,
    Whole,
    all_of,
    joined,
    kind_of,
    known,
    number,
    shaped,
)


@dataclass(frozen=True, slots=True)
class Context:
    """The environment of expressions: a message, its sender, its time (ns since 1970), and constants by holder.

    `names` are additional values with their kinds, which take precedence over fields of the same name. In `each`, the
    view is a message of a list, and `message` the whole source message.
    """

    view: View
    source: str
    received_at: int
    enums: Collection[Enum]
    ros_types: Collection[MessageType]
    names: Mapping[str, tuple[Any, Kind]] = field(default_factory=dict)
    message: View | None = None

    def whole(self) -> View:
        """The source message."""
        return self.view if self.message is None else self.message

    def of_element(self, element: View) -> Context:
        """The environment of the fields of `each`, for a message of its list."""
        names = {name: named for name, named in self.names.items() if element.type.field(name) is None}
        names["item"] = (element, Message(element.type))
        return replace(self, view=element, names=names, message=self.whole())


@dataclass(frozen=True, slots=True)
class Meaning:
    """The meaning of an expression: its kind, and a function from a context of the same types to its value.

    `items` are the items of a list literal, whose kinds may differ. `constant` is a value known at compile time.
    `elements` computes the elements of a computed list one by one; otherwise it is None.
    """

    kind: Kind
    give: Callable[[Context], Any]
    items: tuple[Meaning, ...] | None = None
    constant: Any = None
    elements: Callable[[Context], list[Computation]] | None = None


def evaluate(expression: Expression, context: Context, expected: Type | None = None) -> Any:
    """The value of an expression; `expected` is the type of the field that it fills. Raises Refused."""
    return value_of(meaning_of(expression, context, expected), context)


def value_of(meaning: Meaning, context: Context) -> Any:
    """The value of a meaning. The items of a list literal stay unconverted, because each fills one element."""
    if isinstance(meaning.kind, Listing):
        return all_of(elements_of(meaning, context))
    return meaning.give(context)


def elements_of(meaning: Meaning, context: Context) -> list[Computation]:
    """The uncomputed elements of a list. Raises Refused if it combines lists of different lengths."""
    if meaning.items is not None:
        return [partial(value_of, item, context) for item in meaning.items]
    return _elements(meaning, context)


def meaning_of(expression: Expression, context: Context, expected: Type | None = None) -> Meaning:
    """The meaning of an expression in all contexts with these types."""
    if expression.items is not None:
        return _literal([meaning_of(item, context, _innermost(expected)) for item in expression.items])
    if expression.literal:
        return _constant(Text(), expression.text)
    if expression.choices is not None:
        return _chosen(expression.choices, context, expected)
    syntax = ast.parse(_without_words(expression.text.replace("\n", " ").strip()), mode="eval").body
    return _Reader(context).read(syntax, expected)


def _innermost(expected: Type | None) -> Type | None:
    return expected.element if isinstance(expected, List) else expected


# ---- field names that are words of Python

_PREFIX = "word_of_python_"
_ONLY_AFTER_A_DOT = frozenset(
    {"and", "or", "not", "in", "is", "if", "else", "lambda", "for", "await", "yield", "True", "False", "None"}
)
_NAMES = re.compile(r"""'[^']*'|"[^"]*"|(?P<dot>\.\s*)?\b(?P<name>[A-Za-z_]\w*)""")


def _without_words(text: str) -> str:
    """The text with names that Python can parse."""

    def replaced(match: re.Match[str]) -> str:
        name, dot = match["name"], match["dot"]
        if not name or not keyword.iskeyword(name) or (not dot and name in _ONLY_AFTER_A_DOT):
            return match[0]
        return f"{dot or ''}{_PREFIX}{name}"

    return _NAMES.sub(replaced, text)


def _name(name: str) -> str:
    return name.removeprefix(_PREFIX)


# ---- meanings of parts


def _constant(kind: Kind, value: Any) -> Meaning:
    return Meaning(kind, lambda _: value, constant=value)


def _literal(items: Sequence[Meaning]) -> Meaning:
    """The meaning of a list literal. As one value, its elements have a common kind."""
    kind = Listing(joined([item.kind for item in items]) if items else None, len(items))
    each = [_as_value(item) for item in items]
    made = _list_of(kind, lambda context: _shaped_elements([partial(item.give, context) for item in each], kind))
    return replace(made, items=tuple(items))


def _as_value(meaning: Meaning) -> Meaning:
    return replace(meaning, items=None)


def _together(meanings: Sequence[Meaning], context: Context) -> list[Any]:
    return all_of([partial(each.give, context) for each in meanings])


def _applied(rule: Rule, operands: Sequence[Meaning], *, folds: bool = False) -> Meaning:
    """A rule for scalars, applied element by element where an operand is a list."""
    if any(operand.items is not None for operand in operands):
        return _literal([_applied(rule, parts, folds=folds) for parts in _item_by_item(operands)])
    element_kinds = [each.kind.element if isinstance(each.kind, Listing) else each.kind for each in operands]
    kind, compute = rule([each for each in element_kinds if each is not None], [each.constant for each in operands])
    lists = [each.kind for each in operands if isinstance(each.kind, Listing)]

    if not lists:

        def give(context: Context) -> Any:
            return _computed(compute, kind, [partial(each.give, context) for each in operands])

        if folds and all(operand.constant is not None for operand in operands):
            return _folded(kind, give)
        return Meaning(kind, give)

    def elements(context: Context) -> list[Computation]:
        columns = iter(_side_by_side([each for each in operands if isinstance(each.kind, Listing)], context))
        cells = [next(columns) if isinstance(each.kind, Listing) else partial(each.give, context) for each in operands]
        count = max(len(cell) for cell in cells if isinstance(cell, list))
        rows = [[cell[index] if isinstance(cell, list) else cell for cell in cells] for index in range(count)]
        return [partial(_computed, compute, kind, row) for row in rows]

    lengths = [each.length for each in lists if each.length is not None]
    return _list_of(Listing(kind, lengths[0] if lengths else None), elements)


def _side_by_side(lists: Sequence[Meaning], context: Context) -> list[list[Computation]]:
    """The elements of lists side by side. If the lengths differ, some elements may be computed before the refusal."""
    try:
        columns = all_of([partial(_elements, each, context) for each in lists])
        if len({len(column) for column in columns}) > 1:
            raise Refused(MAPPING_ERROR)
    except Refused as refused:
        all_of([partial(_refuse, refused), *(partial(each.give, context) for each in lists)])
    return columns


def _refuse(refused: Refused) -> None:
    raise refused


def _read(message: Computation, name: str) -> Any:
    return message().read(name)


def _computed(compute: Callable[..., Any], kind: Kind, operands: Sequence[Computation]) -> Any:
    return shaped(compute(*all_of(operands)), kind)


def _list_of(kind: Listing, elements: Callable[[Context], list[Computation]]) -> Meaning:
    return Meaning(kind, lambda context: all_of(elements(context)), elements=elements)


def _elements(values: Meaning, context: Context) -> list[Computation]:
    if values.elements is not None:
        return values.elements(context)
    return known(values.give(context))


def _folded(kind: Kind, give: Callable[[Context], Any]) -> Meaning:
    """The constant that an operator gives for constant operands."""
    value = give(None)  # type: ignore[arg-type]
    return _constant(Whole(value, value) if isinstance(kind, Whole) else kind, value)


def _item_by_item(operands: Sequence[Meaning]) -> list[tuple[Meaning, ...]]:
    (length,) = {each.kind.length for each in operands if isinstance(each.kind, Listing)}
    assert length is not None
    return [
        tuple(_element(each, index) if isinstance(each.kind, Listing) else each for each in operands)
        for index in range(length)
    ]


def _element(values: Meaning, index: int) -> Meaning:
    assert isinstance(values.kind, Listing)
    assert values.kind.element is not None
    if values.items is not None:
        return values.items[index]
    return Meaning(values.kind.element, lambda context: values.give(context)[index])


def _choice(test: Meaning, body: Meaning, orelse: Meaning) -> Meaning:
    kind = joined([body.kind, orelse.kind])

    def chosen(context: Context) -> Meaning:
        return body if test.give(context) else orelse

    if isinstance(kind, Listing):
        return _list_of(kind, lambda context: _shaped_elements(_elements(chosen(context), context), kind))
    return Meaning(kind, lambda context: shaped(chosen(context).give(context), kind))


def _shaped_elements(elements: Sequence[Computation], kind: Listing) -> list[Computation]:
    return [partial(_computed, lambda value: value, kind.element, [each]) for each in elements if kind.element]


def _chosen(choices: Choices, context: Context, expected: Type | None) -> Meaning:
    """The meaning of a map: nested choices by the value of its subject, the first one outermost."""
    subject = meaning_of(choices.subject, context)
    values = [(name.value, meaning_of(value, context, expected)) for name, value in choices.values]

    def refuse(_: Context) -> Any:
        raise Refused(MAPPING_ERROR)

    made = (
        meaning_of(choices.otherwise, context, expected)
        if choices.otherwise is not None
        else Meaning(values[-1][1].kind, refuse)
    )
    for name, value in reversed(values):
        key = _key(name, subject.kind, context)
        made = _choice(_equals(subject, key), value, made)
    return made


def _equals(subject: Meaning, key: Any) -> Meaning:
    return Meaning(Truth(), lambda context: bool(subject.give(context) == key))


def _key(name: str, kind: Kind, context: Context) -> Any:
    if isinstance(kind, Member):
        return dict(kind.enum.values)[name]
    if isinstance(kind, Text):
        return name
    if name in context.view.type.constants:
        return context.view.type.constants[name]
    return _Reader(context).read(ast.parse(name, mode="eval").body).constant


_RELATIONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
    ast.GtE: operator.ge, ast.In: lambda x, values: any(x == each for each in values),
    ast.NotIn: lambda x, values: all(x != each for each in values),
}  # fmt: skip
_SYMBOLS: dict[type[ast.operator], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%", ast.Pow: "**",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Reader:
    """Converts syntax to a Meaning. Uses only the types of the context."""

    context: Context

    def read(self, node: ast.expr, expected: Type | None = None) -> Meaning:  # noqa: C901, PLR0912 - a case a syntax
        match node:
            case ast.Constant(value):
                return self._literal_of(value)
            case ast.List(elements):
                return _literal([self.read(each, _innermost(expected)) for each in elements])
            case ast.Name(name):
                return self._named(_name(name), expected)
            case ast.Attribute():
                return self._attribute(node)
            case ast.Subscript(values, index):
                return self._indexed(self.read(values), self.read(index).constant)
            case ast.UnaryOp(ast.Not(), operand):
                truth = self.read(operand)
                return Meaning(Truth(), lambda context: not truth.give(context))
            case ast.UnaryOp(op, operand):
                return _applied(negate if isinstance(op, ast.USub) else same_number, [self.read(operand)], folds=True)
            case ast.BinOp(left, op, right):
                return _applied(OPERATORS[_SYMBOLS[type(op)]], [self.read(left), self.read(right)], folds=True)
            case ast.BoolOp(op, operands):
                return self._logic(all if isinstance(op, ast.And) else any, [self.read(each) for each in operands])
            case ast.Compare():
                return self._comparison(node)
            case ast.IfExp(test, body, orelse):
                return _choice(self.read(test), self.read(body, expected), self.read(orelse, expected))
            case ast.Call(ast.Name("has"), [of]):
                return self._presence(of)
            case ast.Call(ast.Name(name), arguments):
                return self._call(name, [self.read(each) for each in arguments], expected)
            case _:
                raise TypeError(f"{type(node).__name__} is not part of the language")

    @staticmethod
    def _literal_of(value: Any) -> Meaning:
        match value:
            case bool():
                return _constant(Truth(), value)
            case int():
                return _constant(Whole(value, value), value)
            case float():
                return _constant(Real(), value)
            case _:
                return _constant(Text(), value)

    # names

    def _field(self, holder: Meaning, name: str) -> Meaning:
        if isinstance(holder.kind, Listing):
            return self._field_of_each(holder, holder.kind, name)
        assert isinstance(holder.kind, Message)
        member = holder.kind.type.field(name)
        assert member is not None, f"{holder.kind.type} has no field '{name}'"
        return Meaning(kind_of(member.type), lambda context: holder.give(context).read(name))

    def _field_of_each(self, holders: Meaning, kind: Listing, name: str) -> Meaning:
        """The field of each message in a list."""
        if holders.items is not None:
            return _literal([self._field(each, name) for each in holders.items])
        assert isinstance(kind.element, Message)
        member = kind.element.type.field(name)
        assert member is not None, f"{kind.element.type} has no field '{name}'"

        def elements(context: Context) -> list[Computation]:
            return [partial(_read, each, name) for each in _elements(holders, context)]

        return _list_of(Listing(kind_of(member.type), kind.length), elements)

    def _message(self) -> Meaning:
        return Meaning(Message(self.context.view.type), lambda context: context.view)

    def _is_variable(self, name: str) -> bool:
        is_given = name in ("message", "source", "received_at")
        return is_given or name in self.context.names or self.context.view.type.field(name) is not None

    def _named(self, name: str, expected: Type | None) -> Meaning:
        if name in self.context.names:
            return Meaning(self.context.names[name][1], lambda context: context.names[name][0])
        if self.context.view.type.field(name) is not None:
            return self._field(self._message(), name)
        values = dict(expected.values) if isinstance(expected, Enum) else {}
        match name:
            case "message":
                return Meaning(Message(self.context.whole().type), lambda context: context.whole())
            case "source":
                return Meaning(Text(), lambda context: context.source)
            case "received_at":
                return Meaning(Time(), lambda context: Nanoseconds(context.received_at))
            case "true" | "false":
                return _constant(Truth(), name == "true")
            case _ if isinstance(expected, Enum) and name in values:
                return _constant(Member(expected), EnumNumber(values[name]))
            case _:
                return _constant(Real(), {"nan": math.nan, "inf": math.inf}[name])

    def _attribute(self, node: ast.Attribute) -> Meaning:
        root: ast.expr = node
        while isinstance(root, ast.Attribute):
            root = root.value
        if isinstance(root, ast.Name) and not self._is_variable(_name(root.id)):
            return self._constant_of(ast.unparse(node.value), _name(node.attr))
        return self._field(self.read(node.value), _name(node.attr))

    def _constant_of(self, holder: str, name: str) -> Meaning:
        """`SensorState.SENSOR_ERROR`: looks in the message's enums, then for this exact name, then in all enums."""
        own = f"{self.context.view.type.name}.{holder}"
        others = [enum.name for enum in self.context.enums if enum.name.endswith(f".{holder}")]
        for full_name in [own, holder, *others]:
            for enum in self.context.enums:
                if enum.name == full_name and name in dict(enum.values):
                    return _constant(Member(enum), EnumNumber(dict(enum.values)[name]))
        for ros in self.context.ros_types:
            if ros.short_name == holder and name in ros.constants:
                return self._literal_of(ros.constants[name])
        raise KeyError(f"there is no {holder}.{name}")

    def _presence(self, node: ast.expr) -> Meaning:
        if isinstance(node, ast.Attribute):
            holder, name = self.read(node.value), _name(node.attr)
        else:
            holder, name = self._message(), _name(ast.unparse(node))
        return Meaning(Truth(), lambda context: bool(holder.give(context).message.HasField(name)))

    # decisions

    @staticmethod
    def _logic(decide: Callable[[Any], bool], operands: Sequence[Meaning]) -> Meaning:
        return Meaning(Truth(), lambda context: decide(operand.give(context) for operand in operands))

    def _comparison(self, node: ast.Compare) -> Meaning:
        first, *others = [self.read(each) for each in (node.left, *node.comparators)]
        compare = [_RELATIONS[type(op)] for op in node.ops]

        def give(context: Context) -> bool:
            left, *values = _together([first, others[0]], context)
            for place, relation in enumerate(compare):
                right = values[0] if place == 0 else others[place].give(context)
                if not relation(left, right):
                    return False
                left = right
            return True

        return Meaning(Truth(), give)

    # lists and functions

    @staticmethod
    def _indexed(values: Meaning, index: int) -> Meaning:
        assert isinstance(values.kind, Listing)
        assert values.kind.element is not None

        def give(context: Context) -> Any:
            elements = values.give(context)
            if index >= len(elements):
                raise Refused(MAPPING_ERROR)
            return elements[index]

        return Meaning(values.kind.element, give)

    def _call(self, name: str, arguments: list[Meaning], expected: Type | None) -> Meaning:
        if isinstance(arguments[0].kind, Listing) and len(arguments) == 1 and name in ("len", "min", "max", "sum"):
            return _of_a_list(name, _as_value(arguments[0]), arguments[0].kind)
        bounds = _innermost(expected)
        if name in ("clamp", "wrap") and len(arguments) == 1:
            assert isinstance(bounds, Int)
            arguments += [self._literal_of(bounds.low), self._literal_of(bounds.high)]
        return _applied(FUNCTIONS[name], arguments)


def _of_a_list(name: str, values: Meaning, kind: Listing) -> Meaning:
    match name:
        case "len":
            return Meaning(Whole(0, (1 << 32) - 1), lambda context: len(values.give(context)))
        case "sum":
            made = kind_of_sum(kind)
            return Meaning(made, lambda context: sum_of(values.give(context), made))
        case _:
            assert kind.element is not None
            of = number(kind.element)
            return Meaning(of, lambda context: shaped(extreme_of(name, values.give(context)), of))
