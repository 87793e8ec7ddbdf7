"""Messages of constants, which deadmen send in place of commands.

Their expressions are evaluated here, once. `lowering` encodes them like constants of any message.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

from router.compiler.expressions import tree
from router.compiler.expressions.functions import FUNCTIONS
from router.compiler.expressions.kinds import INT64, OCTET, UINT64, EnumKind, IntKind, Kind, ListKind
from router.compiler.expressions.operators import COMPUTED
from router.compiler.lowering.cdr import cdr_message
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.messages import Placed
from router.compiler.lowering.names import Names
from router.compiler.lowering.protobuf import protobuf_message
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.declared import Op
from router.errors import MappingError
from router.types.board_limits import BoardField, BoardMessage
from router.types.protobuf import PayloadCase

_Variables = Mapping[str, Any]

_RELATIONS: Mapping[tree.Relation, Callable[[Any, Any], bool]] = {
    tree.Relation.EQUAL: operator.eq,
    tree.Relation.UNEQUAL: operator.ne,
    tree.Relation.LESS: operator.lt,
    tree.Relation.LESS_OR_EQUAL: operator.le,
    tree.Relation.MORE: operator.gt,
    tree.Relation.MORE_OR_EQUAL: operator.ge,
}


def computed(plan: Record) -> Record:
    """Evaluate the expressions of a plan, which read no message. Raises MappingError."""
    with _failing():
        return _record(plan, {})


def envelope_of(plan: Record, case: PayloadCase) -> bytes:
    """Encode the envelope of a computed payload. Raises MappingError."""
    with _failing():
        return _bytes(protobuf_message(Lowering(Names({})), plan, case))


def cdr_of(plan: Record) -> bytes:
    """Encode a computed ROS message as CDR. Raises MappingError."""
    with _failing():
        return _bytes(cdr_message(Lowering(Names({})), plan))


def _bytes(placed: Sequence[Placed]) -> bytes:
    assert all(operation.kind is Op.KNOWN for operation, _ in placed)  # noqa: S101 - the plan has constants only
    return b"".join(operation.data for operation, _ in placed)


@contextmanager
def _failing() -> Iterator[None]:
    """Raise MappingError for a value that does not exist or does not fit."""
    try:
        yield
    except (ArithmeticError, LookupError, ValueError, struct.error) as error:
        raise MappingError(str(error)) from error


def scalars(plan: Record, fields: BoardMessage) -> Iterator[tuple[BoardField, object]]:
    """Yield the scalars of a computed payload with their fields, if boards have limits for them."""
    for member, made in plan.members:
        field = fields.get(member.number)
        for element in made.items if isinstance(made, Items) else (made,):
            if field is not None and isinstance(element, Record):
                yield from scalars(element, field.message or {})
            elif field is not None and isinstance(element, Leaf):
                yield field, element.constant


# plans


def _record(plan: Record, variables: _Variables) -> Record:
    members = tuple((member, _computed(made, variables)) for member, made in plan.members)
    return Record(plan.type, members, plan.span)


def _computed(plan: Plan, variables: _Variables) -> Plan:
    """Return the plan with constants in place of expressions."""
    match plan:
        case Leaf():
            return Leaf(plan.type, _constant(_value(plan.node, variables), plan), plan.span)
        case Record():
            return _record(plan, variables)
        case Items():
            return Items(plan.type, tuple(_computed(item, variables) for item in plan.items), plan.span)
        case Each():
            items = tuple(_computed(plan.element, each) for each in _turns(plan.lists, variables))
            wanted = plan.type.bound if plan.type.length is None else plan.type.length
            if wanted is not None and (len(items) > wanted or plan.type.length not in (None, len(items))):
                raise MappingError(f"{len(items)} elements do not fit {plan.type}")
            return Items(plan.type, items, plan.span)
        case Unset():
            return plan


def _constant(value: Any, plan: Leaf) -> tree.Node:
    if not isinstance(value, bytes):
        return tree.Constant(plan.node.kind, plan.span, value)
    octets = tree.ListLiteral(
        ListKind(OCTET, len(value)), plan.span, tuple(tree.whole(each, plan.span) for each in value)
    )
    return tree.Call(plan.node.kind, plan.span, "octets", (octets,))


def _turns(lists: Sequence[tuple[str, tree.Node]], variables: _Variables) -> Iterator[_Variables]:
    """Yield the variables for each index of parallel lists."""
    values = [_value(node, variables) for _, node in lists]
    for elements in zip(*values, strict=True):
        yield {**variables, **{name: element for (name, _), element in zip(lists, elements, strict=True)}}


# expressions


def _value(node: tree.Node, variables: _Variables) -> Any:  # noqa: C901, PLR0912 - one case per node
    match node:
        case tree.Constant():
            return node.value
        case tree.Variable():
            return variables[node.name]
        case tree.Element():
            return _value(node.values, variables)[node.index]
        case tree.ListLiteral():
            return [_value(item, variables) for item in node.items]
        case tree.Each():
            return [_value(node.element, each) for each in _turns(node.lists, variables)]
        case tree.Unary(operator=tree.Operator.NOT):
            return not _value(node.operand, variables)
        case tree.Unary():
            return _fitting(-_value(node.operand, variables), node.kind)
        case tree.Binary():
            operands = _value(node.left, variables), _value(node.right, variables)
            return _fitting(COMPUTED[node.operator](*operands), node.kind)
        case tree.Compare():
            values = (_value(operand, variables) for operand in node.operands)
            pairs = zip(node.relations, pairwise(values), strict=True)
            return all(_RELATIONS[relation](*pair) for relation, pair in pairs)
        case tree.Contains():
            sought = _value(node.sought, variables)
            return any(each == sought for each in _value(node.values, variables)) is not node.is_negated
        case tree.Logic():
            return (all if node.is_all else any)(_value(operand, variables) for operand in node.operands)
        case tree.Choice():
            return _value(node.body if _value(node.test, variables) else node.orelse, variables)
        case tree.Call():
            return _result(node, [_value(argument, variables) for argument in node.arguments])
        case tree.Read() | tree.Present():
            raise AssertionError("a constant reads no message")


def _fitting(value: Any, kind: Kind) -> Any:
    """Return the value. Raises MappingError for an integer outside the range of its kind."""
    if isinstance(kind, IntKind) and not kind.low <= value <= kind.high:
        raise MappingError(f"{value} is outside {kind.low}..{kind.high}")
    return value


def _result(node: tree.Call, arguments: Sequence[Any]) -> Any:
    """Evaluate a function, or one of `tree.CHECKS`."""
    value, *others = arguments
    match node.function:
        case "fit":
            return _fitting(value, IntKind(*others))
        case "fit_text":
            return _of_size(value, *others)
        case "octets":
            return bytes(value)
        case "named" | "member":
            return _of_enum(value, node.kind)
        case "sum":
            return _sum(value, node.kind)
        case name:
            return _called(name, arguments)


def _called(name: str, arguments: Sequence[Any]) -> Any:
    try:
        return FUNCTIONS[name].implementation(*arguments)
    except (ArithmeticError, ValueError) as error:
        given = ", ".join(map(repr, arguments))
        raise MappingError(f"{name}({given}) has no result") from error


def _of_size(value: str | bytes, most: int) -> str | bytes:
    size = len(value.encode() if isinstance(value, str) else value)
    if size > most:
        raise MappingError(f"{size} bytes are more than {most}")
    return value


def _of_enum(value: str | int, kind: Kind) -> int:
    """Return the number of an enum's value, given by name or number. Raises MappingError if it does not exist."""
    assert isinstance(kind, EnumKind)  # noqa: S101 - as `tree.CHECKS` says
    for name, number in kind.enum.values:
        if value in (name, number):
            return number
    raise MappingError(f"{value!r} is not a value of {kind.enum.name}")


def _sum(values: Sequence[Any], kind: Kind) -> Any:
    """Return the sum. Each partial sum of integers must fit."""
    if isinstance(kind, IntKind):
        limits = UINT64 if kind.high > INT64.high else INT64
        return functools.reduce(lambda total, value: _fitting(total + value, limits), values, 0)
    return functools.reduce(operator.add, values, 0.0)
