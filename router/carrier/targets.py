"""The targets of routes as the carrier executes them: `struct targets` of `native/deliver.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from router import declared as c
from router.carrier.collectors import native_collect
from router.carrier.deferrals import Adoption
from router.carrier.limits import period
from router.carrier.outlets import Outlets
from router.carrier.reasons import LOSSES
from router.carrier.state import Native
from router.compiler.lowering import LoweredRoute, LoweredTarget
from router.compiler.lowering.arrays import Arrays
from router.compiler.lowering.routines import Routines, native_values
from router.compiler.program import STRANGER, Program, RoutePlan, TargetPlan, source_label
from router.table.model import OnLimit

Sources = Mapping[int, "str | None"]
"""The sources of a route, by `source_of` in native/deliver.h; None stands for all publishers of a topic."""


@dataclass(slots=True)
class TargetStates:
    """The mutable state of targets: limits, deferrals, deadmen, collectors.

    `adopted` are the deferrals and collectors, for a `struct timer_change`.
    """

    adopted: list[Adoption] = field(default_factory=list)
    _targets: list[tuple[c.Targets, RoutePlan, Sequence[TargetPlan], Sources]] = field(default_factory=list)
    _collects: list[tuple[c.Targets, c.Collect, RoutePlan]] = field(default_factory=list)
    _witnesses: list[tuple[c.Witness, str]] = field(default_factory=list)
    bound: Arrays = field(default_factory=Arrays)

    def add(
        self, outlets: Outlets, made: c.Targets, plan: RoutePlan, targets: Sequence[TargetPlan], sources: Sources
    ) -> None:
        self._targets.append((made, plan, targets, sources))
        self._bind(outlets, made, plan, targets, sources)

    def add_collector(self, outlets: Outlets, made: c.Targets, collect: c.Collect, plan: RoutePlan) -> None:
        self._collects.append((made, collect, plan))
        self._bind_collector(outlets, made, collect, plan)

    def add_witness(self, outlets: Outlets, made: c.Witness, deadman: str) -> None:
        """Add a witness of the deadman of a route."""
        self._witnesses.append((made, deadman))
        made.deadman = outlets.deadmen[deadman].address

    def release(self) -> None:
        """Release the state. No message may be delivered before the next `bind`."""
        self.adopted.clear()
        self.bound.clear()

    def bind(self, outlets: Outlets) -> None:
        """Point all targets to the state of `outlets`."""
        self.release()
        for targets in self._targets:
            self._bind(outlets, *targets)
        for collects in self._collects:
            self._bind_collector(outlets, *collects)
        for made, deadman in self._witnesses:
            made.deadman = outlets.deadmen[deadman].address

    def _bind(
        self, outlets: Outlets, made: c.Targets, plan: RoutePlan, targets: Sequence[TargetPlan], sources: Sources
    ) -> None:
        for native, target in zip(made.targets[: made.count], targets, strict=True):
            if target.is_deferred:
                deferrals = {place: outlets.deferral(plan, target, source) for place, source in sources.items()}
                native.deferrals = self._by_place(deferrals)
                to = ctypes.addressof(made), ctypes.addressof(native)
                self.adopted += [Adoption(each.address, target.is_topic, *to) for each in deferrals.values()]
            if target.max_rate is not None and not native.period:
                limits = {place: outlets.limit(plan, target, source) for place, source in sources.items()}
                native.limits = self._by_place(limits)
            if target.deadmen:
                feeds = [self._feed(outlets, plan, target, route) for route in target.deadmen]
                native.feeds, native.feed_count = self.bound.array(c.Feed, feeds), len(feeds)

    def _feed(self, outlets: Outlets, plan: RoutePlan, target: TargetPlan, route: str) -> c.Feed:
        """Return the effect of the target's commands on the deadman of a route: its own, or one that they disarm."""
        feed = outlets.feed(route, target.label, disarms=route != plan.route)
        held = outlets.holding(route, target.label) if feed.disarms else []
        if held:
            self.bound.keep(*held)
            feed.superseded = self.bound.add((ctypes.c_void_p * len(held))(*(each.address for each in held)))
            feed.superseded_count = len(held)
        return feed

    def _bind_collector(self, outlets: Outlets, made: c.Targets, collect: c.Collect, plan: RoutePlan) -> None:
        collector = outlets.collector(plan)
        collect.collector = collector.address
        self.bound.keep(collector)
        self.adopted.append(Adoption(collector.address, True, ctypes.addressof(made)))

    def _by_place(self, opened: Mapping[int, Native]) -> Any:
        made = self.bound.add((ctypes.c_void_p * (max(opened) + 1))())
        for place, each in opened.items():
            made[place] = each.address
            self.bound.keep(each)
        return made


@dataclass(slots=True)
class TargetWriter:
    """Makes the targets of one program. `arrays` owns their memory."""

    program: Program
    outlets: Outlets
    generation: int
    arrays: Arrays
    states: TargetStates
    _topics: dict[str, c.Topic] = field(default_factory=dict)
    _sources: Any = None

    def of_datagrams(self, plan: RoutePlan, targets: Sequence[TargetPlan], lowered: LoweredRoute | None) -> c.Targets:
        """Make the targets that get datagrams; `lowered` are the routines of targets that have some."""
        if lowered is None:
            return self.targets(plan, targets, {}, None)
        routines = Routines(lowered.layout, self.arrays)
        made = self.targets(plan, targets, lowered.targets, routines)
        if lowered.collect is not None:
            collect = native_collect(lowered.collect, routines, self._ids_of_senders())
            made.collect = ctypes.pointer(self.arrays.add(collect))
            self.states.add_collector(self.outlets, made, collect, plan)
        made.layout, made.sources = routines.layout(), self.names_of_senders()
        return made

    def targets(
        self,
        plan: RoutePlan,
        targets: Sequence[TargetPlan],
        lowered: Mapping[str, LoweredTarget],
        routines: Routines | None,
    ) -> c.Targets:
        """Make the targets, without their layout."""
        made = []
        for target in targets:
            native = self._topic_target(target) if target.is_topic else self._destination(target)
            if routines is not None and target.label in lowered:
                native.condition = routines.routine(lowered[target.label].condition)
                native.message = routines.routine(lowered[target.label].message)
            self._complete(native, plan, target)
            made.append(native)
        number = self.outlets.names.number
        together = c.Targets(
            ttl=plan.ttl or 0,
            targets=self.arrays.array(c.Target, made),
            count=len(made),
            route=number(plan.route),
            topic=c.NO_NAME if plan.topic is None else number(plan.topic),
            generation=self.generation,
        )
        self.states.add(self.outlets, together, plan, targets, self._sources_of(plan))
        return self.arrays.add(together)

    def _complete(self, made: c.Target, plan: RoutePlan, target: TargetPlan) -> None:
        """Set the fields that all targets have."""
        counters, place = self.program.counters, (plan.route, target.label)
        made.id = self.outlets.names.number(target.label)
        made.waiting = counters.index("messages_waiting", *place)
        made.filtered = counters.index("messages_filtered", *place)
        if target.is_topic and plan.collect_timeout is not None:
            made.collected = counters.index("messages_collected", *place)
        made.delivered = counters.index("messages_published" if target.is_topic else "datagrams_sent", *place)
        made.dropped[:] = [counters.index("messages_dropped", *place, reason) for reason in LOSSES]
        if not target.is_topic:
            made.delivered_bytes = counters.index("sent_bytes", *place)
        made.period, made.priority = _held_period(target), c.Priority[target.priority.name]

    def _destination(self, target: TargetPlan) -> c.Target:
        made = c.Target(
            sender=self.outlets.senders[target.label].address,
            trims=self.program.table.endpoints[target.label].trim_trailing_zeros,
        )
        if self.outlets.boards is not None:
            made.board = self.outlets.boards.pointer(target.label)
        return made

    def _topic_target(self, target: TargetPlan) -> c.Target:
        if target.label not in self._topics:
            publication = self.outlets.publications[target.label]
            topic = c.Topic(publisher=publication.address, wanted=ctypes.addressof(publication.wanted))
            self._topics[target.label] = self.arrays.add(topic)
            self.arrays.keep(publication)
        return c.Target(topic=ctypes.pointer(self._topics[target.label]))

    def _sources_of(self, plan: RoutePlan) -> Sources:
        if plan.topic is not None:
            return {0: None}
        senders = (*self.program.table.endpoints, STRANGER)
        return {column: sender for column, sender in enumerate(senders) if sender in plan.sources}

    def _ids_of_senders(self) -> list[int]:
        """Return the numbers of the senders' names, by column."""
        return [self.outlets.names.number(label) for label in self._labels_of_senders()]

    def _labels_of_senders(self) -> list[str]:
        return [*self.program.table.endpoints, source_label(STRANGER)]

    def names_of_senders(self) -> Any:
        """Return values with the senders' names, by column."""
        if self._sources is None:
            self._sources = native_values([label.encode() for label in self._labels_of_senders()], self.arrays)
        return self._sources


def _held_period(target: TargetPlan) -> int:
    """Return the time between two messages of a target with `on_limit: latest`, in ns; otherwise 0."""
    return period(target.max_rate) if target.max_rate is not None and target.on_limit is OnLimit.LATEST else 0
