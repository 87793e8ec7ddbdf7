"""The targets of routes as the carrier executes them: `struct targets` of `native/deliver.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from router import declared as c
from router.compiler.checked import Target
from router.compiler.compiled_table import (
    STRANGER,
    Beside,
    CompiledTable,
    RoutePlan,
    StatePlan,
    is_service,
    source_label,
)
from router.compiler.lowering import LoweredCollect, LoweredElements, LoweredRoute
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.layout import Layout
from router.compiler.lowering.routines import Routines, native_values
from router.compiler.refusals import DROP_REASON_NAMES
from router.declared import MOST_STATE_TEXT
from router.image.boards import Boards
from router.image.openings import Openings, period
from router.table.model.targets import OnLimit, TargetKeys

Sources = Mapping[int, "str | None"]
"""The sources of a route, by `source_of` in native/deliver.h; None stands for all publishers of a topic."""


@dataclass(frozen=True, slots=True)
class Timer:
    """A timer to adopt, by its symbol, and the addresses of the targets or of the one target that it delivers to."""

    symbol: int
    is_topic: bool = False
    targets: int | None = None
    target: int | None = None


@dataclass(slots=True)
class TargetWriter:
    """Writes the targets of a table to `arrays`. `timers` are those of deferrals and collectors."""

    program: CompiledTable
    openings: Openings
    arrays: Arrays
    boards: Boards
    timers: list[Timer] = field(default_factory=list)
    _topics: dict[str, c.Topic] = field(default_factory=dict)
    _besides: dict[str, c.Beside] = field(default_factory=dict)
    _sources: Any = None
    states: Any = None
    """The settings of all states; None without any."""

    def __post_init__(self) -> None:
        self.states = self.arrays.array(c.StateSettings, [self._state(plan) for plan in self.program.states])

    def routines(self, layout: Layout) -> Routines:
        """Return what writes the routines of a layout."""
        return Routines(layout, self.arrays, self.states)

    def _state(self, plan: StatePlan) -> c.StateSettings:
        counters, symbol = self.program.counters, self.openings.state(plan)
        self.timers.append(Timer(symbol))
        return c.StateSettings(
            state=symbol,
            initial=_content(plan.initial),
            valid_for=c.NEVER if plan.valid_for is None else plan.valid_for,
            id=self.openings.names.number(plan.name),
            is_text=plan.is_text,
            value=0 if plan.is_text else counters.index("state", plan.name),
            changes=counters.index("state_changes", plan.name),
        )

    def setters(self, plan: RoutePlan) -> Iterator[c.Setter]:
        """Yield what the messages of a route set: each state, for each sender."""
        columns = {name: column for column, name in enumerate(self.program.table.endpoints)}
        for state in self.program.states:
            sources = sorted(state.setters.get(plan.route, ()), key=columns.__getitem__)
            if not sources:
                continue
            to = self._of_state(plan, state)
            to.sources = self.names_of_senders()
            for source in sources:
                yield self._setter(state, to, source, columns[source])

    def setter_of_topic(self, plan: RoutePlan) -> Any:
        """Return what messages of a topic set; None if the plan is that of a route."""
        for state in self.program.states:
            if plan.route in state.setters and plan.topic is not None:
                return ctypes.pointer(self.arrays.add(self._setter(state, self._of_state(plan, state), plan.topic)))
        return None

    def _setter(self, state: StatePlan, to: c.Targets, source: str, column: int = 0) -> c.Setter:
        return c.Setter(
            state=self.openings.state(state),
            to=to,
            column=column,
            source=self.openings.names.number(source),
            age=self.program.counters.index("state_set_seconds", state.name, source),
            is_text=state.is_text,
        )

    def _of_state(self, plan: RoutePlan, state: StatePlan) -> c.Targets:
        """Write what reads the messages of a route for a state, with a target that stands for it."""
        counters, number = self.program.counters, self.openings.names.number
        lowered = self.program.lowered.states[state.name]
        routines = self.routines(lowered.layout)
        target = c.Target(message=routines.routine(lowered.routine), id=number(state.label))
        target.dropped[:] = [
            counters.index("messages_dropped", plan.route, state.label, reason) for reason in DROP_REASON_NAMES
        ]
        return c.Targets(
            layout=routines.layout(),
            targets=ctypes.pointer(self.arrays.add(target)),
            count=1,
            route=number(plan.route),
            topic=c.NO_NAME if plan.topic is None else number(plan.topic),
        )

    def of_datagrams(self, plan: RoutePlan, targets: Sequence[Target], lowered: LoweredRoute | None) -> c.Targets:
        """Write the targets that get datagrams; `lowered` are the routines of targets that have some."""
        if lowered is None:
            return self.targets(plan, targets, None)
        routines = self.routines(lowered.layout)
        written = self.targets(plan, targets, routines)
        if lowered.collect is not None:
            collect = write_collect(lowered.collect, routines, self._numbers_of_senders())
            collect.collector = self.openings.collector(plan)
            written.collect = ctypes.pointer(self.arrays.add(collect))
            self.timers.append(Timer(collect.collector, True, ctypes.addressof(written)))
        written.layout, written.sources = routines.layout(), self.names_of_senders()
        return written

    def replies(self, plan: RoutePlan) -> Any:
        """Write the replies of a route; None without any."""
        targets = [target for target in plan.targets if target.reply]
        if not targets:
            return None
        labels = [target.label for target in targets]
        by_column = [labels.index(name) if name in labels else len(labels) for name in self._labels_of_senders()]
        written = c.Replies(
            to=self.of_datagrams(plan, targets, self.program.lowered.replies[plan.route]),
            by_column=self.arrays.array(ctypes.c_uint32, by_column),
        )
        return ctypes.pointer(self.arrays.add(written))

    def targets(self, plan: RoutePlan, targets: Sequence[Target], routines: Routines | None) -> c.Targets:
        """Write the targets, without their layout. Only if they have routines, `routines` is needed."""
        array = self.arrays.array(c.Target, [self._target(plan, each, routines) for each in targets])
        number = self.openings.names.number
        together = c.Targets(
            ttl=plan.ttl or 0,
            targets=array,
            count=len(targets),
            route=number(plan.route),
            topic=c.NO_NAME if plan.topic is None else number(plan.topic),
        )
        senders = self._sources_of(plan)
        for written, target in zip(array or (), targets, strict=True):
            sources = {at: each for at, each in senders.items() if not target.reply or each == target.label}
            if target.is_deferred:
                deferrals = {at: self.openings.deferral(plan, target, source) for at, source in sources.items()}
                written.deferrals = self._by_source(deferrals)
                to = ctypes.addressof(together), ctypes.addressof(written)
                self.timers += [Timer(each, target.is_topic, *to) for each in deferrals.values()]
            if target.declared.max_rate is not None and not written.period:
                limits = {at: self.openings.limit(plan, target, source) for at, source in sources.items()}
                written.limits = self._by_source(limits)
            if target.beside is not None and target.beside.changing:
                written.beside = ctypes.pointer(self._beside(target.label, target.beside))
                written.is_ordered = True
            if target.deadmen:
                written.is_ordered = True
                feeds = [self._feed(plan, target, route) for route in target.deadmen]
                written.feeds, written.feed_count = self.arrays.array(c.Feed, feeds), len(feeds)
        return self.arrays.add(together)

    def _target(self, plan: RoutePlan, target: Target, routines: Routines | None) -> c.Target:
        counters, place = self.program.counters, (plan.route, target.label)
        written = self._topic(target.label) if target.is_topic else self._destination(plan, target)
        if routines is not None:
            routine = routines.routine
            written.condition, written.message, written.gate = map(
                routine, (target.condition, target.message, target.gate)
            )
        written.id = self.openings.names.number(target.label)
        written.waiting = counters.index("messages_waiting", *place)
        written.filtered = counters.index("messages_filtered", *place)
        if target.is_topic and plan.collect_timeout is not None:
            written.collected = counters.index("messages_collected", *place)
        if routines is not None and target.elements is not None:
            written.for_each = ctypes.pointer(self.arrays.add(write_for_each(target.elements, routines)))
            written.split = counters.index("messages_split", *place)
        written.delivered = counters.index("messages_published" if target.is_topic else "datagrams_sent", *place)
        written.dropped[:] = [counters.index("messages_dropped", *place, reason) for reason in DROP_REASON_NAMES]
        if not target.is_topic:
            written.delivered_bytes = counters.index("sent_bytes", *place)
        written.period, written.priority = _held_period(target.declared), c.Priority[target.priority.name]
        return written

    def _destination(self, plan: RoutePlan, target: Target) -> c.Target:
        endpoint, case = target.label, target.reply or target.rewrapped or plan.case
        sender = self.openings.replier(endpoint) if target.reply else self.openings.sender(endpoint)
        written = c.Target(sender=sender, trims=self.program.table.endpoints[endpoint].trim_trailing_zeros)
        if endpoint in self.boards:
            written.board = self.boards[endpoint]
            if case is not None:
                written.board = self.boards.get((endpoint, case.number), written.board)
        return written

    def _beside(self, endpoint: str, beside: Beside) -> c.Beside:
        if endpoint not in self._besides:
            fields = self.arrays.array(c.BesideField, [c.BesideField(*each.members) for each in beside.changing])
            written = c.Beside(sequence=self.openings.sequence(endpoint), fields=fields, count=len(beside.changing))
            self._besides[endpoint] = self.arrays.add(written)
        return self._besides[endpoint]

    def _topic(self, topic: str) -> c.Target:
        if topic not in self._topics:
            self._topics[topic] = self.arrays.add(self._service() if is_service(topic) else self._published(topic))
        return c.Target(topic=ctypes.pointer(self._topics[topic]))

    def _published(self, topic: str) -> c.Topic:
        address = self.openings.symbols.address
        return c.Topic(
            publisher=address("publisher", topic),
            demand=ctypes.cast(address("demand", topic), ctypes.POINTER(c.Demand)),
        )

    def _service(self) -> c.Topic:
        """Write what stands for a topic: a service, whose replies Python takes."""
        demand = self.arrays.add(c.Demand(wanted=c.Wanted.EVERY_REPLY))
        return c.Topic(demand=ctypes.pointer(demand))

    def _feed(self, plan: RoutePlan, target: Target, route: str) -> c.Feed:
        """Return the effect of the target's commands on the deadman of a route: its own, or one that they disarm."""
        feed = self.openings.feed(route, target.label, disarms=route != plan.route)
        held = self.openings.holding(route, target.label) if feed.disarms else []
        if held:
            feed.superseded = self.arrays.add((ctypes.c_void_p * len(held))(*held))
            feed.superseded_count = len(held)
        return feed

    def _by_source(self, symbols: Mapping[int, int]) -> Any:
        array = self.arrays.add((ctypes.c_void_p * (max(symbols) + 1))())
        for at, symbol in symbols.items():
            array[at] = symbol
        return array

    def _sources_of(self, plan: RoutePlan) -> Sources:
        if plan.topic is not None:
            return {0: None}
        senders = (*self.program.table.endpoints, STRANGER)
        return {column: sender for column, sender in enumerate(senders) if sender in plan.sources}

    def _numbers_of_senders(self) -> list[int]:
        """Return the numbers of the senders' names, by column."""
        return [self.openings.names.number(label) for label in self._labels_of_senders()]

    def _labels_of_senders(self) -> list[str]:
        return [*self.program.table.endpoints, source_label(STRANGER)]

    def names_of_senders(self) -> Any:
        """Return values with the senders' names, by column."""
        if self._sources is None:
            self._sources = native_values([label.encode() for label in self._labels_of_senders()], self.arrays)
        return self._sources


def _content(value: int | str) -> c.StateContent:
    """Return the value of a state; a large integer as the signed one with the same 64 bits."""
    if isinstance(value, str):
        text = value.encode()
        return c.StateContent(number=len(text), text=(ctypes.c_uint8 * MOST_STATE_TEXT)(*text))
    return c.StateContent(number=value - (1 << 64) if value >= 1 << 63 else value)


def write_collect(lowered: LoweredCollect, routines: Routines, senders: Sequence[int]) -> c.Collect:
    """Write `collect`, without a collector. `senders` are numbers of names by column, `routines` the route's."""
    return c.Collect(
        by=routines.routine(lowered.by),
        count=routines.routine(lowered.count),
        order=routines.routine(lowered.order),
        senders=routines.arrays.array(ctypes.c_uint32, senders),
        is_text=lowered.is_text,
        signs=lowered.signs,
        items=lowered.items,
        counted=lowered.counted,
    )


def write_for_each(elements: LoweredElements | None, routines: Routines) -> c.ForEach:
    """Write `for_each`; empty if there is none."""
    if elements is None:
        return c.ForEach()
    return c.ForEach(
        list=routines.routine(elements.routine),
        stored=elements.scalar,
        section=elements.section,
        item=elements.item,
        index=elements.index,
        count=elements.count,
    )


def _held_period(declared: TargetKeys) -> int:
    """Return the time between two messages of a target with `on_limit: latest`, in ns; otherwise 0."""
    return period(declared.max_rate) if declared.max_rate is not None and declared.on_limit is OnLimit.LATEST else 0
