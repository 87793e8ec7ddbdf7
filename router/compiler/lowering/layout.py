"""Layouts: which fields of a message are read, and into which slots. Only those that programs use are read.

Expressions ask a Node for fields of the message at one place. Then `protobuf_layout` or `cdr_layout` numbers all slots
and nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import auto
from itertools import chain
from typing import NamedTuple, Union

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.compiler.lowering.offsets import HIGHEST, Offset
from router.compiler.lowering.operations import MOST_LOOPS, NONE, Counted, Scalar, Slot
from router.types.descriptors import enum_of, message_of
from router.types.model import Bool, Bytes, Float, Int, List, MessageType, String, Type
from router.types.model import Field as Member

MOST_NODES_DEEP = 32
"""As in `native/read_protobuf.h`: messages in messages, of which the envelope is one."""


# ---- what is wanted


@dataclass(slots=True)
class Wanted:
    """A field of which something is wanted: its value or list, whether it is there, or fields of the message in it.

    The value of a message of ROS is a list of one element, the message.
    """

    member: Member
    value: Slot | None = None
    presence: Slot | None = None
    node: Node | None = None


@dataclass(eq=False, slots=True)
class Node:
    """A message at one place: the source message, a message in it, or an element of a list.

    `descriptor` is None for a ROS message. `path` is what stands in front of the names of its fields: `motors[].`.
    """

    type: MessageType
    descriptor: Descriptor | None
    path: str = ""
    wanted: dict[str, Wanted] = field(default_factory=dict)
    index: int = -1

    @property
    def is_cdr(self) -> bool:
        return self.descriptor is None

    def _field(self, member: Member) -> Wanted:
        return self.wanted.setdefault(member.name, Wanted(member))

    def declared(self, member: Member) -> FieldDescriptor:
        """The field of a protobuf message."""
        assert self.descriptor is not None  # noqa: S101 - said by the caller
        return self.descriptor.fields_by_name[member.name]

    def inner(self, member: Member) -> Node:
        """A new node for the message in a field, or for the elements of a list."""
        is_list = isinstance(member.type, List)
        declared = member.type.element if isinstance(member.type, List) else member.type
        assert isinstance(declared, MessageType)  # noqa: S101 - said by the caller
        descriptor = None if self.is_cdr else message_of(self.declared(member))
        return Node(declared, descriptor, f"{self.path}{member.name}{'[]' * is_list}.")

    def message(self, member: Member) -> Node:
        """The message in a field that is no list."""
        wanted = self._field(member)
        if wanted.node is None:
            wanted.node = self.inner(member)
        return wanted.node

    def value(self, member: Member) -> Slot:
        """A scalar, text or bytes, or a list."""
        wanted = self._field(member)
        if wanted.value is None:
            wanted.value = Slot(self._default(member), self.path + member.name)
        return wanted.value

    def presence(self, member: Member) -> Slot:
        wanted = self._field(member)
        if wanted.presence is None:
            wanted.presence = Slot(0, f"has({self.path}{member.name})")
        return wanted.presence

    def stored(self, member: Member) -> Scalar:
        """How a list is stored."""
        if isinstance(member.type, Bytes):
            return Scalar.UINT8
        assert isinstance(member.type, List)  # noqa: S101 - said by the caller
        is_scalar = not isinstance(member.type.element, (MessageType, String))
        return scalar_of(member.type.element) if self.is_cdr and is_scalar else Scalar.IN_CELLS

    def is_unchecked(self, member: Member) -> bool:
        """Whether a text may be something else than UTF-8."""
        return self.is_cdr or member.is_unchecked

    def depth(self) -> int:
        return 1 + max((each.node.depth() for each in self.wanted.values() if each.node), default=0)

    def _default(self, member: Member) -> int | float | bytes | None:
        if isinstance(member.type, (List, MessageType)):
            return None
        if self.is_cdr:
            return b"" if isinstance(member.type, String) else 0.0 if isinstance(member.type, Float) else 0
        value: int | float | bytes | str = self.declared(member).default_value
        return value.encode() if isinstance(value, str) else value


_INTEGERS = {
    (8, True): Scalar.INT8, (8, False): Scalar.UINT8, (16, True): Scalar.INT16, (16, False): Scalar.UINT16,
    (32, True): Scalar.INT32, (32, False): Scalar.UINT32, (64, True): Scalar.INT64, (64, False): Scalar.UINT64,
}  # fmt: skip


def scalar_of(declared: Type) -> Scalar:
    """A primitive type of ROS other than a string."""
    match declared:
        case Bool():
            return Scalar.BOOL
        case Int(bits, signed):
            return _INTEGERS[bits, signed]
        case Float(bits):
            return Scalar.FLOAT32 if bits == 32 else Scalar.FLOAT64
        case _:
            raise AssertionError(f"{declared} is no scalar of a ROS message")


def size_of(declared: Type) -> int:
    """Bytes of a primitive type of ROS other than a string, which are its alignment as well."""
    return 1 if isinstance(declared, Bool) else declared.bits // 8  # type: ignore[union-attr]  # an Int or a Float


# ---- layouts


class FieldType(Counted):
    """`enum field_type`."""

    BOOL = auto()
    INT32 = auto()
    INT64 = auto()
    UINT32 = auto()
    SINT32 = auto()
    SINT64 = auto()
    FIXED32 = auto()
    SFIXED32 = auto()
    FIXED64 = auto()
    FLOAT = auto()
    DOUBLE = auto()
    BYTES = auto()
    MESSAGE = auto()
    GROUP = auto()
    CLOSED_ENUM = auto()


_FIELD_TYPES = {
    FieldDescriptor.TYPE_BOOL: FieldType.BOOL,
    FieldDescriptor.TYPE_ENUM: FieldType.INT32,
    FieldDescriptor.TYPE_INT32: FieldType.INT32,
    FieldDescriptor.TYPE_INT64: FieldType.INT64,
    FieldDescriptor.TYPE_UINT32: FieldType.UINT32,
    FieldDescriptor.TYPE_UINT64: FieldType.INT64,
    FieldDescriptor.TYPE_SINT32: FieldType.SINT32,
    FieldDescriptor.TYPE_SINT64: FieldType.SINT64,
    FieldDescriptor.TYPE_FIXED32: FieldType.FIXED32,
    FieldDescriptor.TYPE_SFIXED32: FieldType.SFIXED32,
    FieldDescriptor.TYPE_FIXED64: FieldType.FIXED64,
    FieldDescriptor.TYPE_SFIXED64: FieldType.FIXED64,
    FieldDescriptor.TYPE_FLOAT: FieldType.FLOAT,
    FieldDescriptor.TYPE_DOUBLE: FieldType.DOUBLE,
    FieldDescriptor.TYPE_STRING: FieldType.BYTES,
    FieldDescriptor.TYPE_BYTES: FieldType.BYTES,
    FieldDescriptor.TYPE_MESSAGE: FieldType.MESSAGE,
    FieldDescriptor.TYPE_GROUP: FieldType.GROUP,
}


class NodeField(NamedTuple):
    """`struct node_field`; NONE where there is no such slot, node or enum."""

    number: int
    type: FieldType
    is_repeated: bool
    slot: int
    presence: int
    node: int
    choice: int = NONE
    cleared: int = 0
    cleared_count: int = 0
    closed: int = NONE


class ReadKind(Counted):
    """`enum read_kind`."""

    SCALAR = auto()
    SKIP = auto()
    ARRAY = auto()
    SEQUENCE = auto()
    TEXT = auto()
    EACH = auto()
    EACH_SEQUENCE = auto()
    AGAIN = auto()
    TEXTS = auto()


class ReadOperation(NamedTuple):
    """`struct read_operation`."""

    kind: ReadKind
    size: int = 0
    type: Scalar = Scalar.BOOL
    slot: int = NONE
    elements: int = 0


class PlacedNode(NamedTuple):
    """`struct node`: fields of a protobuf message, or the steps through a ROS message."""

    entries: tuple[Union[NodeField, ReadOperation], ...]
    first_slot: int
    slot_count: int


@dataclass(frozen=True, slots=True)
class Layout:
    """`struct layout`. The first node is the source message; of a datagram, the second one is the envelope around it.

    `closed` are the numbers of closed enums, ascending. `names` say what each slot holds, `messages` what each node
    is: for `explain`.
    """

    is_cdr: bool
    nodes: tuple[PlacedNode, ...]
    defaults: tuple[int | float | bytes | None, ...]
    names: tuple[str, ...]
    messages: tuple[str, ...]
    closed: tuple[tuple[int, ...], ...] = ()


class _Layout:
    """Numbers slots. Those of a node stand together."""

    def __init__(self, slots: Sequence[Slot]) -> None:
        self.defaults: list[int | float | bytes | None] = []
        self.names: list[str] = []
        self.nodes: list[PlacedNode] = []
        self.messages: list[str] = []
        for slot in slots:
            self.number(slot)

    def number(self, slot: Slot) -> int:
        slot.index = len(self.defaults)
        self.defaults.append(slot.default)
        self.names.append(slot.name)
        return slot.index

    def number_nodes(self, nodes: Sequence[Node]) -> None:
        for index, node in enumerate(nodes):
            node.index = index
        self.nodes = [PlacedNode((), 0, 0)] * len(nodes)
        self.messages = [node.type.name for node in nodes]

    def made(self, *, is_cdr: bool, closed: Iterable[tuple[int, ...]] = ()) -> Layout:
        nodes, defaults, names, messages = self.nodes, self.defaults, self.names, self.messages
        return Layout(is_cdr, tuple(nodes), tuple(defaults), tuple(names), tuple(messages), tuple(closed))


# ---- datagrams


def protobuf_layout(
    slots: Sequence[Slot], payload: Node, envelope: Descriptor, case: str, elements: Sequence[Node]
) -> Layout:
    """Number `slots`, from 0, then those of the payload in its envelope, and those of elements of lists."""
    maker = _ProtobufLayout(slots)
    around = Node(MessageType(envelope.full_name), envelope)
    around.wanted[case] = Wanted(Member(case, payload.type), node=payload)
    maker.number_nodes([payload, around, *_inner(payload), *chain.from_iterable(map(_all, elements))])
    for root in (around, *elements):
        maker.place(root)
    return maker.made(is_cdr=False, closed=maker.closed.values())


def _all(node: Node) -> Iterator[Node]:
    yield node
    yield from _inner(node)


def _inner(node: Node) -> Iterator[Node]:
    for wanted in node.wanted.values():
        if wanted.node is not None:
            yield from _all(wanted.node)


class _ProtobufLayout(_Layout):
    """Slots of a oneof's members stand behind the number of the member that is there."""

    def __init__(self, slots: Sequence[Slot]) -> None:
        super().__init__(slots)
        self.closed: dict[str, tuple[int, ...]] = {}

    def place(self, node: Node) -> None:
        first = len(self.defaults)
        declared = {name: node.declared(wanted.member) for name, wanted in node.wanted.items()}
        alone = [name for name, each in declared.items() if each.containing_oneof is None]
        fields = [self._field(declared[name], node.wanted[name]) for name in alone]
        oneofs = {each.containing_oneof for each in declared.values() if each.containing_oneof is not None}
        for oneof in sorted(oneofs, key=lambda each: each.index):
            choice, begin = self.number(Slot(0, f"member of {node.path}{oneof.name}")), len(self.defaults)
            members = [self._field(member, node.wanted.get(member.name)) for member in oneof.fields]
            count = len(self.defaults) - begin
            fields += [each._replace(choice=choice, cleared=begin, cleared_count=count) for each in members]
        fields.sort(key=lambda each: each.number)
        self.nodes[node.index] = PlacedNode(tuple(fields), first, len(self.defaults) - first)

    def _field(self, declared: FieldDescriptor, wanted: Wanted | None) -> NodeField:
        slots = (wanted.value, wanted.presence) if wanted is not None else (None, None)
        slot, presence = (self.number(each) if each is not None else NONE for each in slots)
        node = wanted.node if wanted is not None else None
        if node is not None:
            self.place(node)
        closed = self._closed(declared)
        return NodeField(
            declared.number,
            _FIELD_TYPES[declared.type] if closed == NONE else FieldType.CLOSED_ENUM,
            declared.is_repeated,
            slot,
            presence,
            node.index if node is not None else NONE,
            closed=closed,
        )

    def _closed(self, declared: FieldDescriptor) -> int:
        if declared.enum_type is None or not enum_of(declared).is_closed:
            return NONE
        enum = enum_of(declared)
        self.closed.setdefault(enum.full_name, tuple(sorted({value.number for value in enum.values})))
        return list(self.closed).index(enum.full_name)


# ---- messages from ROS


class TooManyListsError(Exception):
    """A ROS message has more lists of messages within each other than are gone through."""


def cdr_layout(slots: Sequence[Slot], message: Node, elements: Sequence[Node]) -> Layout:
    """Number `slots`, from 0, then those of the message, and those of elements of lists. Raises TooManyListsError."""
    maker = _Layout(slots)
    maker.number_nodes([message, *elements])
    for index, root in enumerate((message, *elements)):
        first = len(maker.defaults)
        steps = _Steps(maker, Offset(HIGHEST) if root is message else Offset())
        steps.message(root.type, root)
        maker.nodes[index] = PlacedNode(steps.up_to_the_last_wanted(), first, len(maker.defaults) - first)
    return maker.made(is_cdr=True)


_MOST_UNROLLED = 64
"""Elements of an array of messages that are skipped without a loop."""


class _Steps:
    """Collects the steps through a message. What is skipped becomes one stretch of bytes where its padding is known."""

    def __init__(self, layout: _Layout, offset: Offset, loops: int = 0) -> None:
        self.layout = layout
        self.made: list[ReadOperation] = []
        self.offset = offset
        self.loops = loops
        self._skipped: tuple[int, int] | None = None  # an alignment, and so many bytes
        self._wanted = 0  # steps up to the last wanted one

    def up_to_the_last_wanted(self) -> tuple[ReadOperation, ...]:
        return tuple(self.made[: self._wanted])

    def message(self, declared: MessageType, node: Node | None) -> None:
        for member in declared.fields:
            wanted = node.wanted.get(member.name) if node is not None else None
            self._field(member.type, wanted)
        if not declared.fields:
            self._scalars(1, 1)  # rosidl gives it a byte

    def _field(self, declared: Type, wanted: Wanted | None) -> None:
        slot = wanted.value if wanted is not None else None
        match declared:
            case MessageType():
                self._inner(declared, wanted.node if wanted is not None else None, slot)
            case List():
                self._list(declared, slot)
            case String(wide=wide):
                if slot is not None:
                    self._add(ReadOperation(ReadKind.TEXT), slot)
                else:
                    self._add(ReadOperation(ReadKind.SEQUENCE, 4 if wide else 1), None)
                self.offset.lose(4 if wide else 1)
            case _ if slot is not None:
                self._flush()
                self._add(ReadOperation(ReadKind.SCALAR, type=scalar_of(declared)), slot)
                self.offset.advance(size_of(declared), size_of(declared))
            case _:
                self._scalars(size_of(declared), 1)

    def _inner(self, declared: MessageType, node: Node | None, slot: Slot | None) -> None:
        """A message in the message. If the whole of it is wanted, it is the only element of a list."""
        if slot is None:
            self.message(declared, node)
            return
        if node is not None and node.wanted:
            self._loop(ReadOperation(ReadKind.EACH, elements=1), slot, lambda steps: steps.message(declared, node))
        else:
            self._loop(ReadOperation(ReadKind.EACH, elements=1), slot, lambda steps: steps.message(declared, None))

    def _list(self, declared: List, slot: Slot | None) -> None:
        element, length = declared.element, declared.length
        if isinstance(element, (MessageType, String)):
            self._elements(element, length, slot)
            return
        size = size_of(element)
        if length is None:
            self._flush()
            self._add(ReadOperation(ReadKind.SEQUENCE, size, scalar_of(element)), slot)
            self.offset.lose(min(size, 4))  # none may be there, behind their number
        elif slot is None:
            self._scalars(size, length)
        else:
            self._flush()
            self._add(ReadOperation(ReadKind.ARRAY, size, scalar_of(element), elements=length), slot)
            self.offset.advance(size, size * length)

    def _elements(self, element: MessageType | String, length: int | None, slot: Slot | None) -> None:
        if slot is None and length is not None and length <= _MOST_UNROLLED:
            for _ in range(length):
                self._field(element, None)
            return
        each = ReadOperation(ReadKind.EACH_SEQUENCE if length is None else ReadKind.EACH, elements=length or 0)
        if slot is not None and isinstance(element, String):
            texts = ReadOperation(ReadKind.TEXTS, slot=self.layout.number(slot))
            self._loop(each, None, lambda steps: steps.made.append(texts))
            self._wanted = len(self.made)
        else:
            self._loop(each, slot, lambda steps: steps._field(element, None))

    def _loop(self, each: ReadOperation, slot: Slot | None, body: Callable[[_Steps], None]) -> None:
        if self.loops == MOST_LOOPS:
            message = f"a message of this type has more than {MOST_LOOPS} lists of messages within each other"
            raise TooManyListsError(message)
        self._add(each, slot)
        inside = _Steps(self.layout, Offset(), self.loops + 1)
        body(inside)
        inside._flush()
        self.made += inside.made
        self.made.append(ReadOperation(ReadKind.AGAIN))
        if slot is not None or inside._wanted:
            self._wanted = len(self.made)
        self.offset.lose()

    def _add(self, step: ReadOperation, slot: Slot | None) -> None:
        self._flush()
        self.made.append(step if slot is None else step._replace(slot=self.layout.number(slot)))
        if slot is not None:
            self._wanted = len(self.made)

    def _scalars(self, size: int, count: int) -> None:
        """Skip scalars: with what is skipped in front of them, if it is known how far they are from there."""
        if not count:
            return
        padding = self.offset.padding(size)
        if padding is None:
            self._flush()
            self._skipped = size, size * count
        else:
            alignment, skipped = self._skipped or (1, 0)
            self._skipped = alignment, skipped + padding + size * count
        self.offset.advance(size, size * count)

    def _flush(self) -> None:
        if self._skipped is None:
            return
        alignment, size = self._skipped
        self._skipped = None
        self.made.append(ReadOperation(ReadKind.SKIP, alignment, elements=size // alignment))
        if size % alignment:
            self.made.append(ReadOperation(ReadKind.SKIP, 1, elements=size % alignment))
