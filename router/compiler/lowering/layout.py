"""Layouts: into which slots the fields that programs use are read.

A layout numbers slots and nodes. Of a datagram it has the wanted fields of each node, of a ROS message the steps
through it up to the last wanted field (`steps`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple, Union

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from router.compiler.lowering.nodes import Node, Wanted
from router.compiler.lowering.operations import Slot
from router.declared import NONE, FieldType, ReadKind, Scalar
from router.types.descriptors import enum_of
from router.types.model import Field as Member
from router.types.model import MessageType
from router.types.wire import kind_of


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


class Numbering:
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
    maker = _ProtobufNumbering(slots)
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


class _ProtobufNumbering(Numbering):
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
            kind_of(declared).read if closed == NONE else FieldType.CLOSED_ENUM,
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
