"""Lowers a checked expression to the operations that compute it.

The tree has the kind of each value, the range of each integer, and the results that must be checked. A value on the
stack is an integer, a real number, text, bytes or a list, depending on its kind; a time is its nanoseconds. A message
is on the stack only as an element of a list: its fields are read from a Section.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

from router.compiler.expressions import tree
from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.expressions.kinds import (
    BytesKind,
    FloatKind,
    Kind,
    ListKind,
    MessageKind,
    StringKind,
    TimeKind,
)
from router.compiler.lowering import functions, lists
from router.compiler.lowering.names import Names
from router.compiler.lowering.numbers import coerced, compare, signs, to_real
from router.compiler.lowering.operations import (
    DROP,
    Operation,
    Routine,
    Slot,
    chained,
    choice,
    integer,
    load,
    once,
    real,
    routine,
    store,
    text,
)
from router.compiler.lowering.sections import Section
from router.declared import Compared, Op, Scalar
from router.types.model import Field

_REALS: Mapping[tree.Operator, Op] = {
    tree.Operator.ADD: Op.REAL_ADD,
    tree.Operator.SUBTRACT: Op.REAL_SUBTRACT,
    tree.Operator.MULTIPLY: Op.REAL_MULTIPLY,
    tree.Operator.DIVIDE: Op.REAL_DIVIDE,
    tree.Operator.FLOOR_DIVIDE: Op.REAL_FLOOR_DIVIDE,
    tree.Operator.MODULO: Op.REAL_MODULO,
    tree.Operator.POWER: Op.REAL_POWER,
}
_INTEGERS: Mapping[tree.Operator, tuple[Op, Op]] = {
    tree.Operator.ADD: (Op.ADD, Op.CHECKED_ADD),
    tree.Operator.SUBTRACT: (Op.SUBTRACT, Op.CHECKED_SUBTRACT),
    tree.Operator.MULTIPLY: (Op.MULTIPLY, Op.CHECKED_MULTIPLY),
    tree.Operator.FLOOR_DIVIDE: (Op.DIVIDE, Op.DIVIDE),
    tree.Operator.MODULO: (Op.MODULO, Op.MODULO),
}
"""Operations without and with a check of the result."""


@dataclass(frozen=True, slots=True)
class Lowering:
    """Lowers the expressions of a target."""

    names: Names

    def value(self, node: tree.Node) -> Routine:
        """Return the operations that push the value of a node.

        A loop invariant is computed once, in the first iteration that needs it.
        """
        if (level := self._unchanged(node)) is None:
            return self._value(node)
        around, self.names.loops[level:] = self.names.loops[level:], []
        value = self._value(node)
        self.names.loops += around
        return once(value, self.names.flag(around[0]), self.names.temporary()) if _is_costly(value) else value

    def _unchanged(self, node: tree.Node) -> int | None:
        """Return the index in `loops` of the outermost loop in which a node is invariant; None if there is none."""
        loops = self.names.loops
        if not loops or not _can_be_kept(node):
            return None
        read, level = set(_variables(node)), len(loops)
        while level and not read & loops[level - 1].variables:
            level -= 1
        return level if level < len(loops) else None

    def _value(self, node: tree.Node) -> Routine:  # noqa: C901, PLR0912 - one case per node
        if isinstance(node.kind, ListKind):
            return lists.lower_list(self, node).routine
        match node:
            case tree.Constant():
                return _constant(node)
            case tree.Variable():
                return self._variable(node)
            case tree.Read():
                return self._field(node)
            case tree.Present():
                before, holder = self.message(node.holder)
                return routine(before, load(holder.presence(node.field)))
            case tree.Element():
                return self._element(node)
            case tree.Unary():
                return self._unary(node)
            case tree.Binary():
                return self._binary(node)
            case tree.Compare():
                return self._compare(node)
            case tree.Contains():
                return lists.contains(self, node)
            case tree.Logic():
                return chained(Op.AND if node.is_all else Op.OR, list(map(self.value, node.operands)))
            case tree.Choice():
                branches = (coerced(self.value(branch), branch.kind, node.kind) for branch in (node.body, node.orelse))
                return choice(self.value(node.test), *branches)
            case tree.Call():
                return functions.called(self, node)
            case _:
                raise AssertionError(f"{node.kind} is not a list")

    def real(self, node: tree.Node) -> Routine:
        """Return the operations that push a number as a real number."""
        return to_real(self.value(node), node.kind)

    # messages and their fields

    def message(self, node: tree.Node) -> tuple[Routine, Section]:
        """Return the operations that read a message into its section, and the section."""
        match node:
            case tree.Variable():
                meaning = self.names.variables[node.name]
                assert isinstance(meaning, Section)  # noqa: S101 - it is a message
                return (), meaning
            case tree.Read():
                before, holder = self.message(node.holder)
                return before, holder.message(node.field)
            case tree.Element():
                return lists.enter_element(self, node)
            case _:
                raise AssertionError(f"no message is computed, as by {type(node).__name__}")

    def _field(self, node: tree.Read) -> Routine:
        if isinstance(node.kind, TimeKind):
            return self.time(*self.message(node))
        before, holder = self.message(node.holder)
        if isinstance(node.kind, MessageKind):  # the only element of a list
            return routine(before, load(holder.value(node.field)), Operation(Op.ELEMENT, flag=Scalar.IN_CELLS))
        value = routine(before, load(holder.value(node.field)))
        return routine(value, Operation(Op.UTF8)) if _is_unchecked(holder, node.field, node.kind) else value

    def time(self, before: Routine, moment: Section) -> Routine:
        """Return the operations that push a message with seconds and nanoseconds as nanoseconds, which always fit."""
        seconds, nanoseconds = moment.type.fields
        whole = routine(load(moment.value(seconds)), integer(NS_PER_SECOND), Operation(Op.MULTIPLY))
        return routine(before, whole, load(moment.value(nanoseconds)), Operation(Op.ADD))

    def _variable(self, node: tree.Variable) -> Routine:
        meaning = self.names.variables[node.name]
        return (load(meaning),) if isinstance(meaning, Slot) else self.time((), meaning)

    def _element(self, node: tree.Element) -> Routine:
        if isinstance(node.kind, TimeKind) and lists.are_messages(node.values):
            return self.time(*lists.enter_element(self, node))
        return lists.element(self, node)

    # operators

    def _unary(self, node: tree.Unary) -> Routine:
        operand = self.value(node.operand)
        if node.operator is tree.Operator.NOT:
            return routine(operand, Operation(Op.NOT))
        if isinstance(node.kind, FloatKind):
            return routine(to_real(operand, node.operand.kind), Operation(Op.REAL_NEGATE))
        negate = Op.CHECKED_NEGATE if node.is_checked else Op.NEGATE
        return routine(operand, Operation(negate, flag=signs(node.kind, node.operand.kind)))

    def _binary(self, node: tree.Binary) -> Routine:
        if isinstance(node.kind, StringKind):
            self.names.count_text(functions.longest(node), node.span)
            return routine(self.value(node.left), self.value(node.right), Operation(Op.JOIN))
        if isinstance(node.kind, FloatKind):
            return routine(self.real(node.left), self.real(node.right), Operation(_REALS[node.operator]))
        if node.operator is tree.Operator.POWER:
            return self._power(node)
        operator = _INTEGERS[node.operator][node.is_checked]
        flag = signs(node.kind, node.left.kind, node.right.kind)
        return routine(self.value(node.left), self.value(node.right), Operation(operator, flag=flag))

    def _power(self, node: tree.Binary) -> Routine:
        """Lower a power of an integer to multiplications. Lower powers fit whenever the result fits."""
        assert isinstance(node.right, tree.Constant)  # noqa: S101 - exponents are literals
        exponent = int(node.right.value)
        base = self.value(node.left)
        if exponent == 0:
            return routine(base, DROP, integer(1))
        if exponent == 1:
            return base
        slot = self.names.temporary()
        multiply = Op.CHECKED_MULTIPLY if node.is_checked else Op.MULTIPLY
        kind = node.left.kind
        again = load(slot), Operation(multiply, flag=signs(kind, kind, kind))
        last = load(slot), Operation(multiply, flag=signs(node.kind, kind, kind))
        return routine(base, store(slot), again * (exponent - 2), last)

    def _compare(self, node: tree.Compare) -> Routine:
        """Lower comparisons. Each operand is evaluated once; evaluation stops at a comparison that is false."""
        slots = [self.names.temporary() for _ in node.operands[1:-1]]
        values = list(map(self.value, node.operands))
        firsts = [values[0], *((load(slot),) for slot in slots)]
        seconds = [*(routine(value, store(slot)) for value, slot in zip(values[1:], slots, strict=False)), values[-1]]
        kinds = pairwise(operand.kind for operand in node.operands)
        parts = [
            compare(relation, first, second, *both)
            for relation, first, second, both in zip(node.relations, firsts, seconds, kinds, strict=True)
        ]
        return chained(Op.AND, parts)


_COSTLY = frozenset({
    Op.REPEAT, Op.ENTER, Op.JOIN, Op.DIGITS, Op.CHARACTERS, Op.STRIP, Op.UTF8, Op.OCTETS, Op.UNPACK, Op.ELEMENT,
})  # fmt: skip
"""Operations whose time grows with a list, a text or a message."""


def _is_costly(computed: Routine) -> bool:
    return any(
        operation.kind in _COSTLY or (operation.kind is Op.COMPARE and operation.slot == Compared.TEXTS)
        for operation in computed
    )


def _can_be_kept(node: tree.Node) -> bool:
    """Return whether a value can stay in a slot between iterations: no list, and no text that the routine joins."""
    if isinstance(node.kind, StringKind):
        return isinstance(node, tree.Read) or (isinstance(node, tree.Element) and isinstance(node.values, tree.Read))
    return not isinstance(node, (tree.Constant, tree.Variable)) and not isinstance(
        node.kind, (ListKind, MessageKind, BytesKind)
    )


def _variables(node: tree.Node) -> Iterator[str]:
    """Return the names of all variables that a node reads."""
    return (each.name for each in tree.nodes_in(node) if isinstance(each, tree.Variable))


def _is_unchecked(holder: Section, member: Field, kind: Kind) -> bool:
    return isinstance(kind, StringKind) and holder.is_unchecked(member)


def _constant(node: tree.Constant) -> Routine:
    value = node.value
    if isinstance(value, str):
        return (text(value.encode()),)
    return (real(value) if isinstance(node.kind, FloatKind) else integer(int(value)),)
