"""Lists in expressions: literals, elements, and computation element by element."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from router.compiler.expressions.kinds import (
    FloatKind,
    IntKind,
    Kind,
    ListKind,
    MessageKind,
    as_int,
    element_of,
    is_list,
    join,
    length_of,
)
from router.compiler.expressions.scope import ExpressionError, Scope
from router.compiler.expressions.tree import (
    Call,
    Constant,
    Each,
    Element,
    ListLiteral,
    Node,
    Read,
    Variable,
    constant_of,
    whole,
)
from router.errors import Code, SourceSpan

Make = Callable[[Sequence[Node]], Node]
"""Makes a node from scalar operands. Raises ExpressionError."""


def list_of(items: Sequence[Node], span: SourceSpan) -> ListLiteral:
    """Return a list literal. Its elements have a common kind, but each keeps its own."""
    element: Kind | None = items[0].kind if items else None
    for item in items[1:]:
        element = join(element, item.kind) if element else None
        if element is None:
            raise ExpressionError(item.span, Code.TYPE_MISMATCH, f"a list of {items[0].kind} cannot hold {item.kind}")
    return ListLiteral(ListKind(element, len(items)), span, tuple(items))


def item_of(holder: Node, index: Node, span: SourceSpan, scope: Scope) -> Node:
    """Return `holder[index]`."""
    element, length, position = element_of(holder.kind), length_of(holder.kind), constant_of(index)
    if element is None:
        raise ExpressionError(span, Code.TYPE_MISMATCH, f"a {holder.kind} has no elements", "only lists can be indexed")
    if not isinstance(position, int) or isinstance(position, bool) or position < 0:
        hint = "count from the first element, which is x[0]"
        if length is not None and isinstance(position, int) and -length <= position < 0:
            hint = f"for this element of {length}, write x[{length + position}]"
        what = "an index must be a literal integer, 0 or greater"
        raise ExpressionError(index.span, Code.FORBIDDEN_EXPRESSION, what, hint)
    if length is not None and position >= length:
        raise ExpressionError(index.span, Code.OUT_OF_RANGE, f"index {position} is out of range for {length} elements")
    if isinstance(holder, ListLiteral) and isinstance(element, MessageKind):
        return holder.items[position]
    if isinstance(holder, Each) and isinstance(element, MessageKind):
        return _message_in_element(holder, position)
    return Element(element, span, as_value(holder, scope), position)


def _message_in_element(messages: Each, position: int) -> Node:
    """Return `list.name[0]`, a message in each element of a list, as `list[0].name`."""
    ((_, values),) = messages.lists

    def read(node: Node) -> Node:
        if isinstance(node, Read):
            return replace(node, holder=read(node.holder))
        return Element(node.kind, node.span, values, position)

    return read(messages.element)


# element by element


def elementwise(make: Make, operands: Sequence[Node], span: SourceSpan, scope: Scope) -> Node:
    """Apply `make` to scalars, or to the elements of parallel lists."""
    lists = [operand for operand in operands if is_list(operand.kind)]
    if not lists:
        return make(operands)
    length = _common_length(lists, span)
    if any(isinstance(operand, ListLiteral) for operand in lists):
        _require_known_lengths(lists)
        assert length is not None  # noqa: S101 - that of the literal
        return list_of([make([_pick(operand, index) for operand in operands]) for index in range(length)], span)
    pairs: list[tuple[str, Node]] = []
    elements: list[Node] = []
    for operand in operands:
        if isinstance(operand, Each):
            pairs += operand.lists
            elements.append(operand.element)
        elif (kind := element_of(operand.kind)) is not None:
            variable = Variable(kind, operand.span, scope.element_variable())
            pairs.append((variable.name, operand))
            elements.append(variable)
        else:
            elements.append(operand)
    element = make(elements)
    return Each(ListKind(element.kind, length), span, tuple(pairs), element)


def _common_length(lists: Sequence[Node], span: SourceSpan) -> int | None:
    """Return the common length of these lists, None if it is not known."""
    lengths = sorted({length for node in lists if (length := length_of(node.kind)) is not None})
    if len(lengths) > 1:
        message = f"lists of {' and '.join(map(str, lengths))} elements cannot be combined"
        hint = "give them the same length"
        raise ExpressionError(span, Code.TYPE_MISMATCH, message, hint)
    return lengths[0] if lengths else None


def _require_known_lengths(lists: Sequence[Node]) -> None:
    """Reject a list of unknown length beside a literal."""
    for node in lists:
        if length_of(node.kind) is None:
            message = "only a list of known length can be combined with a list literal"
            hint = "index it, as in [a * x[0], b * x[1]]"
            raise ExpressionError(node.span, Code.TYPE_MISMATCH, message, hint)


def _pick(operand: Node, index: int) -> Node:
    """Return an element of a list of known length, or a scalar, which is the same for every element."""
    if isinstance(operand, ListLiteral):
        return operand.items[index]
    kind = element_of(operand.kind)
    return operand if kind is None else Element(kind, operand.span, operand, index)


# conversion to a common kind


def as_value(operand: Node, scope: Scope) -> Node:
    """Convert the elements of a list literal that is used as one value to their common kind."""
    return as_kind(operand, operand.kind, scope) if isinstance(operand, ListLiteral) else operand


def as_kind(operand: Node, kind: Kind, scope: Scope) -> Node:
    """Convert an operand to `kind`: an integer to a float, or to a narrower integer with a check."""
    wanted = element_of(kind) if is_list(kind) else None
    if wanted is not None:
        kinds = (
            [item.kind for item in operand.items] if isinstance(operand, ListLiteral) else [element_of(operand.kind)]
        )
        if not any(_has_to_be_converted(kind, wanted) for kind in kinds):
            return operand
        return elementwise(lambda parts: as_kind(parts[0], wanted, scope), [operand], operand.span, scope)
    if not _has_to_be_converted(operand.kind, kind):
        return operand
    if isinstance(kind, IntKind):
        return fitted(operand, kind)
    literal = constant_of(operand)
    if literal is None:
        return Call(kind, operand.span, "float64", (operand,))
    return Constant(kind, operand.span, float(literal))


def _has_to_be_converted(given: Kind | None, wanted: Kind) -> bool:
    if given is None:
        return False
    if is_list(given):
        return (inner := element_of(wanted)) is not None and _has_to_be_converted(element_of(given), inner)
    number = as_int(given)
    if number is None:
        return False
    return isinstance(wanted, FloatKind) or (isinstance(wanted, IntKind) and not wanted.holds(number))


def fitted(value: Node, kind: IntKind) -> Call:
    """Return an integer that is rejected at run time if it is out of range."""
    return limited("fit", value, kind, kind.low, kind.high)


def limited(function: str, value: Node, kind: Kind, *limits: int) -> Call:
    """Return a call of `function`, which checks at run time whether a value is within limits."""
    return Call(kind, value.span, function, (value, *(whole(limit, value.span) for limit in limits)))
