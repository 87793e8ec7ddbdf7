"""The output of `router explain --code`: what the carrier reads from a message, and its operations with their places.

Operations have the names of `native/operations.h`, which describes them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

from router.compiler.checked import CheckedRoute, Target
from router.compiler.compiled_table import CompiledTable
from router.compiler.expressions import tree
from router.compiler.lowering import Lowered, LoweredCollect, LoweredElements, LoweredFeed, LoweredOrder
from router.compiler.lowering.layout import Layout, ReadOperation, WantedField
from router.compiler.lowering.operations import Operation, Routine
from router.declared import NONE, Compared, Op, ReadKind, Relation, Scalar, Sign
from router.errors import plural

_INDENT = "  "
_MOST_SHOWN = 16
"""Bytes of a literal that are shown."""


def listed_route(checked: CheckedRoute, program: CompiledTable) -> Iterator[str]:
    """Yield all routines of a route."""
    lowered: Lowered = program.lowered
    name = checked.route.name
    if checked.order is not None:
        yield from _order(lowered.order[name], str(checked.order.number.span))
    for kind, routes in (
        ("destination", lowered.to_destinations),
        ("topic", lowered.to_topics),
        ("reply to", lowered.replies),
    ):
        if name in routes:
            route = routes[name]
            yield from _layout(route.layout)
            if route.collect is not None:
                yield from _collect(route.collect, route.layout, next(iter(route.targets.values())))
            for target in route.targets.values():
                yield from _target(kind, target, route.layout)
    for topic, feeds in lowered.from_ros.items():
        for feed in feeds:
            if feed.route == name:
                yield from _feed(topic, feed)


def _feed(topic: str, feed: LoweredFeed) -> Iterator[str]:
    yield ""
    yield f"  from topic {topic}"
    yield from _layout(feed.layout)
    if feed.for_each is not None:
        yield from _for_each(feed.for_each, feed.layout, next(iter(feed.targets.values())))
    for target in feed.targets.values():
        yield from _target("destination", target, feed.layout)


# ---- what is read


def _layout(layout: Layout) -> Iterator[str]:
    for number, (section, message) in enumerate(zip(layout.sections, layout.messages, strict=True)):
        if section.reads:
            yield ""
            yield f"  reads {message}, section {number}"
        yield from _fields([read for read in section.reads if isinstance(read, WantedField)], layout)
        depth = 2
        for step in section.reads:
            if isinstance(step, ReadOperation):
                depth -= step.kind is ReadKind.AGAIN
                yield _INDENT * depth + _step(step, layout)
                depth += step.kind in (ReadKind.EACH, ReadKind.EACH_SEQUENCE)


def _fields(fields: list[WantedField], layout: Layout) -> Iterator[str]:
    """Yield the fields of a protobuf message that are read, and the slots that say which member of a oneof is set."""
    for field in fields:
        places = [_slot(slot, layout) for slot in (field.slot, field.presence) if slot != NONE]
        places += [f"section {field.section}"] if field.section != NONE else []
        if places:
            repeated = "repeated " * field.is_repeated
            yield f"    field {field.number}: {repeated}{_word(field.type)} -> {', '.join(places)}"
    for choice in dict.fromkeys(field.choice for field in fields if field.choice != NONE):
        yield f"    oneof -> {_slot(choice, layout)}"


def _step(step: ReadOperation, layout: Layout) -> str:
    """Return one step through a ROS message."""
    to = f" -> {_slot(step.slot, layout)}" if step.slot != NONE else ""
    match step.kind:
        case ReadKind.SCALAR:
            return f"{_word(step.type)}{to}"
        case ReadKind.SKIP:
            aligned = f", aligned to {step.size}" if step.size > 1 else ""
            return f"skip {plural(step.elements * step.size, 'byte')}{aligned}"
        case ReadKind.ARRAY:
            return f"{_word(step.type)}[{step.elements}]{to}"
        case ReadKind.SEQUENCE if to:
            return f"{_word(step.type)}[]{to}"
        case ReadKind.SEQUENCE:
            return f"skip a sequence, of {plural(step.size, 'byte')} each"
        case ReadKind.EACH:
            return f"each of {step.elements}{to}"
        case ReadKind.EACH_SEQUENCE:
            return f"each of a sequence{to}"
        case _:
            return f"{_word(step.kind)}{to}"


# ---- operations


def _target(kind: str, target: Target, layout: Layout) -> Iterator[str]:
    if target.elements is not None:
        yield from _for_each(target.elements, layout, target)
    yield ""
    yield f"  {kind} {target.label}"
    _, when, _, _, *places = target.places
    yield from _listed(target.condition, [when] * len(target.condition), layout)
    yield from _listed(target.message, places, layout)


def _for_each(elements: LoweredElements, layout: Layout, target: Target) -> Iterator[str]:
    _, _, _, place, *_ = target.places
    yield ""
    yield f"  elements, {_stored(elements.scalar)}"
    yield from _listed(elements.routine, [place] * len(elements.routine), layout)
    slots = [_slot(slot, layout) for slot in (elements.item, elements.index, elements.count) if slot != NONE]
    into = [f"section {elements.section}"] * (elements.section != NONE) + slots
    yield f"    each -> {', '.join(into)}" if into else "    each"


def _order(order: LoweredOrder, place: str) -> Iterator[str]:
    yield from _layout(order.layout)
    yield ""
    yield f"  order, {order.bits} bits"
    yield from _listed(order.routine, [place] * len(order.routine), order.layout)


def _collect(collect: LoweredCollect, layout: Layout, target: Target) -> Iterator[str]:
    _, _, place, *_ = target.places
    for what, routine in (("frame", collect.by), ("its size", collect.count), ("the place in it", collect.order)):
        yield ""
        yield f"  {what}"
        yield from _listed(routine, [place] * len(routine), layout)
    slots = [_slot(slot, layout) for slot in (collect.items, collect.counted) if slot != NONE]
    if slots:
        yield f"    all of a frame -> {', '.join(slots)}"


def _listed(routine: Routine, places: list[str], layout: Layout) -> Iterator[str]:
    """Yield one numbered operation per line, below its place where that changes. Loops are indented."""
    depth = 0
    before = ""
    for number, (operation, place) in enumerate(zip(routine, places, strict=True)):
        if place != before:
            span, _, field = place.partition(": ")
            yield f"    # {field}  ({span})" if field else f"    # {span}"
            before = place
        depth -= operation.kind is Op.AGAIN
        words = _OPERANDS.get(operation.kind, _signs)(_Line(number, operation, layout))
        yield f"    {number:4}  {_INDENT * depth}{_word(operation.kind):16}  {words}".rstrip()
        depth += operation.kind is Op.REPEAT


@dataclass(frozen=True, slots=True)
class _Line:
    """An operation and its number in the routine."""

    number: int
    operation: Operation
    layout: Layout

    @property
    def index(self) -> int:
        """The operation's `slot` as a number."""
        slot = self.operation.slot
        return slot if isinstance(slot, int) else slot.index


def _of_slot(line: _Line) -> str:
    return _slot(line.index, line.layout)


def _jump(line: _Line) -> str:
    return f"to {line.number + 1 + line.operation.size}"


def _number(line: _Line) -> str:
    return repr(line.operation.number)


def _text(line: _Line) -> str:
    return repr(line.operation.data.decode("utf-8", "backslashreplace"))


def _known(line: _Line) -> str:
    data = line.operation.data
    shown = data[:_MOST_SHOWN].hex(" ")
    rest = f" ... ({len(data)} bytes)" if len(data) > _MOST_SHOWN else ""
    return shown + rest + (f", aligned to {line.index}" if line.index > 1 else "")


def _repeat(line: _Line) -> str:
    return f"up to {line.number + line.operation.size}" + ", keeping what is made" * bool(line.operation.flag)


def _compare(line: _Line) -> str:
    spelling = tree.Relation[Relation(line.operation.flag).name].value
    return f"{spelling}  {_word(Compared(line.index))}"


def _member(line: _Line) -> str:
    numbers = struct.unpack(f"<{line.operation.size}i", line.operation.data)
    return f"of {', '.join(map(str, numbers))}"


def _of_stored(line: _Line) -> str:
    return _stored(Scalar(line.operation.flag))


def _element(line: _Line) -> str:
    return f"[{line.operation.number}], {_of_stored(line)}"


def _tag(line: _Line) -> str:
    """Return the field of a protobuf message; packed elements have none."""
    return f"field {line.operation.size >> 3}" if line.operation.size else "no tag"


def _open(line: _Line) -> str:
    return _tag(line) + ", left out if empty" * (not line.operation.flag)


def _write(line: _Line) -> str:
    return _tag(line) + ", also if 0 or empty" * bool(line.operation.flag)


def _signs(line: _Line) -> str:
    """Which integers are unsigned."""
    named = [_word(sign).removesuffix(" unsigned") for sign in Sign if line.operation.flag & sign]
    return f"unsigned: {', '.join(named)}" if named else ""


_OPERANDS: Mapping[Op, Callable[[_Line], str]] = {
    Op.INTEGER: _number,
    Op.REAL: _number,
    Op.TEXT: _text,
    Op.STATE: _of_slot,
    Op.LOAD: _of_slot,
    Op.KEEP: _of_slot,
    Op.JUMP: _jump,
    Op.UNLESS: _jump,
    Op.AND: _jump,
    Op.OR: _jump,
    Op.COMPARE: _compare,
    Op.DIGITS: lambda line: plural(line.index, "decimal"),
    Op.FIT_SIZE: lambda line: f"at most {_number(line)} bytes",
    Op.FIT_COUNT: lambda line: f"{'at most ' * bool(line.operation.flag)}{_number(line)} elements",
    Op.OCTETS: _of_stored,
    Op.MEMBER: _member,
    Op.ELEMENT: _element,
    Op.ENTER: lambda line: f"section {line.index}, {line.layout.messages[line.index]}",
    Op.REPEAT: _repeat,
    Op.NEXT: _of_slot,
    Op.LIST: lambda line: f"of {line.operation.size}",
    Op.UNPACK: _of_stored,
    Op.APPEND: _of_slot,
    Op.KNOWN: _known,
    Op.PUT: lambda line: plural(line.index, "byte"),
    Op.OPEN: _open,
    Op.WRITE_VARINT: _write,
    Op.WRITE_ZIGZAG: _write,
    Op.WRITE_FIXED32: _write,
    Op.WRITE_FIXED64: _write,
    Op.WRITE_FLOAT: _write,
    Op.WRITE_DOUBLE: _write,
    Op.WRITE_BYTES: _write,
}
"""Functions that show the operands of an operation. For other operations, unsigned integers are named."""


def _slot(slot: int, layout: Layout) -> str:
    return f"slot {slot}  {layout.names[slot]}".rstrip()


def _stored(scalar: Scalar) -> str:
    return "in cells" if scalar is Scalar.IN_CELLS else f"{_word(scalar)} in a row"


def _word(member: Enum) -> str:
    return member.name.lower()
