"""Lowers the plan of a payload to the operations that write its envelope.

The bytes equal those of the protobuf library: fields by ascending number; fields without presence only if not zero.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.messages import Place, Placed, at, loop, lower_lists, merged
from router.compiler.lowering.numbers import to_real
from router.compiler.lowering.operations import Operation, Routine, known
from router.compiler.plan import Each, Items, Leaf, Plan, Record, Unset
from router.declared import Op
from router.errors import SourceSpan
from router.types.descriptors import container, message_of
from router.types.protobuf import PayloadCase
from router.types.wire import GROUP, GROUP_END, LEN, encoding_of, varint

_CLOSE = Operation(Op.CLOSE)


def protobuf_message(lowering: Lowering, plan: Record, case: PayloadCase, beside: bytes = b"") -> list[Placed]:
    """Return the operations that write an envelope, each with its place: the bytes `beside`, and the payload.

    There is at least one, also for an envelope without bytes: a target without operations forwards datagrams.
    """
    descriptor: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # of upb
    return _around(_Writer(lowering).record(plan, descriptor, ""), case, beside, Place(plan.span, ""))


def rewrapped(case: PayloadCase, beside: bytes, span: SourceSpan) -> list[Placed]:
    """Likewise with the payload of the datagram, as it was received."""
    place = Place(span, "")
    return _around([(Operation(Op.PAYLOAD), place)], case, beside, place)


def _around(inside: Iterable[Placed], case: PayloadCase, beside: bytes, place: Place) -> list[Placed]:
    around = case.wrapping
    if around.tag:
        inside = _lengthened(around.tag, list(merged(inside)), place, is_always=not around.is_optional)
    before, after = (at(place, known(data)) if data else [] for data in (beside + around.before, around.after))
    return list(merged([*before, *inside, *after])) or at(place, known(b""))


def protobuf_fields(lowering: Lowering, plan: Record, descriptor: Descriptor) -> list[Placed]:
    """Return the operations that write the fields of a message, each with its place."""
    return list(merged(_Writer(lowering).record(plan, descriptor, "")))


@dataclass(frozen=True, slots=True)
class _Writer:
    lowering: Lowering

    def record(self, plan: Record, descriptor: Descriptor, path: str) -> Iterator[Placed]:
        for member, inner in sorted(plan.members, key=lambda filled: filled[0].number):
            yield from self._field(inner, descriptor.fields_by_name[member.name], f"{path}.{member.name}".lstrip("."))

    def _field(self, plan: Plan, to: FieldDescriptor, path: str) -> Iterator[Placed]:
        place = Place(plan.span, path)
        match plan:
            case Leaf():
                is_entry = container(to).GetOptions().map_entry
                yield from self._leaf(plan, to, place, is_always=to.has_presence or is_entry)
            case Record():
                yield from self._message(plan, to, place)
            case Items():
                yield from self._items(plan, to, place)
            case Each():
                yield from self._each(plan, to, place)
            case Unset():
                pass

    def _message(self, record: Record, to: FieldDescriptor, place: Place) -> Iterator[Placed]:
        inside = self.record(record, message_of(to), place.field)
        if to.type != FieldDescriptor.TYPE_GROUP:
            yield from _delimited(_tag(to), inside, place)
            return
        yield from at(place, known(varint(to.number << 3 | GROUP)))
        yield from inside
        yield from at(place, known(varint(to.number << 3 | GROUP_END)))

    def _items(self, items: Items, to: FieldDescriptor, place: Place) -> Iterator[Placed]:
        elements = (placed for item in items.items for placed in self._element(item, to, place.field))
        if to.is_packed:
            yield from _packed(to, elements, place)
        else:
            yield from elements

    def _each(self, plan: Each, to: FieldDescriptor, place: Place) -> Iterator[Placed]:
        count, inputs = lower_lists(self.lowering, plan)
        body = loop(self.lowering, inputs, place, lambda: list(merged(self._element(plan.element, to, place.field))))
        elements = [*at(place, count), *body]
        yield from _packed(to, elements, place) if to.is_packed else elements

    def _element(self, plan: Plan, to: FieldDescriptor, path: str) -> Iterable[Placed]:
        """Write an element of a repeated field, even if it is zero."""
        place = Place(plan.span, path)
        if isinstance(plan, Leaf):
            return self._leaf(plan, to, place, is_always=True)
        assert isinstance(plan, Record)  # noqa: S101 - there are no lists in lists
        return self._message(plan, to, place)

    def _leaf(self, leaf: Leaf, to: FieldDescriptor, place: Place, *, is_always: bool) -> list[Placed]:
        tag = 0 if to.is_packed else _tag(to)
        if leaf.constant is not None:
            data = _encoded(leaf.constant, to)
            is_written = is_always or _is_set(leaf.constant, to)
            return at(place, known(varint(tag) * bool(tag) + data)) if is_written else []
        write = encoding_of(to).write
        return at(place, self._value(leaf, write), Operation(write, flag=is_always, size=tag))

    def _value(self, leaf: Leaf, write: Op) -> Routine:
        value = self.lowering.value(leaf.node)
        return to_real(value, leaf.node.kind) if write in (Op.WRITE_FLOAT, Op.WRITE_DOUBLE) else value


def _tag(to: FieldDescriptor) -> int:
    return to.number << 3 | encoding_of(to).wire_type


# ---- known bytes


def _encoded(value: bool | float | str | bytes, to: FieldDescriptor) -> bytes:
    """Encode a constant without its tag."""
    write = encoding_of(to).write
    if write is Op.WRITE_FLOAT:
        return struct.pack("<f", value)
    if write is Op.WRITE_DOUBLE:
        return struct.pack("<d", value)
    if isinstance(value, (str, bytes)):
        data = value.encode() if isinstance(value, str) else value
        return varint(len(data)) + data
    number = int(value)
    if write is Op.WRITE_FIXED32:
        return struct.pack("<i" if number < 0 else "<I", number)
    if write is Op.WRITE_FIXED64:
        return struct.pack("<q" if number < 0 else "<Q", number)
    return varint(number << 1 ^ number >> 63 if write is Op.WRITE_ZIGZAG else number)


def _is_set(value: bool | float | str | bytes, to: FieldDescriptor) -> bool:
    """Return whether a field without presence writes a constant: it is not zero, or it is minus zero."""
    is_real = encoding_of(to).write in (Op.WRITE_FLOAT, Op.WRITE_DOUBLE)
    return any(_encoded(value, to)) if is_real else bool(value)


def _delimited(tag: int, inside: Iterable[Placed], place: Place) -> Iterator[Placed]:
    """Write a message, preceded by its tag and length."""
    yield from _lengthened(tag, list(merged(inside)), place, is_always=True)


def _packed(to: FieldDescriptor, inside: Iterable[Placed], place: Place) -> Iterator[Placed]:
    """Write packed elements, if there are any."""
    yield from _lengthened(to.number << 3 | LEN, list(merged(inside)), place, is_always=False)


def _lengthened(tag: int, inside: list[Placed], place: Place, *, is_always: bool) -> Iterator[Placed]:
    """Prepend tag and length, which are known if all bytes are known."""
    data = b"".join(operation.data for operation, _ in inside)
    if any(operation.kind is not Op.KNOWN for operation, _ in inside):
        yield Operation(Op.OPEN, flag=is_always, size=tag), place
        yield from inside
        yield _CLOSE, place
    elif data or is_always:
        yield known(varint(tag) + varint(len(data)) + data), place
