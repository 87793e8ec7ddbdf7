"""The routines that read one message, their common slots and sections, and their limits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from google.protobuf.descriptor import Descriptor

from router.compiler.checked import CheckedOrder, CheckedRoute, CheckedState, CheckedSubscription, Target
from router.compiler.compiled_table import Beside
from router.compiler.expressions import tree
from router.compiler.expressions.kinds import UINT32, StringKind
from router.compiler.expressions.states import gate_of, state_name, state_variables
from router.compiler.lowering import lists
from router.compiler.lowering.cdr import cdr_message
from router.compiler.lowering.expressions import Lowering
from router.compiler.lowering.layout import Layout, protobuf_layout
from router.compiler.lowering.lowered import (
    LoweredCollect,
    LoweredConstant,
    LoweredElements,
    LoweredFeed,
    LoweredOrder,
    LoweredRoute,
    LoweredState,
)
from router.compiler.lowering.messages import Placed
from router.compiler.lowering.names import Meaning, Names, TooLargeError
from router.compiler.lowering.numbers import signs
from router.compiler.lowering.operations import Operation, Routine, Slot, chained, depths, most_executed, nesting
from router.compiler.lowering.protobuf import protobuf_fields, protobuf_message, rewrapped
from router.compiler.lowering.sections import Section
from router.compiler.lowering.steps import cdr_layout
from router.compiler.plan import Record
from router.declared import (
    MAX_DATAGRAM,
    MOST_LOOPS,
    MOST_OPEN,
    MOST_SECTIONS_DEEP,
    MOST_STACKED,
    MOST_STATE_TEXT,
    NONE,
    Op,
)
from router.errors import SourceSpan
from router.table.model.routes import Route
from router.types.model import MessageType
from router.types.protobuf import Envelope, PayloadCase

MOST_CONDITION_OPERATIONS = 1 << 18
"""Maximum operations per datagram of a destination's `when`, a reply, `order` or a state's value, about a millisecond
of the receive thread."""

_MOST_SLOTS = NONE


@dataclass
class _Source:
    """A message that routines read into `root`. `topic` is its source, empty for UDP; `states` are the table's."""

    root: Section
    topic: str = ""
    states: Sequence[str] = ()
    temporaries: list[Slot] = field(default_factory=list)
    elements: list[Section] = field(default_factory=list)
    variables: dict[str, Meaning] = field(default_factory=dict)

    def __post_init__(self) -> None:
        received_at, source = Slot(0, tree.RECEIVED_AT), Slot(self.topic.encode(), tree.SOURCE)
        self.variables[tree.MESSAGE] = self.root
        self.add(received_at, source)

    def add(self, *slots: Slot) -> None:
        """Make these slots available to expressions by name."""
        self.temporaries += slots
        self.variables |= {slot.name: slot for slot in slots}

    def lowering(self) -> Lowering:
        """Return the lowering of one target, which can have its own variables."""
        return Lowering(Names(dict(self.variables), self.temporaries, self.elements))

    def condition(
        self, lowering: Lowering, conditions: Sequence[tree.Node | None], *, is_bounded: bool = False
    ) -> tuple[Routine, str]:
        """Lower the conjunction of conditions, with its place. Raises TooLargeError.

        `is_bounded`: the receive thread evaluates it.
        """
        given = [condition for condition in conditions if condition is not None]
        if not given:
            return (), ""
        read = [self._state(lowering, state) for state in state_variables(given)]
        routine = (*read, *chained(Op.AND, [lowering.value(condition) for condition in given]))
        _require_small([(operation, given[-1].span) for operation in routine])
        if is_bounded:
            _require_fast(routine, given[-1].span, "a destination's `when`")
        return routine, ", or ".join(f"{condition.span}: when" for condition in given)

    def _state(self, lowering: Lowering, state: tree.Variable) -> Operation:
        """Return the operation that reads a state for a condition, which then sees a single value of it."""
        is_text = isinstance(state.kind, StringKind)
        slot = Slot(b"" if is_text else 0, state.name)
        self.temporaries.append(slot)
        lowering.names.variables[slot.name] = slot
        if is_text:
            lowering.names.count_text(MOST_STATE_TEXT, state.span)
        return Operation(Op.STATE, slot, number=self.states.index(state_name(state)))

    def _number(self, node: tree.Node) -> Routine:
        routine = self.lowering().value(node)
        _require_small([(operation, node.span) for operation in routine])
        return routine

    def sent(
        self, lowering: Lowering, plan: Record, case: PayloadCase, beside: Beside | None = None
    ) -> tuple[Routine, tuple[str, ...]]:
        """Lower the envelope for an endpoint, with the place of each operation. `beside` precedes the payload."""
        return _with_places(protobuf_message(lowering, plan, case, beside.data if beside else b""))

    def gate(self, target: Target, conditions: Sequence[tree.Node | None]) -> Routine:
        """Lower what a message that was held must still meet when it leaves. Raises TooLargeError."""
        return self.condition(self.lowering(), gate_of(conditions))[0] if target.is_deferred else ()

    def for_each(self, node: tree.Node) -> _Elements:
        """Lower the list of `for_each`, and return it with `item`, `index` and `count`. Raises TooLargeError."""
        lowering = self.lowering()
        of = lists.checked_list(lowering, node)
        _require_small([(operation, node.span) for operation in of.routine])
        item: Meaning = Slot(0, tree.ITEM)
        counts = Slot(0, tree.INDEX), Slot(0, tree.COUNT)
        if of.message is not None:
            item = lowering.names.element(of.message)
            item.path = f"{tree.ITEM}."
        self.temporaries += [slot for slot in (item, *counts) if isinstance(slot, Slot)]
        return _Elements(of, dict(zip((tree.ITEM, tree.INDEX, tree.COUNT), (item, *counts), strict=True)))


@dataclass(frozen=True, slots=True)
class _Elements:
    """`for_each`: its list, and the variables for each element."""

    of: lists.StoredList
    variables: Mapping[str, Meaning]

    def lowered(self, targets: Iterable[Target]) -> LoweredElements:
        """Return `for_each` once the layout is made; `targets` use the variables."""
        item = self.variables[tree.ITEM]
        section = item.index if isinstance(item, Section) and item.wanted else NONE
        return LoweredElements(self.of.routine, self.of.scalar, section, *_used(self.variables.values(), targets))


class Datagram(_Source):
    """A payload from UDP, in its envelope unless it is read alone."""

    def __init__(self, case: PayloadCase, envelope: Envelope | None = None, states: Sequence[str] = ()) -> None:
        descriptor: Descriptor = case.message_class.DESCRIPTOR  # type: ignore[assignment]  # of upb
        super().__init__(Section(case.type, descriptor), states=states)
        self._envelope: Section | None = None
        if envelope is not None:
            around: Descriptor = envelope.message_class.DESCRIPTOR  # type: ignore[assignment]  # of upb
            self._envelope = Section(envelope.beside, around, f"{tree.ENVELOPE}.")
            self.variables[tree.ENVELOPE] = self._envelope
        self._is_rewrapped = False

    def lowered(self, checked: CheckedRoute, targets: Sequence[Target]) -> LoweredRoute:
        """Lower destinations, topics or replies of a route, which share a layout. Raises TooLargeError."""
        collect = checked.collect if targets[0].topic else None
        span = checked.route.span
        if collect is None:
            by_label, layout = self._targets(targets, "", span)
            return LoweredRoute(by_label, layout)
        by, count, order = map(self._number, (collect.by, collect.count, collect.order))
        frame = Slot(None, tree.ITEMS), Slot(0, tree.COUNT)
        self.add(*frame)
        by_label, layout = self._targets(targets, f"{collect.span}: collect", span)
        is_text = isinstance(collect.by.kind, StringKind)
        signed = signs(UINT32, collect.count.kind, collect.order.kind)
        lowered = LoweredCollect(by, count, order, is_text, signed, *_used(frame, by_label.values()))
        return LoweredRoute(by_label, layout, lowered)

    def _targets(self, targets: Sequence[Target], collect: str, span: SourceSpan) -> tuple[dict[str, Target], Layout]:
        """Lower targets, and return them with their layout. `collect` is its place in the table, if there is one."""
        split = {target.label: self.for_each(target.for_each) for target in targets if target.for_each is not None}
        made = [self._target(target, split.get(target.label), collect) for target in targets]
        layout = self.layout(span)
        for index, target in enumerate(made):
            if (elements := split.get(target.label)) is not None:
                made[index] = replace(target, elements=elements.lowered([target]))
        return {target.label: target for target in made}, layout

    def _target(self, target: Target, elements: _Elements | None, collect: str) -> Target:
        """Lower a topic, a reply, or a destination, which gets the datagram as received."""
        lowering = self.lowering()
        splits = ""
        if target.for_each is not None and elements is not None:
            lowering.names.variables |= elements.variables
            splits = f"{target.for_each.span}: for_each"
        condition, when = self.condition(lowering, [target.when], is_bounded=not target.is_topic)
        message, places = self._message(lowering, target)
        gate = self.gate(target, [target.when])
        places = ("", when, collect, splits, *places)
        return replace(target, condition=condition, gate=gate, message=message, places=places)

    def state(self, state: CheckedState) -> LoweredState:
        """Lower the value of a state. Raises TooLargeError."""
        routine, span = self._number(state.value), state.value.span
        _require_fast(routine, span, "the value of a state")
        return LoweredState(routine, self.layout(span), f"{span}: state")

    def ordered(self, order: CheckedOrder) -> LoweredOrder:
        """Lower the number of `order`. Raises TooLargeError."""
        routine, span = self._number(order.number), order.number.span
        _require_fast(routine, span, "`order`")
        return LoweredOrder(routine, self.layout(span), order.bits, order.is_unsigned)

    def _message(self, lowering: Lowering, target: Target) -> tuple[Routine, tuple[str, ...]]:
        """Lower the message of a target, with the place of each operation; nothing for a datagram as received."""
        if target.rewrapped is not None:
            self._is_rewrapped = True
            beside = target.beside.data if target.beside else b""
            return _with_places(rewrapped(target.rewrapped, beside, target.span))
        if target.plan is not None and target.reply is not None:
            message, places = self.sent(lowering, target.plan, target.reply, target.beside)
            _require_fast(message, target.span, "a reply")
            return message, places
        return self.published(lowering, target.plan) if target.plan is not None else ((), ())

    def published(self, lowering: Lowering, plan: Record) -> tuple[Routine, tuple[str, ...]]:
        """Lower the ROS message of a topic, with the place of each operation."""
        return _with_places(cdr_message(lowering, plan))

    def layout(self, span: SourceSpan) -> Layout:
        """Return the layout of all routines made so far. Raises TooLargeError."""
        envelope = self._envelope if self._envelope and (self._envelope.wanted or self._is_rewrapped) else None
        around = (envelope,) if envelope is not None else ()
        for section in (self.root, *around, *self.elements):
            if (depth := section.depth()) >= MOST_SECTIONS_DEEP:
                message = f"this reads a field {depth} messages deep; the limit is {MOST_SECTIONS_DEEP - 1}"
                raise TooLargeError(span, message, "read less deeply nested fields")
        return _small(protobuf_layout(self.temporaries, self.root, envelope, self.elements), span)


class RosMessage(_Source):
    """A message from a ROS topic."""

    def __init__(self, declared: MessageType, topic: str, states: Sequence[str] = ()) -> None:
        super().__init__(Section(declared, None), topic, states)

    def lowered(self, checked: CheckedRoute, feed: CheckedSubscription) -> LoweredFeed:
        """Lower a route's routines for these messages. Raises TooLargeError."""
        elements = self.for_each(feed.for_each) if feed.for_each is not None else None
        self.variables |= elements.variables if elements else {}
        stamp = self._stamp(feed.stamp)
        place = f"{feed.for_each.span}: for_each" if feed.for_each is not None else ""
        targets = {}
        for target in feed.targets:
            lowering = self.lowering()
            condition, when = self.condition(lowering, [feed.when, target.when])
            assert target.plan is not None  # noqa: S101 - a message of ROS is mapped
            message, places = self.sent(lowering, target.plan, target.rewrapped or checked.case, target.beside)
            all_places = f"{feed.topic.span}: a malformed message", when, "", place, *places
            gate = self.gate(target, [feed.when, target.when])
            targets[target.label] = replace(target, condition=condition, gate=gate, message=message, places=all_places)
        layout = self.layout(feed.topic.span)
        return LoweredFeed(
            checked.route.name,
            is_urgent(checked.route, feed),
            targets,
            layout,
            _indexes(stamp),
            elements.lowered(targets.values()) if elements else None,
        )

    def state(self, state: CheckedState, feed: CheckedSubscription) -> LoweredState:
        """Lower the value of a state. Raises TooLargeError."""
        routine, span, stamp = self._number(state.value), state.value.span, self._stamp(feed.stamp)
        return LoweredState(routine, self.layout(span), f"{span}: state", _indexes(stamp))

    def _stamp(self, node: tree.Node | None) -> tuple[Slot, ...]:
        """Return the slots of the seconds and nanoseconds of a field with a time; none without a field."""
        if node is None:
            return ()
        assert isinstance(node, tree.Read)  # noqa: S101 - it is a field of the message
        _, moment = self.lowering().message(node)
        seconds, nanoseconds = moment.type.fields
        return moment.value(seconds), moment.value(nanoseconds)

    def layout(self, span: SourceSpan) -> Layout:
        """Return the layout of all routines made so far. Raises TooLargeError."""
        return _small(cdr_layout(self.temporaries, self.root, self.elements, span), span)


class Constants(_Source):
    """No message: deadmen, and `set` of endpoints, have constants."""

    def __init__(self) -> None:
        super().__init__(Section(MessageType("nothing"), None))

    def envelope(self, plan: Record, case: PayloadCase) -> LoweredConstant:
        """Lower the envelope of a payload. Raises TooLargeError, as do the others."""
        return self._lowered(plan, protobuf_message(self.lowering(), plan, case))

    def fields(self, plan: Record, descriptor: Descriptor) -> LoweredConstant:
        """Lower the fields of a protobuf message."""
        return self._lowered(plan, protobuf_fields(self.lowering(), plan, descriptor))

    def cdr(self, plan: Record) -> LoweredConstant:
        """Lower a ROS message."""
        return self._lowered(plan, cdr_message(self.lowering(), plan))

    def _lowered(self, plan: Record, placed: Sequence[Placed]) -> LoweredConstant:
        _require_small([(operation, place.span) for operation, place in placed])
        layout = _small(cdr_layout(self.temporaries, self.root, self.elements, plan.span), plan.span)
        return LoweredConstant(tuple(operation for operation, _ in placed), layout, tuple(place for _, place in placed))


def is_urgent(route: Route, feed: CheckedSubscription) -> bool:
    """Return whether messages from a topic are served before others: they expire, or feed or disarm a deadman."""
    return route.ttl is not None or any(target.deadmen for target in feed.targets)


def _indexes(stamp: tuple[Slot, ...]) -> tuple[int, int] | None:
    """Return the numbers of the slots of a stamp, known once there is a layout."""
    return (stamp[0].index, stamp[1].index) if stamp else None


def _used(variables: Iterable[Meaning], targets: Iterable[Target]) -> Iterator[int]:
    """Yield the slot of each variable that operations of the targets use, NONE for all others."""
    slots = [operation.slot for target in targets for operation in _operations(target)]
    for variable in variables:
        is_used = isinstance(variable, Slot) and any(variable is slot for slot in slots)
        yield variable.index if is_used else NONE


def _operations(target: Target) -> Routine:
    return (*target.condition, *target.message, *(target.elements.routine if target.elements else ()))


def _with_places(placed: Sequence[Placed]) -> tuple[Routine, tuple[str, ...]]:
    _require_small([(operation, place.span) for operation, place in placed])
    texts = {id(place): str(place) for place in {id(place): place for _, place in placed}.values()}
    return tuple(operation for operation, _ in placed), tuple(texts[id(place)] for _, place in placed)


# ---- limits


def _require_small(placed: Sequence[tuple[Operation, SourceSpan]]) -> None:
    """Raise TooLargeError if a routine is nested too deeply."""
    operations = [operation for operation, _ in placed]
    kinds = [operation.kind for operation in operations]
    if len(kinds) < MOST_STACKED and kinds.count(Op.REPEAT) <= MOST_LOOPS and kinds.count(Op.OPEN) <= MOST_OPEN:
        return
    loops, opened = (nesting(operations, *kinds) for kinds in ((Op.REPEAT, Op.AGAIN), (Op.OPEN, Op.CLOSE)))
    limits = (
        (depths(operations), MOST_STACKED - 1, "intermediate values are needed here", "nest fewer brackets"),
        (loops, MOST_LOOPS, "lists are nested here", "nest fewer lists"),
        (opened, MOST_OPEN, "messages are nested here", "nest fewer messages"),
    )
    for counts, most, what, hint in limits:
        for (_, span), count in zip(placed, counts, strict=True):
            if count > most:
                raise TooLargeError(span, f"more than {most} {what}", hint)


def _require_fast(routine: Routine, span: SourceSpan, what: str) -> None:
    """Raise TooLargeError if a routine could occupy the receive thread for too long."""
    if (most := most_executed(routine)) > MOST_CONDITION_OPERATIONS:
        limit = f"the limit for {what} is {MOST_CONDITION_OPERATIONS:,}"
        message = f"this could take {most:,} operations on the longest datagram; {limit}"
        hint = f"a list counts as {MAX_DATAGRAM:,} elements: use fewer lists, or use them less often"
        raise TooLargeError(span, message, hint)


def _small(layout: Layout, span: SourceSpan) -> Layout:
    """Return the layout. Raises TooLargeError if it has too many slots or sections."""
    most = max(len(layout.defaults), len(layout.sections))
    if most > _MOST_SLOTS:
        message = f"these mappings use {most} values; the limit is {_MOST_SLOTS}"
        raise TooLargeError(span, message, "split it into several routes, or map fewer fields")
    return layout
