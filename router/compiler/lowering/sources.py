"""The programs that read one message: its slots and nodes, which they share, and how large they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from google.protobuf.descriptor import Descriptor

from router.compiler.checked import CheckedCollect
from router.compiler.expressions.tree import COUNT, INDEX, ITEM, ITEMS, MESSAGE, RECEIVED_AT, SOURCE, Read
from router.compiler.expressions.tree import Node as Tree
from router.compiler.lowering import lists
from router.compiler.lowering.cdr import cdr_message
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.layout import Layout, protobuf_layout
from router.compiler.lowering.messages import Placed
from router.compiler.lowering.names import Meaning, Names, TooLargeError
from router.compiler.lowering.nodes import Node
from router.compiler.lowering.operations import Code, Operation, Slot, chained, depths, most_executed, nesting
from router.compiler.lowering.protobuf import protobuf_message
from router.compiler.lowering.steps import TooManyListsError, cdr_layout
from router.compiler.plan import Record
from router.declared import MAX_DATAGRAM, MOST_LOOPS, MOST_NODES_DEEP, MOST_OPEN, MOST_STACKED, NONE, Op, Scalar
from router.errors import SourceSpan
from router.types.model import MessageType
from router.types.protobuf import Envelope, PayloadCase

MOST_CONDITION_OPERATIONS = 1 << 18
"""Operations that a destination's `when` may execute for a datagram, about a millisecond of the receive thread."""

_MOST_SLOTS = NONE


class Condition(NamedTuple):
    """`when` as operations, and where the table says so; both empty where there is none."""

    code: Code
    place: str


class Message(NamedTuple):
    """The operations that write a message, and the place of each."""

    code: Code
    places: tuple[str, ...]


@dataclass
class _Source:
    """A message that programs read into `root`. `topic` is where it comes from, empty if it is from UDP."""

    root: Node
    topic: str = ""
    temporaries: list[Slot] = field(default_factory=list)
    elements: list[Node] = field(default_factory=list)
    variables: dict[str, Meaning] = field(default_factory=dict)

    def __post_init__(self) -> None:
        given = Slot(0, RECEIVED_AT), Slot(self.topic.encode(), SOURCE)
        self.temporaries += given
        self.variables |= {MESSAGE: self.root, RECEIVED_AT: given[0], SOURCE: given[1]}

    def lowering(self) -> Lowering:
        """Return the lowering of one target, which can have variables of its own."""
        return Lowering(Names(dict(self.variables), self.temporaries, self.elements))

    def condition(
        self, lowering: Lowering, conditions: Sequence[Tree | None], *, is_bounded: bool = False
    ) -> Condition:
        """Lower the conjunction of conditions. One that the receive thread evaluates `is_bounded`."""
        given = [each for each in conditions if each is not None]
        if not given:
            return Condition((), "")
        code = chained(Op.AND, [lowering.value(each) for each in given])
        _want_small([(operation, given[-1].span) for operation in code])
        if is_bounded and (most := most_executed(code)) > MOST_CONDITION_OPERATIONS:
            limit = f"and a destination's `when` takes at most {MOST_CONDITION_OPERATIONS:,}"
            message = f"this could take {most:,} operations on the longest datagram, {limit}"
            hint = f"a list counts with {MAX_DATAGRAM:,} elements: look into fewer lists, or fewer times"
            raise TooLargeError(given[-1].span, message, hint)
        return Condition(code, ", or ".join(f"{each.span}: when" for each in given))


class Datagram(_Source):
    """A payload in its envelope, from UDP."""

    def __init__(self, case: PayloadCase, envelope: Envelope) -> None:
        descriptor: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # of upb
        around: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]
        super().__init__(Node(case.type, descriptor))
        self._case, self._envelope = case.name, around

    def collect(self, checked: CheckedCollect) -> Collected:
        """Lower what makes frames of datagrams. Expressions can use `items` and `count` from now on."""
        by, count, order = map(self._number, (checked.by, checked.count, checked.order))
        items, counted = Slot(None, ITEMS), Slot(0, COUNT)
        self.temporaries += items, counted
        self.variables |= {ITEMS: items, COUNT: counted}
        return Collected(by, count, order, items, counted)

    def _number(self, node: Tree) -> Code:
        code = self.lowering().value(node)
        _want_small([(operation, node.span) for operation in code])
        return code

    def published(self, lowering: Lowering, plan: Record) -> Message:
        """Lower the ROS message of a topic."""
        return _message(cdr_message(lowering, plan))

    def layout(self, span: SourceSpan) -> Layout:
        """Return the layout of all programs that have been made. Raises TooLargeError."""
        for node in (self.root, *self.elements):
            if (depth := node.depth()) >= MOST_NODES_DEEP:
                message = f"this reads a field {depth} messages deep, and at most {MOST_NODES_DEEP - 1} are possible"
                raise TooLargeError(span, message, "read fields that are less deep")
        made = protobuf_layout(self.temporaries, self.root, self._envelope, self._case, self.elements)
        _want_room(made, span)
        return made


class RosMessage(_Source):
    """A message from a topic of ROS."""

    def __init__(self, declared: MessageType, topic: str) -> None:
        super().__init__(Node(declared, None), topic)

    def sent(self, lowering: Lowering, plan: Record, case: PayloadCase) -> Message:
        """Lower the envelope for a destination."""
        return _message(protobuf_message(lowering, plan, case))

    def stamp(self, node: Tree) -> tuple[Slot, Slot]:
        """Return the slots of the seconds and nanoseconds of a field with a time."""
        assert isinstance(node, Read)  # noqa: S101 - it is a field of the message
        _, moment = self.lowering().message(node)
        seconds, nanoseconds = moment.type.fields
        return moment.value(seconds), moment.value(nanoseconds)

    def for_each(self, node: Tree) -> Elements:
        """Lower the list of `for_each`. Expressions can use `item`, `index` and `count` from now on."""
        lowering = self.lowering()
        of = lists.checked_list(lowering, node)
        _want_small([(operation, node.span) for operation in of.code])
        item: Meaning = Slot(0, ITEM) if of.message is None else lowering.names.element(of.message)
        index, count = Slot(0, INDEX), Slot(0, COUNT)
        if isinstance(item, Node):
            item.path = f"{ITEM}."
        self.temporaries += [each for each in (item, index, count) if isinstance(each, Slot)]
        self.variables |= {ITEM: item, INDEX: index, COUNT: count}
        return Elements(of.code, of.scalar, item, index, count)

    def layout(self, span: SourceSpan) -> Layout:
        """Return the layout of all programs that have been made. Raises TooLargeError."""
        try:
            made = cdr_layout(self.temporaries, self.root, self.elements)
        except TooManyListsError as error:
            raise TooLargeError(span, str(error), "take another type of message") from None
        _want_room(made, span)
        return made


@dataclass(frozen=True)
class Elements:
    """A list that `code` puts on the stack, stored as `scalar` says, and where each element goes."""

    code: Code
    scalar: Scalar
    item: Meaning
    index: Slot
    count: Slot


@dataclass(frozen=True)
class Collected:
    """Programs that name the frame of a datagram, its size and the place in it, and where a complete frame goes."""

    by: Code
    count: Code
    order: Code
    items: Slot
    counted: Slot


def _message(placed: Sequence[Placed]) -> Message:
    _want_small([(operation, place.span) for operation, place in placed])
    return Message(tuple(operation for operation, _ in placed), tuple(str(place) for _, place in placed))


# ---- limits


def _want_small(placed: Sequence[tuple[Operation, SourceSpan]]) -> None:
    """Raise TooLargeError for what nests deeper than a program can."""
    operations = [operation for operation, _ in placed]
    loops, opened = (nesting(operations, *kinds) for kinds in ((Op.REPEAT, Op.AGAIN), (Op.OPEN, Op.CLOSE)))
    limits = (
        (depths(operations), MOST_STACKED - 1, "intermediate values are needed here", "use fewer brackets in brackets"),
        (loops, MOST_LOOPS, "lists are nested here", "fill fewer lists in lists"),
        (opened, MOST_OPEN, "messages are nested here", "fill fewer messages in messages"),
    )
    for counts, most, what, hint in limits:
        for (_, span), count in zip(placed, counts, strict=True):
            if count > most:
                raise TooLargeError(span, f"more than {most} {what}", hint)


def _want_room(layout: Layout, span: SourceSpan) -> None:
    most = max(len(layout.defaults), len(layout.nodes))
    if most > _MOST_SLOTS:
        message = f"these mappings use {most} values, and at most {_MOST_SLOTS} are possible"
        raise TooLargeError(span, message, "make several routes of it, or map less")
