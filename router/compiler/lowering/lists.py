"""Lists: loops over them, computation element by element, and functions of a whole list.

A list on the stack is stored as contiguous scalars, as in the message, or in cells. A loop copies its lists to slots
of its own, and removes the elements from the copies one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from router.compiler.expressions import tree
from router.compiler.expressions.kinds import (
    OCTET,
    BytesKind,
    FloatKind,
    Kind,
    ListKind,
    MessageKind,
    StringKind,
    TimeKind,
    element_of,
)
from router.compiler.lowering.names import Loop
from router.compiler.lowering.numbers import coerced, compare, signs
from router.compiler.lowering.operations import (
    DROP,
    SIZE,
    Operation,
    Routine,
    Slot,
    choice,
    integer,
    load,
    real,
    repeat,
    routine,
    store,
)
from router.compiler.lowering.sections import Section
from router.declared import Op, Scalar

if TYPE_CHECKING:
    from router.compiler.lowering.expressions import Lowering


_MOST_STACKED = 32
"""Maximum elements of a literal that are on the stack at once."""


@dataclass(frozen=True, slots=True)
class StoredList:
    """A list that `routine` pushes, stored as `scalar` specifies.

    `element` is the kind of its elements. Messages, which include ROS times, are read into sections like `message`.
    With `is_unchecked`, the elements are texts that may not be UTF-8.
    """

    routine: Routine
    scalar: Scalar
    element: Kind | None
    message: Section | None = None
    is_unchecked: bool = False

    @property
    def is_octets(self) -> bool:
        return self.scalar is Scalar.UINT8


def lower_list(lowering: Lowering, node: tree.Node) -> StoredList:
    """Lower a list, or bytes."""
    match node:
        case tree.Read() if isinstance(node.kind, ListKind):
            return _read(lowering, node)
        case tree.Variable():
            return _payloads(lowering, node)
        case tree.ListLiteral():
            return _listed(lowering, node)
        case tree.Each():
            return _computed(lowering, node)
        case tree.Choice():
            return _chosen(lowering, node)
        case _:
            assert isinstance(node.kind, BytesKind)  # noqa: S101 - nothing else gives a list
            return StoredList(lowering.value(node), Scalar.UINT8, OCTET)


def are_messages(node: tree.Node) -> bool:
    """Return whether elements are messages that must be read. Times in a field must be; computed times are values."""
    match node:
        case tree.Read():
            return isinstance(node.kind, ListKind) and isinstance(node.kind.element, (MessageKind, TimeKind))
        case tree.Variable() | tree.ListLiteral() | tree.Choice():
            return isinstance(node.kind, ListKind) and isinstance(node.kind.element, MessageKind)
        case _:
            return False


def _read(lowering: Lowering, node: tree.Read) -> StoredList:
    before, holder = lowering.message(node.holder)
    assert isinstance(node.kind, ListKind)  # noqa: S101 - the caller ensures it
    element = node.kind.element
    message = holder.inner(node.field) if isinstance(element, (MessageKind, TimeKind)) else None
    is_unchecked = isinstance(element, StringKind) and holder.is_unchecked(node.field)
    value = routine(before, load(holder.value(node.field)))
    return StoredList(value, holder.stored(node.field), element, message, is_unchecked)


def _payloads(lowering: Lowering, node: tree.Variable) -> StoredList:
    """Lower `items` of `collect`, the only variable that is a list: its messages are like the source message."""
    items, payload = lowering.names.variables[node.name], lowering.names.variables[tree.MESSAGE]
    assert isinstance(items, Slot)  # noqa: S101 - made by `Datagram.collect`
    assert isinstance(payload, Section)  # noqa: S101
    assert isinstance(node.kind, ListKind)  # noqa: S101 - the caller ensures it
    message = Section(payload.type, payload.descriptor, f"{node.name}[].")
    return StoredList((load(items),), Scalar.IN_CELLS, node.kind.element, message)


def _listed(lowering: Lowering, node: tree.ListLiteral) -> StoredList:
    element = node.kind.element
    items = [routine(lowering.value(item), *_as(item.kind, element)) for item in node.items]
    message: Section | None = None
    if isinstance(element, MessageKind):
        message = Section(element.type, None, "[].")  # only ROS messages are values
    if len(items) <= _MOST_STACKED:
        return StoredList(routine(*items, Operation(Op.LIST, size=len(items))), Scalar.IN_CELLS, element, message)
    filled = lowering.names.temporary()
    appended = (routine(item, Operation(Op.APPEND, filled)) for item in items)
    return StoredList(routine(_empty_list(filled), *appended, load(filled)), Scalar.IN_CELLS, element, message)


def _empty_list(slot: Slot) -> Routine:
    """Return the operations that put an empty list into a slot."""
    return Operation(Op.LIST, size=0), store(slot), DROP


def _as(kind: Kind, element: Kind | None) -> tuple[Operation, ...]:
    return coerced((), kind, element) if element is not None else ()


def _computed(lowering: Lowering, node: tree.Each) -> StoredList:
    slot = lowering.names.temporary()

    def append() -> Routine:
        element = node.kind.element
        assert element is not None  # noqa: S101 - it is computed
        return routine(lowering.value(node.element), *_as(node.element.kind, element), Operation(Op.APPEND, slot))

    filled = routine(_empty_list(slot), lower_loop(lowering, node.lists, append, keeps=True), load(slot))
    message: Section | None = None
    if isinstance(node.kind.element, MessageKind):
        message = Section(node.kind.element.type, None, "[].")  # only ROS messages are values
    return StoredList(filled, Scalar.IN_CELLS, node.kind.element, message)


def _chosen(lowering: Lowering, node: tree.Choice) -> StoredList:
    """Lower a choice between two lists. Both are converted to the same storage and kind of elements."""
    body, orelse = (lower_list(lowering, branch) for branch in (node.body, node.orelse))
    if isinstance(node.kind, ListKind) and node.kind.element is not None:
        body, orelse = (_with_elements(lowering, branch, node.kind.element) for branch in (body, orelse))
    if body.scalar is not orelse.scalar:
        body, orelse = map(_in_cells, (body, orelse))
    return replace(body, routine=choice(lowering.value(node.test), body.routine, orelse.routine))


def _in_cells(values: StoredList) -> StoredList:
    if values.scalar is Scalar.IN_CELLS:
        return values
    unpacked = routine(values.routine, Operation(Op.UNPACK, flag=values.scalar))
    return replace(values, routine=unpacked, scalar=Scalar.IN_CELLS)


def _with_elements(lowering: Lowering, values: StoredList, element: Kind) -> StoredList:
    """Convert the elements of a list to the kind `element`, even if the storage is the same."""
    kind = values.element
    is_moment = isinstance(element, TimeKind) and values.message is not None
    if kind is None or not (is_moment or values.is_unchecked or _as(kind, element)):
        return replace(values, element=element)
    filled, element_slot = lowering.names.temporary(), lowering.names.temporary()
    start = routine(_empty_list(filled), values.routine, store(element_slot), SIZE)
    taken, meaning = _take_element(lowering, values, element_slot)
    one = lowering.time((), meaning) if isinstance(meaning, Section) else ()
    body = routine(taken, one, *_as(kind, element), Operation(Op.APPEND, filled))
    return StoredList(routine(start, repeat(body, keeps=True), load(filled)), Scalar.IN_CELLS, element)


# ---- loops


def lower_loop(
    lowering: Lowering, lists: Sequence[tuple[str, tree.Node]], body: Callable[[], Routine], *, keeps: bool = False
) -> Routine:
    """Return a loop that repeats `body`, which uses the variables of `lists`, for each index of these parallel lists.

    `body` may change the top of the stack, but nothing below.
    """
    length, inputs = lower_lists(lowering, lists)
    before, turn = loop_body(lowering, inputs, body)
    return routine(length, before, repeat(turn, keeps=keeps))


LoopList = tuple[str, StoredList, Slot]
"""A variable, its list, and the slot with the remaining elements."""


def lower_lists(lowering: Lowering, lists: Sequence[tuple[str, tree.Node]]) -> tuple[Routine, list[LoopList]]:
    """Lower the lists of a loop: copy them to slots, and push their length, which must be the same."""
    count: Routine = ()
    inputs: list[LoopList] = []
    for variable, values in lists:
        of = lower_list(lowering, values)
        slot = lowering.names.temporary()
        count = routine(count, of.routine, store(slot), SIZE)
        if inputs:
            count = routine(count, Operation(Op.SAME_COUNT))
        inputs.append((variable, of, slot))
    return count, inputs


def loop_body(lowering: Lowering, inputs: Sequence[LoopList], body: Callable[[], Routine]) -> tuple[Routine, Routine]:
    """Return the operations before a loop, and its body, which handles the next element of each list."""
    before: Routine = ()
    for variable, of, slot in inputs:
        one, section = _take_element(lowering, of, slot)
        meaning = section or lowering.names.temporary()
        lowering.names.variables[variable] = meaning
        before = routine(before, one) if isinstance(meaning, Section) else routine(before, one, store(meaning), DROP)
    loop = Loop(frozenset(variable for variable, _, _ in inputs))
    lowering.names.loops.append(loop)
    turn = _elide_slot(routine(before, body()))
    lowering.names.loops.pop()
    return routine(*((integer(0), store(flag), DROP) for flag in loop.flags)), turn


def _take_element(lowering: Lowering, of: StoredList, slot: Slot) -> tuple[Routine, Section | None]:
    """Lower the removal of an element from a list. It is pushed, or read into a section if it is a message."""
    taken = Operation(Op.NEXT, slot, flag=of.scalar)
    if of.message is not None:
        section = lowering.names.element(of.message)
        return (taken, Operation(Op.ENTER, section)), section
    return ((taken, Operation(Op.UTF8)) if of.is_unchecked else (taken,)), None


def _elide_slot(body: Routine) -> Routine:
    """Leave an element on the stack instead of storing, dropping and loading it, if it is used only once."""
    for index, operation in enumerate(body[:-2]):
        if operation.kind is Op.KEEP:
            slot = operation.slot
            is_direct = body[index + 1].kind is Op.DROP and body[index + 2] == Operation(Op.LOAD, slot)
            uses = sum(operation.slot is slot for operation in body)
            return (*body[:index], *body[index + 3 :]) if is_direct and uses == 2 else body
        if operation.kind not in (Op.NEXT, Op.UTF8):
            break
    return body


# ---- elements


def element(lowering: Lowering, node: tree.Element) -> Routine:
    """Lower an element: a scalar, text or bytes, or a message that becomes an element of another list."""
    of = checked_list(lowering, node.values)
    return routine(of.routine, Operation(Op.ELEMENT, flag=of.scalar, number=node.index))


def enter_element(lowering: Lowering, node: tree.Element) -> tuple[Routine, Section]:
    """Lower a message in a list. Return the operations that read it into a section, and the section."""
    of = lower_list(lowering, node.values)
    assert of.message is not None  # noqa: S101 - the caller ensures it
    section = lowering.names.element(of.message)
    return routine(
        of.routine, Operation(Op.ELEMENT, flag=of.scalar, number=node.index), Operation(Op.ENTER, section)
    ), section


def checked_list(lowering: Lowering, node: tree.Node) -> StoredList:
    """Lower a list, and check that all its texts are UTF-8."""
    of = lower_list(lowering, node)
    if not of.is_unchecked:
        return of
    slot = lowering.names.temporary()
    body = Operation(Op.NEXT, slot, flag=of.scalar), Operation(Op.UTF8), DROP
    return replace(of, routine=routine(of.routine, store(slot), SIZE, repeat(body), of.routine), is_unchecked=False)


# ---- whole lists


def length(lowering: Lowering, node: tree.Node) -> Routine:
    """Lower len() of a list.

    The messages of a literal are not values, but must exist. A message in each element of a list is none either: there
    are as many as elements.
    """
    while isinstance(node, tree.Each) and isinstance(node.kind.element, MessageKind):
        ((_, node),) = node.lists
    if isinstance(node, tree.ListLiteral) and are_messages(node):
        return routine(*(lowering.message(item)[0] for item in node.items), integer(len(node.items)))
    return routine(checked_list(lowering, node).routine, SIZE)


def contains(lowering: Lowering, node: tree.Contains) -> Routine:
    """Lower `in`. All elements are evaluated."""
    sought = lowering.names.temporary()
    result = routine(lowering.value(node.sought), store(sought), DROP, integer(0))
    again = (load(sought),)

    def look(one: Routine, kind: Kind) -> Routine:
        is_it = compare(tree.Relation.EQUAL, one, again, kind, node.sought.kind)
        return routine(is_it, Operation(Op.EITHER))

    if isinstance(node.values, tree.ListLiteral):
        result = routine(result, *(look(lowering.value(item), item.kind) for item in node.values.items))
    else:
        result = routine(result, _folded(lowering, node.values, look))
    return routine(result, Operation(Op.NOT)) if node.is_negated else result


def total(lowering: Lowering, node: tree.Call) -> Routine:
    """Lower sum(). Each partial sum of integers is checked."""
    (values,) = node.arguments
    is_real = isinstance(node.kind, FloatKind)

    def add(one: Routine, kind: Kind) -> Routine:
        if is_real:
            return routine(coerced(one, kind, node.kind), Operation(Op.REAL_ADD))
        return routine(one, Operation(Op.CHECKED_ADD, flag=signs(node.kind, node.kind, kind)))

    return routine(real(0.0) if is_real else integer(0), _folded(lowering, values, add))


def extreme(lowering: Lowering, node: tree.Call, of_integers: Op, of_reals: Op) -> Routine:
    """Lower min() or max() of a list: the loop begins with the first element. An empty list is rejected."""
    of = lower_list(lowering, node.arguments[0])
    kind = of.element
    assert kind is not None  # noqa: S101 - a number
    whole, left = lowering.names.temporary(), lowering.names.temporary()
    operator = of_reals if isinstance(kind, FloatKind) else of_integers
    step = Operation(operator, flag=0 if isinstance(kind, FloatKind) else signs(kind, kind, kind))
    first = routine(of.routine, store(whole), Operation(Op.ELEMENT, flag=of.scalar))
    rest = routine(load(whole), store(left), SIZE, repeat((Operation(Op.NEXT, left, flag=of.scalar), step)))
    return coerced(routine(first, rest), kind, node.kind)


def _folded(lowering: Lowering, values: tree.Node, step: Callable[[Routine, Kind], Routine]) -> Routine:
    """Return a loop that combines each element with the top of the stack. A computed list is not stored."""
    if isinstance(values, tree.Each):
        loop = values
    else:
        kind = element_of(values.kind)
        assert kind is not None  # noqa: S101 - it is compared or added
        name = f"element {len(lowering.names.temporaries)}"
        listed = values.kind if isinstance(values.kind, ListKind) else ListKind(kind)
        loop = tree.Each(listed, values.span, ((name, values),), tree.Variable(kind, values.span, name))
    return lower_loop(lowering, loop.lists, lambda: step(lowering.value(loop.element), loop.element.kind))
