"""From the routes of a table without errors to the programs that the carrier runs (`native/operations.h`).

Each target is lowered once. A program that would be too large is a finding.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from router.compiler.checked import CheckedCollect, CheckedRoute, CheckedSubscription, CheckedTarget
from router.compiler.expressions.kinds import UINT32, StringKind
from router.compiler.expressions.tree import Node as Tree
from router.compiler.lowering.layout import Layout
from router.compiler.lowering.names import TooLargeError
from router.compiler.lowering.nodes import Node
from router.compiler.lowering.numbers import signs
from router.compiler.lowering.operations import Code, Slot
from router.compiler.lowering.sources import Collected, Datagram, Elements, RosMessage
from router.declared import NONE, Scalar
from router.errors import Diagnostic
from router.table.model import Route
from router.types.protobuf import Envelope, PayloadCase


@dataclass(frozen=True, slots=True)
class LoweredTarget:
    """The programs of a target: `condition` for its `when`, and `message`, which writes what it gets.

    Without a `when` the condition is empty. A destination from UDP gets the envelope as it was received: its `message`
    is empty. `places` are the places of the table where a message may be refused, by `enum place` in `native/events.h`:
    the topic whose message cannot be read ("" of datagrams, which are checked before), the condition, `for_each` or
    `collect`, and what each operation of `message` fills.
    """

    label: str
    condition: Code
    message: Code
    places: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LoweredCollect:
    """`collect`: programs that name the frame of a datagram, its size, and the place of the datagram in it.

    All give integers, but `by` a text if `is_text`. `signs` says whether `count` and `order` are unsigned. A complete
    frame goes to the slots `items` and `counted`, NONE for one that is not used.
    """

    by: Code
    count: Code
    order: Code
    is_text: bool
    signs: int
    items: int
    counted: int


@dataclass(frozen=True, slots=True)
class LoweredRoute:
    """Targets of a route by name, and the fields that they read. Slots 0 and 1 are `received_at` and `source`."""

    targets: Mapping[str, LoweredTarget]
    layout: Layout
    collect: LoweredCollect | None = None


@dataclass(frozen=True, slots=True)
class LoweredElements:
    """`for_each`: `code` leaves a list on the stack, which is stored as `scalar` says.

    Each element is read into `node` if it is a message, else it is put into the slot `item`; NONE for what is not used.
    """

    code: Code
    scalar: Scalar
    node: int
    item: int
    index: int
    count: int


@dataclass(frozen=True, slots=True)
class LoweredFeed:
    """The programs of a route for the messages of one topic. They are urgent if they expire, feed or disarm a deadman.

    `stamp` are the slots of seconds and nanoseconds of the message's stamp, or None.
    """

    route: str
    is_urgent: bool
    targets: Mapping[str, LoweredTarget]
    layout: Layout
    stamp: tuple[int, int] | None
    for_each: LoweredElements | None


@dataclass(frozen=True, slots=True)
class LoweredCondition:
    """A condition on a payload, and the fields that it reads. Slots are those of a LoweredRoute."""

    code: Code
    layout: Layout


@dataclass(frozen=True, slots=True)
class Lowered:
    """All that the carrier runs for a table.

    By route: `conditions` of its destinations from UDP that have one, and its `topics`. `from_ros` by topic, in the
    order of the table.
    """

    conditions: Mapping[str, LoweredRoute]
    topics: Mapping[str, LoweredRoute]
    from_ros: Mapping[str, tuple[LoweredFeed, ...]]


def lower_table(routes: Sequence[CheckedRoute], envelope: Envelope) -> tuple[Lowered, list[Diagnostic]]:
    """Lower all targets of a table without errors."""
    served = [checked for checked in routes if not checked.route.ignore]
    table = _Table(envelope)
    for checked in served:
        table.add(checked)
    carried = {topic: tuple(feeds) for topic, feeds in table.from_ros.items()}
    return Lowered(table.conditions, table.topics, carried), table.findings


def lower_condition(condition: Tree, case: PayloadCase, envelope: Envelope) -> LoweredCondition:
    """Lower a condition on a payload by itself. Raises TooLargeError."""
    source = Datagram(case, envelope)
    code = source.condition(source.lowering(), [condition]).code
    return LoweredCondition(code, source.layout(condition.span))


class _Table:
    def __init__(self, envelope: Envelope) -> None:
        self.envelope = envelope
        self.conditions: dict[str, LoweredRoute] = {}
        self.topics: dict[str, LoweredRoute] = {}
        self.from_ros: dict[str, list[LoweredFeed]] = {}
        self.findings: list[Diagnostic] = []

    def add(self, checked: CheckedRoute) -> None:
        conditions = [target for target in checked.targets if not target.topic and target.when is not None]
        topics = [target for target in checked.targets if target.topic]
        for targets, lowered in ((conditions, self.conditions), (topics, self.topics)):
            if targets and (made := self._route(checked, targets)) is not None:
                lowered[checked.route.name] = made
        for feed in checked.subscriptions:
            if (fed := self._feed(checked, feed)) is not None:
                self.from_ros.setdefault(feed.topic.topic.value, []).append(fed)

    # from UDP

    def _route(self, checked: CheckedRoute, targets: Sequence[CheckedTarget]) -> LoweredRoute | None:
        """Targets that share a layout; None with a finding."""
        source = Datagram(checked.case, self.envelope)
        collect = checked.collect if targets[0].topic else None
        try:
            collected = source.collect(collect) if collect else None
            place = f"{collect.span}: collect" if collect else ""
            made = {target.label: _published_or_forwarded(source, target, place) for target in targets}
            layout = source.layout(checked.route.span)
            if collect is None or collected is None:
                return LoweredRoute(made, layout)
            return LoweredRoute(made, layout, _collect(collect, collected, made.values()))
        except TooLargeError as error:
            self.findings.append(error.diagnostic)
            return None

    # from ROS

    def _feed(self, checked: CheckedRoute, feed: CheckedSubscription) -> LoweredFeed | None:
        try:
            return _lowered_feed(checked, feed)
        except TooLargeError as error:
            self.findings.append(error.diagnostic)
            return None


def is_urgent(route: Route, feed: CheckedSubscription) -> bool:
    """Whether messages from a topic are served before others: they expire, or feed or disarm a deadman."""
    return route.ttl is not None or any(target.deadmen for target in feed.targets)


def _published_or_forwarded(source: Datagram, target: CheckedTarget, place: str) -> LoweredTarget:
    lowering = source.lowering()
    condition = source.condition(lowering, [target.when], is_bounded=target.plan is None)
    if target.plan is None:
        return LoweredTarget(target.label, condition.code, (), ("", condition.place, place))
    message = source.published(lowering, target.plan)
    return LoweredTarget(target.label, condition.code, message.code, ("", condition.place, place, *message.places))


def _collect(checked: CheckedCollect, made: Collected, targets: Iterable[LoweredTarget]) -> LoweredCollect:
    used = _used(targets)
    items, counted = (each.index if _is_among(each, used) else NONE for each in (made.items, made.counted))
    is_text = isinstance(checked.by.kind, StringKind)
    signed = signs(UINT32, checked.count.kind, checked.order.kind)
    return LoweredCollect(made.by, made.count, made.order, is_text, signed, items, counted)


def _lowered_feed(checked: CheckedRoute, feed: CheckedSubscription) -> LoweredFeed:
    source = RosMessage(feed.type, feed.topic.topic.value)
    elements = source.for_each(feed.for_each) if feed.for_each is not None else None
    stamp = source.stamp(feed.stamp) if feed.stamp is not None else None
    place = f"{feed.for_each.span}: for_each" if feed.for_each is not None else ""
    targets = {}
    for target in feed.targets:
        lowering = source.lowering()
        condition = source.condition(lowering, [feed.when, target.when])
        assert target.plan is not None  # noqa: S101 - a message of ROS is mapped
        message = source.sent(lowering, target.plan, checked.case)
        places = f"{feed.topic.span}: a malformed message", condition.place, place, *message.places
        targets[target.label] = LoweredTarget(target.label, condition.code, message.code, places)
    layout = source.layout(feed.topic.span)
    return LoweredFeed(
        checked.route.name,
        is_urgent(checked.route, feed),
        targets,
        layout,
        (stamp[0].index, stamp[1].index) if stamp else None,
        _elements(elements, targets.values()) if elements else None,
    )


def _elements(elements: Elements, targets: Iterable[LoweredTarget]) -> LoweredElements:
    used = _used(targets)
    item = elements.item
    node = item.index if isinstance(item, Node) and item.wanted else NONE
    slots = (
        each.index if isinstance(each, Slot) and _is_among(each, used) else NONE
        for each in (item, elements.index, elements.count)
    )
    return LoweredElements(elements.code, elements.scalar, node, *slots)


def _used(targets: Iterable[LoweredTarget]) -> list[object]:
    """The slots and nodes of all operations."""
    return [operation.slot for each in targets for operation in (*each.condition, *each.message)]


def _is_among(slot: Slot, used: Sequence[object]) -> bool:
    return any(slot is each for each in used)
