"""What the carrier executes to publish on a topic: operations on slots, and the fields that are read into these.

`native/compose.h` says what each operation does, `native/fields.h` how fields are read. Slots and nodes are objects
until `layout` numbers them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import chain
from typing import NamedTuple, Union

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.types.descriptors import message_of

MOST_STACKED, MOST_LOOPS, MOST_TEXT = 255, 8, 1 << 20
"""As in `native/compose.h`."""

MOST_NODES_DEEP = 32
"""As in `native/fields.h`."""

MAX_DATAGRAM = 16 * 1024
"""As in `native/envelope.h`: no field is longer."""

MOST_SLOTS = 0xFFFE


class Op(IntEnum):
    """`enum operation_kind`, in the same order."""

    INTEGER = 0
    REAL = 1
    TEXT = 2
    LOAD = 3
    KEEP = 4
    DROP = 5
    ADD = 6
    SUBTRACT = 7
    MULTIPLY = 8
    DIVIDE = 9
    MODULO = 10
    NEGATE = 11
    ABSOLUTE = 12
    LEAST = 13
    GREATEST = 14
    CLAMP = 15
    FIT = 16
    WRAP = 17
    TIME = 18
    REAL_ADD = 19
    REAL_SUBTRACT = 20
    REAL_MULTIPLY = 21
    REAL_DIVIDE = 22
    REAL_FLOOR_DIVIDE = 23
    REAL_MODULO = 24
    REAL_REMAINDER = 25
    REAL_POWER = 26
    REAL_NEGATE = 27
    REAL_ABSOLUTE = 28
    REAL_LEAST = 29
    REAL_GREATEST = 30
    REAL_CLAMP = 31
    ROUND = 32
    TRUNCATE = 33
    FLOOR = 34
    CEIL = 35
    SQRT = 36
    SIN = 37
    COS = 38
    TAN = 39
    ATAN2 = 40
    HYPOT = 41
    FLOAT32 = 42
    INTEGER_TO_REAL = 43
    REAL_CLAMP_TO_INTEGER = 44
    REAL_FIT_TO_INTEGER = 45
    SECONDS = 46
    COMPARE = 47
    NOT = 48
    JUMP = 49
    UNLESS = 50
    AND = 51
    OR = 52
    EITHER = 53
    JOIN = 54
    DECIMAL = 55
    CHARACTERS = 56
    SIZE = 57
    FIT_SIZE = 58
    UTF8 = 59
    COUNT = 60
    WANT_COUNT = 61
    ELEMENT = 62
    ENTER = 63
    EACH = 64
    EACH_BYTE = 65
    AGAIN = 66
    KNOWN = 67
    PUT = 68
    PUT_FLOAT = 69
    PUT_DOUBLE = 70
    PUT_TEXT = 71
    PUT_BYTES = 72


class Relation(IntEnum):
    """`enum relation`."""

    EQUAL = 0
    UNEQUAL = 1
    LESS = 2
    LESS_OR_EQUAL = 3
    MORE = 4
    MORE_OR_EQUAL = 5


class Compared(IntEnum):
    """`enum compared`."""

    SIGNED_INTEGERS = 0
    UNSIGNED_INTEGERS = 1
    REALS = 2
    TEXTS = 3


_PUSHES = frozenset({Op.INTEGER, Op.REAL, Op.TEXT, Op.LOAD, Op.COUNT, Op.ELEMENT, Op.EACH, Op.EACH_BYTE})
_TAKES_TWO = frozenset({Op.CLAMP, Op.FIT, Op.WRAP, Op.REAL_CLAMP, Op.REAL_CLAMP_TO_INTEGER, Op.REAL_FIT_TO_INTEGER,
                        Op.WANT_COUNT})  # fmt: skip
_TAKES_ONE = frozenset({
    Op.DROP, Op.ADD, Op.SUBTRACT, Op.MULTIPLY, Op.DIVIDE, Op.MODULO, Op.LEAST, Op.GREATEST, Op.REAL_ADD,
    Op.REAL_SUBTRACT, Op.REAL_MULTIPLY, Op.REAL_DIVIDE, Op.REAL_FLOOR_DIVIDE, Op.REAL_MODULO, Op.REAL_REMAINDER,
    Op.REAL_POWER, Op.REAL_LEAST, Op.REAL_GREATEST, Op.ATAN2, Op.HYPOT, Op.COMPARE, Op.UNLESS, Op.AND, Op.OR, Op.EITHER,
    Op.JOIN, Op.ENTER, Op.PUT, Op.PUT_FLOAT, Op.PUT_DOUBLE, Op.PUT_TEXT, Op.PUT_BYTES,
})  # fmt: skip


@dataclass(eq=False, slots=True)
class Slot:
    """A place for a value. `default` is what it holds where nothing was read: for a list, None."""

    default: int | float | bytes | None = None
    index: int = -1


class Operation(NamedTuple):
    """`struct operation`; `slot` may be an object that has an index, `data` are the bytes of a literal."""

    kind: Op
    slot: Union[int, Slot, Node] = 0
    flag: int = 0
    size: int = 0
    number: int | float = 0
    data: bytes = b""


Code = tuple[Operation, ...]


def deepest(code: Iterable[Operation]) -> int:
    """How many values are stacked at most, or somewhat more: branches count as if they came one after another."""
    depth = most = 0
    for operation in code:
        kind = operation.kind
        depth += (kind in _PUSHES) - (kind in _TAKES_ONE) - 2 * (kind in _TAKES_TWO)
        most = max(most, depth)
    return most


# ---- fields that are read


class FieldType(IntEnum):
    """`enum field_type`."""

    BOOL = 0
    INT32 = 1
    INT64 = 2
    UINT32 = 3
    SINT32 = 4
    SINT64 = 5
    FIXED32 = 6
    SFIXED32 = 7
    FIXED64 = 8
    FLOAT = 9
    DOUBLE = 10
    BYTES = 11
    MESSAGE = 12
    GROUP = 13


FIELD_TYPES = {
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


@dataclass(slots=True)
class Wanted:
    """A field of which something is wanted: its value or list, whether it is there, or fields of the message in it."""

    field: FieldDescriptor
    value: Slot | None = None
    presence: Slot | None = None
    node: Node | None = None


@dataclass(eq=False, slots=True)
class Node:
    """A message at one place: the payload, a message in it, or the elements of a list, which are read one by one."""

    descriptor: Descriptor
    wanted: dict[str, Wanted] = field(default_factory=dict)
    index: int = -1

    def field(self, name: str) -> Wanted:
        return self.wanted.setdefault(name, Wanted(self.descriptor.fields_by_name[name]))

    def message(self, name: str) -> Node:
        """The message in a field that is not repeated."""
        wanted = self.field(name)
        if wanted.node is None:
            wanted.node = Node(message_of(wanted.field))
        return wanted.node

    def value(self, name: str) -> Slot:
        """A scalar, text or bytes, or the list of a repeated field."""
        wanted = self.field(name)
        if wanted.value is None:
            wanted.value = Slot(None if wanted.field.is_repeated else _default(wanted.field))
        return wanted.value

    def presence(self, name: str) -> Slot:
        wanted = self.field(name)
        if wanted.presence is None:
            wanted.presence = Slot(0)
        return wanted.presence

    def depth(self) -> int:
        return 1 + max((each.node.depth() for each in self.wanted.values() if each.node), default=0)


def _default(declared: FieldDescriptor) -> int | float | bytes:
    value = declared.default_value
    return value.encode() if isinstance(value, str) else value


class NodeField(NamedTuple):
    """`struct node_field`; NONE where there is no such slot or node."""

    number: int
    type: FieldType
    is_repeated: bool
    slot: int
    presence: int
    node: int
    choice: int
    cleared: int
    cleared_count: int


NONE = 0xFFFF


class NodeFields(NamedTuple):
    """`struct node`."""

    fields: tuple[NodeField, ...]
    first_slot: int
    slot_count: int


@dataclass(slots=True)
class Layout:
    """The numbers of slots and nodes. The first node is the payload, the second one the envelope that it is in."""

    defaults: list[int | float | bytes | None]
    nodes: list[NodeFields]


def layout(slots: Sequence[Slot], payload: Node, envelope: Descriptor, case: str, elements: Sequence[Node]) -> Layout:
    """Number `slots`, from 0, then those of the nodes."""
    maker = _Layout()
    for slot in slots:
        maker.number(slot)
    around = Node(envelope, {case: Wanted(envelope.fields_by_name[case], node=payload)})
    roots = [around, *elements]
    inside = chain(_inner(payload), *map(_all, elements))
    for index, node in enumerate([payload, around, *inside]):
        node.index = index
        maker.made.nodes.append(NodeFields((), 0, 0))
    for root in roots:
        maker.place(root)
    return maker.made


def _all(node: Node) -> Iterator[Node]:
    yield node
    yield from _inner(node)


def _inner(node: Node) -> Iterator[Node]:
    for wanted in node.wanted.values():
        if wanted.node is not None:
            yield from _all(wanted.node)


class _Layout:
    """Slots of a node stand together, those of a oneof's members behind the number of the member that is there."""

    def __init__(self) -> None:
        self.made = Layout([], [])

    def number(self, slot: Slot) -> int:
        slot.index = len(self.made.defaults)
        self.made.defaults.append(slot.default)
        return slot.index

    def place(self, node: Node) -> None:
        first = len(self.made.defaults)
        alone = [wanted for wanted in node.wanted.values() if wanted.field.containing_oneof is None]
        fields = [self._field(wanted) for wanted in alone]
        oneofs = {wanted.field.containing_oneof for wanted in node.wanted.values() if wanted.field.containing_oneof}
        for oneof in sorted(oneofs, key=lambda each: each.index):
            choice, begin = self.number(Slot(0)), len(self.made.defaults)
            members = [self._field(node.wanted.get(member.name) or Wanted(member)) for member in oneof.fields]
            count = len(self.made.defaults) - begin
            fields += [each._replace(choice=choice, cleared=begin, cleared_count=count) for each in members]
        fields.sort(key=lambda each: each.number)
        self.made.nodes[node.index] = NodeFields(tuple(fields), first, len(self.made.defaults) - first)

    def _field(self, wanted: Wanted) -> NodeField:
        slot, presence = (self.number(each) if each else NONE for each in (wanted.value, wanted.presence))
        if wanted.node is not None:
            self.place(wanted.node)
        return NodeField(
            wanted.field.number,
            FIELD_TYPES[wanted.field.type],
            wanted.field.is_repeated,
            slot,
            presence,
            wanted.node.index if wanted.node is not None else NONE,
            NONE,
            0,
            0,
        )
