"""The targets of routes as the carrier executes them: `struct targets` of `native/deliver.h`."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from router import declared as c
from router.carrier.collectors import native_collect
from router.carrier.deferrals import Adoption, held_period
from router.carrier.lowered import Programs, native_values
from router.carrier.outlets import Outlets
from router.carrier.reasons import LOSSES
from router.compiler.lowering import LoweredRoute, LoweredTarget
from router.compiler.program import STRANGER, Handler, Program, TargetPlan, source_label


@dataclass(slots=True)
class TargetWriter:
    """Makes the targets of one program. `arrays` gets what has to live as long as they do."""

    program: Program
    outlets: Outlets
    generation: int
    arrays: list[object]
    adopted: list[Adoption] = field(default_factory=list)
    """Deferrals and collectors, for a `struct timer_change`."""
    _topics: dict[str, c.Topic] = field(default_factory=dict)
    _sources: ctypes.Array[c.Value] | None = None

    def of_datagrams(self, handler: Handler, plans: Sequence[TargetPlan], lowered: LoweredRoute | None) -> c.Targets:
        """Targets that get datagrams; `lowered` are the programs of those that have some."""
        if lowered is None:
            return self.targets(handler, plans, {}, None)
        programs = Programs(lowered.layout, self.arrays)
        made = self.targets(handler, plans, lowered.targets, programs)
        if lowered.collect is not None:
            collector = self.outlets.collector(handler)
            made.collect = ctypes.pointer(native_collect(lowered.collect, programs, collector, self._ids_of_senders()))
            self.adopted.append(Adoption(collector.address, True, ctypes.addressof(made)))
        made.layout, made.sources = programs.layout(), self._names_of_senders()
        return made

    def targets(
        self,
        handler: Handler,
        plans: Sequence[TargetPlan],
        lowered: Mapping[str, LoweredTarget],
        programs: Programs | None,
    ) -> c.Targets:
        """The targets, without their layout."""
        targets = []
        for plan in plans:
            target = self._topic_target(plan) if plan.is_topic else self._destination(handler, plan)
            if programs is not None and plan.label in lowered:
                target.condition = programs.code(lowered[plan.label].condition)
                target.message = programs.code(lowered[plan.label].message)
            self._complete(target, handler, plan)
            targets.append(target)
        number = self.outlets.names.number
        array = (c.Target * len(targets))(*targets)
        made = c.Targets(
            ttl=handler.ttl or 0,
            targets=array,
            count=len(targets),
            route=number(handler.route),
            topic=c.NO_NAME if handler.topic is None else number(handler.topic),
            generation=self.generation,
        )
        for target, plan in zip(array, plans, strict=True):
            if target.deferral:
                to = ctypes.addressof(made), ctypes.addressof(target)
                self.adopted.append(Adoption(target.deferral, plan.is_topic, *to))
        self.arrays.append(made)
        return made

    def _complete(self, made: c.Target, handler: Handler, plan: TargetPlan) -> None:
        """Add what all targets have."""
        counters, place = self.program.counters, (handler.route, plan.label)
        made.id = self.outlets.names.number(plan.label)
        made.waiting = counters.index("messages_waiting", *place)
        made.filtered = counters.index("messages_filtered", *place)
        if plan.is_topic and handler.collect_timeout is not None:
            made.collected = counters.index("messages_collected", *place)
        made.delivered = counters.index("messages_published" if plan.is_topic else "datagrams_sent", *place)
        made.dropped[:] = [counters.index("messages_dropped", *place, reason) for reason in LOSSES]
        if not plan.is_topic:
            made.delivered_bytes = counters.index("sent_bytes", *place)
        made.period, made.priority = held_period(plan), c.Priority[plan.priority.name]
        if (deferral := self.outlets.deferral(handler, plan)) is not None:
            made.deferral = deferral.address
            self.arrays.append(deferral)
        if plan.max_rate is not None and not made.period:
            limit = self.outlets.limit(handler, plan)
            made.limit = ctypes.pointer(limit)
            self.arrays.append(limit)

    def _destination(self, handler: Handler, plan: TargetPlan) -> c.Target:
        made = c.Target(
            sender=self.outlets.senders[plan.label],
            trims=self.program.table.endpoints[plan.label].trim_trailing_zeros,
        )
        if self.outlets.boards is not None:
            made.board = self.outlets.boards.pointer(plan.label)
            self.arrays.append(self.outlets.boards)
        if plan.deadmen:
            feeds = [
                c.Feed(deadman=deadman, disarms=disarms)
                for deadman, disarms in self.outlets.feeds(handler.route, plan.deadmen)
            ]
            made.feeds, made.feed_count = (c.Feed * len(feeds))(*feeds), len(feeds)
        return made

    def _topic_target(self, plan: TargetPlan) -> c.Target:
        if plan.label not in self._topics:
            publication = self.outlets.publications[plan.label]
            self._topics[plan.label] = c.Topic(
                publisher=publication.address, wanted=ctypes.addressof(publication.wanted)
            )
            self.arrays.append(publication)
        return c.Target(topic=ctypes.pointer(self._topics[plan.label]))

    def _ids_of_senders(self) -> list[int]:
        """By column."""
        return [self.outlets.names.number(label) for label in self._labels_of_senders()]

    def _labels_of_senders(self) -> list[str]:
        return [*self.program.table.endpoints, source_label(STRANGER)]

    def _names_of_senders(self) -> ctypes.Array[c.Value]:
        """By column."""
        if self._sources is None:
            self._sources = native_values([label.encode() for label in self._labels_of_senders()], self.arrays)
        return self._sources
