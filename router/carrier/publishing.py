"""Topics that a native thread publishes on: the arrays that it executes, and the thread."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from threading import Lock
from time import sleep
from typing import Any, Protocol

from router.carrier import structures as c
from router.carrier.ring import Ring
from router.clock import monotonic_ns
from router.compiler.lowering import LoweredRoute, LoweredTarget
from router.compiler.lowering.operations import Code, Layout
from router.compiler.program import STRANGER, Handler, Program, TargetPlan, source_label

_POLL_S = 0.002

_OPERATION, _REAL_OPERATION = struct.Struct("@BBHIq"), struct.Struct("@BBHId")
"""`struct operation`, with an integer and with a real number."""


class Publication(Protocol):
    """What `ros.endpoints.Publication` is. Several threads may publish at a time, until it is closed."""

    @property
    def address(self) -> int: ...

    @property
    def wanted(self) -> ctypes.Array[Any]: ...


@dataclass(slots=True)
class PublishRoutes:
    """Makes the routes of one program, and keeps what they refer to. `publications` are by topic.

    `number(name)` returns what stands for a name in events, `limit(handler, target)` the limit of a target with
    `max_rate`. `generation` is that of the carrier program.
    """

    program: Program
    publications: Mapping[str, Publication]
    number: Callable[[str], int]
    limit: Callable[[Handler, TargetPlan], c.Limit]
    generation: int = 0
    arrays: list[object] = field(default_factory=list)
    _topics: dict[str, c.PublishTopic] = field(default_factory=dict)
    _sources: ctypes.Array[c.Value] | None = None

    def route(self, handler: Handler, targets: Sequence[TargetPlan]) -> c.PublishRoute:
        """A route with these topics, which are all that can be lowered of it."""
        lowered = self.program.lowered[handler.route]
        plans = {target.label: target for target in targets}
        made = native_route(lowered, self.arrays)
        for index, label in enumerate(lowered.targets):
            self._complete(made.targets[index], handler, plans[label])
        if self._sources is None:
            labels = *self.program.table.endpoints, source_label(STRANGER)
            self._sources = native_values([label.encode() for label in labels], self.arrays)
        made.ttl, made.id, made.sources = handler.ttl or 0, self.number(handler.route), self._sources
        made.program = self.generation
        return made

    def _complete(self, made: c.PublishTarget, handler: Handler, target: TargetPlan) -> None:
        made.topic = ctypes.pointer(self._topic(target.label))
        if target.max_rate is not None:
            limit = self.limit(handler, target)
            made.limit = ctypes.pointer(limit)
            self.arrays.append(limit)
        counters, place = self.program.counters, (handler.route, target.label)
        made.published = counters.index("messages_published", *place)
        made.waiting = counters.index("messages_waiting", *place)
        made.filtered = counters.index("messages_filtered", *place)
        for reason in ("stale", "rate_limited", "mapping_error", "non_finite", "publish_error"):
            setattr(made, reason, counters.index("messages_dropped", *place, reason))

    def _topic(self, label: str) -> c.PublishTopic:
        if label not in self._topics:
            publication = self.publications[label]
            self._topics[label] = c.PublishTopic(
                publisher=publication.address, wanted=ctypes.addressof(publication.wanted), id=self.number(label)
            )
            self.arrays.append(publication)
        return self._topics[label]


# ---- arrays


def native_route(lowered: LoweredRoute, arrays: list[object]) -> c.PublishRoute:
    """A route with its programs only."""
    literals = bytearray()
    targets = [_target(target, literals, arrays) for target in lowered.targets.values()]
    text = ctypes.create_string_buffer(bytes(literals))
    made = c.PublishRoute(
        nodes=_nodes(lowered.layout, arrays),
        defaults=native_values(lowered.layout.defaults, arrays),
        literals=ctypes.addressof(text),
        targets=(c.PublishTarget * len(targets))(*targets),
        slot_count=len(lowered.layout.defaults),
        target_count=len(targets),
    )
    arrays += [text, made]
    return made


def _target(target: LoweredTarget, literals: bytearray, arrays: list[object]) -> c.PublishTarget:
    made = c.PublishTarget(condition_count=len(target.condition), operation_count=len(target.operations))
    if target.condition:
        made.condition = _operations(target.condition, literals, arrays)
    made.operations = _operations(target.operations, literals, arrays)
    return made


def _operations(code: Code, literals: bytearray, arrays: list[object]) -> ctypes.Array[c.Operation]:
    packed = bytearray()
    for kind, slot, flag, size, number, data in code:
        if data:
            number = len(literals)  # noqa: PLW2901 - where the data stands
            literals += data
        form = _REAL_OPERATION if isinstance(number, float) else _OPERATION
        packed += form.pack(kind, flag, slot if isinstance(slot, int) else slot.index, size, number)
    made = (c.Operation * len(code)).from_buffer(packed)
    arrays.append(made)
    return made


def _nodes(layout: Layout, arrays: list[object]) -> ctypes.Array[c.Node]:
    nodes = []
    for fields, first_slot, slot_count in layout.nodes:
        made = (c.NodeField * len(fields))(*(c.NodeField(*each) for each in fields))
        nodes.append(c.Node(made, len(fields), first_slot, slot_count))
        arrays.append(made)
    return (c.Node * len(nodes))(*nodes)


def native_values(values: Sequence[int | float | bytes | None], arrays: list[object]) -> ctypes.Array[c.Value]:
    """What slots hold: for a list, which is empty, None."""
    made = (c.Value * len(values))()
    for to, value in zip(made, values, strict=True):
        if isinstance(value, bytes):
            data = ctypes.create_string_buffer(value)
            arrays.append(data)
            to.bits, to.size = ctypes.addressof(data), len(value)
        elif isinstance(value, float):
            (to.bits,) = struct.unpack("@Q", struct.pack("@d", value))
        else:
            to.bits = (value or 0) & 0xFFFF_FFFF_FFFF_FFFF
    arrays.append(made)
    return made


# ---- the thread


class PublishThread:
    """Publishes the messages of `ring`, whose parts say what they come to. It starts at once, and stops once.

    `counters` is the array that it counts in; losses go to `events`. `functions` are the addresses of those in
    `ros.rcl.PublishFunctions`.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        ring: Ring,
        counters: ctypes.Array[ctypes.c_int64],
        events: Ring,
        functions: tuple[int, int, int],
    ) -> None:
        """Raises MemoryError, also for a lack of descriptors or threads."""
        self._library = library
        self._ring, self._counters, self._events = ring, counters, events
        self._in_use = Lock()  # for those who ask while it may be stopped
        self._address: int = library.publishing_open(ring.address, counters, events.address, *functions)
        if not self._address:
            raise MemoryError("the thread that publishes cannot be started")

    def counters(self, count: int) -> list[int]:
        """Return the first counters, as they are between two messages."""
        copy = (ctypes.c_int64 * count)()
        with self._in_use:
            if not self._address:
                return list(self._counters[:count])
            self._library.publishing_counters(self._address, copy, count)
        return list(copy)

    def advance(self, generation: int) -> None:
        """Go on to that generation once all earlier messages are served: none of them can come any more."""
        with self._in_use:
            if self._address:
                self._library.publishing_advance(self._address, generation)

    def wait_for(self, generation: int, timeout: float) -> bool:
        """Wait until nothing of earlier generations is in use. Return False after `timeout` s."""
        for _ in range(int(timeout / _POLL_S)):
            with self._in_use:
                if not self._address or self._library.publishing_has_reached(self._address, generation):
                    return True
            sleep(_POLL_S)
        return False

    def hold(self, generation: int) -> None:
        """Serve nothing of that generation or a later one, until this is called with 0."""
        with self._in_use:
            if self._address:
                self._library.publishing_hold(self._address, generation)

    def stalled(self) -> tuple[int, float] | None:
        """The topic in whose publisher the thread is now, by its number, and for how many seconds; None if in none."""
        topic = ctypes.c_uint32()
        with self._in_use:
            since = self._library.publishing_since(self._address, ctypes.byref(topic)) if self._address else 0
        return (topic.value, (monotonic_ns() - since) / 1e9) if since else None

    def stop(self) -> bool:
        """Serve what waits, and end.

        Return False if the thread is stuck in the middleware after 1 s: then it is left, and publishers must stay open.
        Idempotent.
        """
        with self._in_use:
            address, self._address = self._address, 0
        if not address:
            return self not in _left
        if not self._library.publishing_stop(address):
            _left.append(self)
            return False
        return True


_left: list[PublishThread] = []
"""Those that were stuck when they were to end: they use their ring and their counters."""
