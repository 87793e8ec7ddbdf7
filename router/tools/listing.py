"""What `router explain --code` lists: the fields that the carrier reads of a message, and its operations with their places.

Operations have the names of `native/operations.h`, which says what they do.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from router.compiler.checked import CheckedRoute
from router.compiler.lowering import Lowered, LoweredElements, LoweredTarget
from router.compiler.lowering.layout import Layout, NodeField, ReadKind, ReadOperation
from router.compiler.lowering.operations import NONE, Code, Compared, Op, Operation, Relation, Scalar, Sign
from router.compiler.program import Program
from router.errors import plural

_INDENT = "  "
_MOST_SHOWN = 16
"""Bytes of a literal that are shown."""


def listed_route(checked: CheckedRoute, program: Program) -> Iterator[str]:
    """All code of a route: the programs of the carrier, and handlers of targets that need Python."""
    lowered: Lowered = program.lowered
    name = checked.route.name
    for kind, routes in (("destination", lowered.conditions), ("topic", lowered.topics)):
        if name in routes:
            yield from _layout(routes[name].layout)
            for target in routes[name].targets.values():
                yield from _target(kind, target, routes[name].layout)
    for topic, feeds in lowered.from_ros.items():
        for feed in feeds:
            if feed.route == name:
                yield ""
                yield f"from topic {topic}"
                yield from _layout(feed.layout)
                if feed.for_each is not None:
                    yield from _for_each(feed.for_each, feed.layout, next(iter(feed.targets.values())))
                for target in feed.targets.values():
                    yield from _target("destination", target, feed.layout)


def python_of(checked: CheckedRoute, program: Program) -> Iterator[str]:
    """The functions of the targets that need Python."""
    for handler in program.handlers:
        if handler.route == checked.route.name:
            by_python = [
                target
                for target in handler.targets
                if not program.executors[
                    handler.route,
                    target.label if target.is_topic else handler.topic,
                    None if target.is_topic else target.label,
                ].is_carrier
            ]
            if by_python:
                yield handler.part(by_python).source.text()


# ---- what is read


def _layout(layout: Layout) -> Iterator[str]:
    for number, (node, message) in enumerate(zip(layout.nodes, layout.messages, strict=True)):
        if node.entries:
            yield ""
            yield f"reads {message}, node {number}"
        depth = 1
        for entry in node.entries:
            if isinstance(entry, NodeField):
                yield _INDENT + _field(entry, layout)
                continue
            depth -= entry.kind is ReadKind.AGAIN
            yield _INDENT * depth + _step(entry, layout)
            depth += entry.kind in (ReadKind.EACH, ReadKind.EACH_SEQUENCE)


def _field(entry: NodeField, layout: Layout) -> str:
    """One field of a protobuf message, and where what is read of it goes."""
    repeated = "repeated " * entry.is_repeated
    places = [_slot(each, layout) for each in (entry.slot, entry.presence, entry.choice) if each != NONE]
    if entry.node != NONE:
        places.append(f"node {entry.node}")
    return f"field {entry.number}: {repeated}{_word(entry.type)} -> {', '.join(places) or 'nothing'}"


def _step(step: ReadOperation, layout: Layout) -> str:
    """One step through a ROS message."""
    to = f" -> {_slot(step.slot, layout)}" if step.slot != NONE else ""
    match step.kind:
        case ReadKind.SCALAR:
            return f"{_word(step.type)}{to}"
        case ReadKind.SKIP:
            return f"skip {step.count} of {step.size} bytes"
        case ReadKind.ARRAY:
            return f"{_word(step.type)}[{step.count}]{to}"
        case ReadKind.SEQUENCE if to:
            return f"{_word(step.type)}[]{to}"
        case ReadKind.SEQUENCE:
            return f"skip a sequence of {step.size} bytes each"
        case ReadKind.EACH:
            return f"each of {step.count}{to}"
        case ReadKind.EACH_SEQUENCE:
            return f"each of a sequence{to}"
        case _:
            return f"{_word(step.kind)}{to}"


# ---- operations


def _target(kind: str, target: LoweredTarget, layout: Layout) -> Iterator[str]:
    yield ""
    yield f"{kind} {target.label}"
    _, when, _, *places = target.places
    yield from _listed(target.condition, [when] * len(target.condition), layout)
    yield from _listed(target.message, places, layout)


def _for_each(elements: LoweredElements, layout: Layout, target: LoweredTarget) -> Iterator[str]:
    _, _, place, *_ = target.places
    yield ""
    yield f"elements, {_stored(elements.scalar)}"
    yield from _listed(elements.code, [place] * len(elements.code), layout)
    slots = [_slot(each, layout) for each in (elements.item, elements.index, elements.count) if each != NONE]
    into = [f"node {elements.node}"] * (elements.node != NONE) + slots
    yield f"{_INDENT}each -> {', '.join(into)}" if into else f"{_INDENT}each"


def _listed(code: Code, places: list[str], layout: Layout) -> Iterator[str]:
    """One operation a line, by number; a line for each place where that changes. Loops are indented."""
    depth = 1
    before = ""
    for number, (operation, place) in enumerate(zip(code, places, strict=True)):
        if place != before:
            span, _, field = place.partition(": ")
            yield f"{_INDENT}# {field}  ({span})" if field else f"{_INDENT}# {span}"
            before = place
        depth -= operation.kind is Op.AGAIN
        words = _operands(operation, number, layout)
        yield f"{number:5}  {_INDENT * (depth - 1)}{_word(operation.kind):16}  {words}".rstrip()
        depth += operation.kind is Op.REPEAT


def _operands(operation: Operation, number: int, layout: Layout) -> str:  # noqa: PLR0911 - one case after another
    slot = operation.slot if isinstance(operation.slot, int) else operation.slot.index
    match operation.kind:
        case Op.INTEGER | Op.REAL:
            return repr(operation.number)
        case Op.TEXT:
            return _text(operation.data)
        case Op.KNOWN:
            aligned = f", aligned to {slot}" if slot > 1 else ""
            return _hex(operation.data) + aligned
        case Op.LOAD | Op.KEEP | Op.NEXT | Op.APPEND:
            return _slot(slot, layout)
        case Op.ENTER:
            return f"node {slot}, {layout.messages[slot]}"
        case Op.JUMP | Op.UNLESS | Op.AND | Op.OR:
            return f"to {number + 1 + operation.size}"
        case Op.REPEAT:
            return f"up to {number + operation.size}" + ", keeping what is made" * bool(operation.flag)
        case Op.COMPARE:
            return f"{_RELATIONS[Relation(operation.flag)]}  {_word(Compared(slot))}"
        case Op.ELEMENT:
            return f"[{operation.number}], {_stored(Scalar(operation.flag))}"
        case Op.OCTETS | Op.UNPACK:
            return _stored(Scalar(operation.flag))
        case Op.LIST:
            return f"of {operation.size}"
        case Op.MEMBER:
            return ", ".join(map(str, struct.unpack(f"<{operation.size}i", operation.data)))
        case Op.DIGITS:
            return f"{slot} decimals"
        case Op.FIT_SIZE:
            return f"at most {operation.number} bytes"
        case Op.PUT:
            return plural(slot, "byte")
        case kind if kind >= Op.OPEN:
            return _written(operation)
        case _:
            return _signs(operation.flag)


_RELATIONS = {
    Relation.EQUAL: "==",
    Relation.UNEQUAL: "!=",
    Relation.LESS: "<",
    Relation.LESS_OR_EQUAL: "<=",
    Relation.MORE: ">",
    Relation.MORE_OR_EQUAL: ">=",
}


def _written(operation: Operation) -> str:
    """A field of a protobuf message, or an element that is packed."""
    if operation.kind is Op.CLOSE:
        return ""
    field = f"field {operation.size >> 3}" if operation.size else "no tag"
    if operation.kind is Op.OPEN:
        return field + ", left out if empty" * (not operation.flag)
    return field + ", also if 0 or empty" * bool(operation.flag)


def _signs(flag: int) -> str:
    """Which integers are unsigned."""
    named = [_word(sign) for sign in Sign if flag & sign]
    return f"unsigned: {', '.join(named)}" if named else ""


def _slot(slot: int, layout: Layout) -> str:
    return f"slot {slot}  {layout.names[slot]}".rstrip()


def _stored(scalar: Scalar) -> str:
    return "in cells" if scalar is Scalar.IN_CELLS else f"{_word(scalar)} in a row"


def _word(member: Op | Compared | Scalar | Sign | ReadKind) -> str:
    return str(member.name).lower()


def _text(data: bytes) -> str:
    return repr(data.decode("utf-8", "backslashreplace"))


def _hex(data: bytes) -> str:
    shown = data[:_MOST_SHOWN].hex(" ")
    return f"{shown} ... ({len(data)} bytes)" if len(data) > _MOST_SHOWN else shown
