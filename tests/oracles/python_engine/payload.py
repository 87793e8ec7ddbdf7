"""Generate the code that builds a payload with the protobuf classes, and puts the envelope around its bytes.

Fields are set one by one: that takes less time than constructors, and an error of protobuf has the position of the
line of the table that it comes from. Expects a plan without findings.
"""

from __future__ import annotations

import ast
import keyword
from collections.abc import Callable
from dataclasses import dataclass, field

from router.compiler.expressions.tree import Call, Constant, Element, Node, Read, Variable
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.compiler.python import NO_VALUES, Values, lists_of, render
from router.compiler.source import Source, attribute, call, load, placed
from router.types.model import Field, Float
from router.types.protobuf import PayloadCase
from router.types.wire import varint

_ONE_BYTE = 128
"""Lengths below this are varints of one byte."""


def write_envelope(out: Source, plan: Record, case: PayloadCase, name: str, values: Values = NO_VALUES) -> str:
    """Append the code that builds a payload, and return the expression that is the bytes of its envelope.

    `name` is part of the names that the code calls, and different for each payload of a function. `values` are the
    fields that were read.
    """
    methods = case.message_class  # called on the class: a field may have the name of a method
    make = out.constant(f"make_{name}", case.message_class)
    serialize = out.constant(f"serialize_{name}", methods.SerializeToString)
    present = out.constant(f"present_{name}", methods.SetInParent)
    clear = out.constant(f"clear_{name}", methods.Clear)
    envelope = out.constant(f"envelope_{name}", _envelope(case.number))
    out.line(f"payload = {make}()", plan.span)
    _Writer(out, present, clear, values).fill("payload", plan)
    return f"{envelope}({serialize}(payload))"


def _envelope(number: int) -> Callable[[bytes], bytes]:
    """Return a function that puts tag and length of a payload case in front of a payload's bytes."""
    tag = varint(number << 3 | 2)
    heads = tuple(tag + varint(size) for size in range(_ONE_BYTE))

    def envelope(payload: bytes) -> bytes:
        size = len(payload)
        return (heads[size] if size < _ONE_BYTE else tag + varint(size)) + payload

    return envelope


@dataclass(slots=True)
class _Writer:
    """Writes the statements that fill a message.

    `present` and `clear` are what the code calls for these methods. A submessage's variable is its holder's name
    and its own, so that it is used for nothing else while it is filled. `computed` are variables that may hold more
    than was read from a field.
    """

    out: Source
    present: str
    clear: str
    values: Values
    computed: set[str] = field(default_factory=lambda: {"item"})

    def fill(self, holder: str, plan: Record) -> None:
        for member, made in plan.members:
            where = ast.unparse(attribute(load(holder), member.name))
            inner = f"{holder}_{member.name}"
            match made:
                case Leaf():
                    self._set(holder, member, made)
                case Record():
                    self.out.line(f"{inner} = {where}", made.span)
                    self.out.line(f"{self.present}({inner})", made.span)
                    self.fill(inner, made)
                case Items():
                    for element in made.items:
                        self._add(where, inner, element)
                case Each():
                    self._add_each(where, inner, made)
                case Unset():
                    pass

    def _set(self, holder: str, member: Field, leaf: Leaf) -> None:
        if keyword.iskeyword(member.name) or member.name == "__debug__":
            self.out.line(f"setattr({holder}, {member.name!r}, {self._value(leaf)})", leaf.span)
        else:
            self.out.line(f"{holder}.{member.name} = {self._value(leaf)}", leaf.span)

    # repeated fields and maps

    def _add(self, where: str, inner: str, element: Plan) -> None:
        """Append one element. `where` is the repeated field, `inner` the variable for an element that is a message."""
        match element:
            case Leaf():
                self.out.line(f"{where}.append({self._value(element)})", element.span)
            case Record() if element.type.is_map_entry:
                self._put(where, inner, element)
            case Record():
                self.out.line(f"{inner} = {where}.add()", element.span)
                self.fill(inner, element)

    def _add_each(self, where: str, inner: str, each: Each) -> None:
        names, values = self._lists(each)
        self.computed.update(name for name, read in each.lists if not _is_read(read, self.computed))
        if not isinstance(each.element, Leaf):
            with self.out.block(f"for {names} in {values}:", each.span):
                self._add(where, inner, each.element)
            return
        value = self._value(each.element)
        node = each.element.node
        if not (isinstance(node, Variable) and node.name == names and self._is_fit(each.element)):
            values = f"[{value} for {names} in {values}]"
        self.out.line(f"{where}.extend({values})", each.span)

    def _put(self, where: str, inner: str, entry: Record) -> None:
        """Set one entry of a map; of two with the same key the later one stays."""
        plans = {member.name: made for member, made in entry.members}
        key, value = plans["key"], plans["value"]
        assert isinstance(key, Leaf)
        place = f"{where}[{self._value(key)}]"
        if isinstance(value, Leaf):
            self.out.line(f"{place} = {self._value(value)}", entry.span)
        elif isinstance(value, Record):
            self.out.line(f"{inner} = {place}", entry.span)
            self.out.line(f"{self.clear}({inner})", entry.span)
            self.fill(inner, value)

    # values

    def _value(self, leaf: Leaf) -> str:
        made = render(leaf.node, self.values)
        return self.out.expression(made if self._is_fit(leaf) else placed(call("float32", made), leaf.span))

    def _is_fit(self, leaf: Leaf) -> bool:
        """Whether protobuf takes the value as it is: it turns what is too large for a float32 into infinity."""
        return leaf.type != Float(32) or _is_read(leaf.node, self.computed)

    def _lists(self, each: Each) -> tuple[str, str]:
        """The variables of a loop, and what it iterates over."""
        names, values = lists_of(each.lists, self.values)
        length, bound = each.type.length, each.type.bound
        if length is not None or bound is not None:
            limits = (0, bound) if length is None else (length, length)
            values = call("fit_length", values, *map(ast.Constant, limits))
        return names, self.out.expression(placed(values, each.span))


def _is_read(node: Node, computed: set[str]) -> bool:
    """Whether the value was read from a field, or checked: where a float32 is filled, it is one already."""
    match node:
        case Constant() | Read() | Call(function="float32"):
            return True
        case Variable(name=name):
            return name not in computed
        case Element(values=values):
            return _is_read(values, computed)
        case _:
            return False
