"""Routes after their checks: plain data for `lowering`, `link` and `explain`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from router.compiler.compiled_table import Beside, DeadmanPlan, ObeyedPlan, state_label
from router.compiler.expressions.kinds import Kind
from router.compiler.expressions.tree import Node
from router.compiler.mapping import Row
from router.compiler.plan import Record
from router.errors import SourceSpan
from router.table.model.endpoints import Endpoint, EndpointKind
from router.table.model.routes import Route
from router.table.model.services import CalledService, Service
from router.table.model.state import State
from router.table.model.targets import Destination, OnLimit, Priority, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase

if TYPE_CHECKING:
    from router.compiler.lowering.lowered import LoweredElements
    from router.compiler.lowering.operations import Routine


@dataclass(frozen=True, slots=True)
class Target:
    """A target of a route, as the table declares it, with the results of its check, and then its routines.

    `endpoint` is set for a destination, `type` for a published topic, `for_each` for one that gets each element of a
    list. Without a `plan`, the datagram is forwarded: unchanged, or with its payload in another envelope, as the
    payload case `rewrapped`. `rows` describe the mapping for `explain`. `deadmen` are the routes whose deadmen each
    command to this target feeds (its own route's) or disarms. `beside` is what `set` of the endpoint fills in messages
    that the router makes. `is_request`: its messages are requests of a service, and never wait.
    `reply` is the payload case of a reply, which goes to `endpoint` when that is the sender, and never waits either.

    `lowering` adds the routines: `condition` for its `when`, and `message`, which writes its message. They are empty
    without a `when`, or without a `plan`. `gate` is the part of the condition that reads only states, if messages may
    be held: they must still meet it when they leave. `elements` is `for_each` lowered. `places` are the places of the
    table where a message may be rejected, by `enum place` in `native/events.h`: the topic whose message cannot be read
    ("" for datagrams, which are already checked), the condition, `collect`, `for_each`, and the field of each operation
    of `message`.
    """

    declared: Destination | Topic
    endpoint: Endpoint | None = None
    type: MessageType | None = None
    when: Node | None = None
    plan: Record | None = None
    rewrapped: PayloadCase | None = None
    rows: tuple[Row, ...] = ()
    declared_priority: Priority | None = None
    deadmen: tuple[str, ...] = ()
    beside: Beside | None = None
    is_request: bool = False
    reply: PayloadCase | None = None
    for_each: Node | None = None
    condition: Routine = ()
    gate: Routine = ()
    message: Routine = ()
    elements: LoweredElements | None = None
    places: tuple[str, ...] = ()

    @property
    def is_topic(self) -> bool:
        return isinstance(self.declared, Topic)

    @property
    def is_command(self) -> bool:
        """Whether its messages are commands: they go to a board, or feed or disarm a deadman."""
        return bool(self.deadmen) or (self.endpoint is not None and self.endpoint.kind is EndpointKind.BOARD)

    @property
    def priority(self) -> Priority:
        """The priority that the route declares; otherwise commands come first."""
        return self.declared_priority or (Priority.COMMAND if self.is_command else Priority.TELEMETRY)

    @property
    def topic(self) -> Topic | None:
        return self.declared if isinstance(self.declared, Topic) else None

    @property
    def label(self) -> str:
        """The name in metrics: that of the endpoint or of the topic."""
        declared = self.declared
        return declared.topic.value if isinstance(declared, Topic) else declared.endpoint.value

    @property
    def span(self) -> SourceSpan:
        return self.declared.span

    @property
    def is_deferred(self) -> bool:
        """Whether its messages may be deferred and then sent by another thread: see `on_limit` and `bandwidth`."""
        may_wait = not self.is_request and self.reply is None
        has_bandwidth = self.endpoint is not None and self.endpoint.bandwidth is not None and may_wait
        return has_bandwidth or self.declared.on_limit is OnLimit.LATEST


@dataclass(frozen=True, slots=True)
class CheckedSubscription:
    """A topic that an outbound route subscribes to, with a target for each destination.

    `when` is the condition of the topic. `for_each` is a list: `when` and the targets are evaluated for each of its
    elements, with the variables `item`, `index` and `count`. `stamp` is the message's `header.stamp` (ns), if the route
    has a `ttl` and the type has a stamp.
    """

    topic: Topic
    type: MessageType
    when: Node | None
    for_each: Node | None
    stamp: Node | None
    targets: tuple[Target, ...]


@dataclass(frozen=True, slots=True)
class CheckedService:
    """A service whose payload cases and types exist.

    `ros_name` is absolute. `request` is the route of its requests. `match` are the names of the field that request and
    reply have in common, None without. `most` is as in ServicePlan. `responses` has the CDR bytes of `on_timeout` by
    outcome.
    """

    declared: Service
    ros_name: str
    request_type: MessageType
    response_type: MessageType
    request: CheckedRoute
    reply_case: PayloadCase
    match: tuple[str, ...] | None
    most: int
    responses: Mapping[str, bytes]

    @property
    def group(self) -> tuple[str, str]:
        """The payload case of the replies, and their sender."""
        return self.reply_case.name, (self.declared.reply.sender or self.declared.request.to).value


@dataclass(frozen=True, slots=True)
class CheckedCalled:
    """A service that an endpoint calls, whose payload cases and types exist. `kept` is as in CalledPlan."""

    declared: CalledService
    request_type: MessageType
    response_type: MessageType
    kept: int


@dataclass(frozen=True, slots=True)
class CheckedState:
    """A state, with the value that a message of `case` or `feed` gives it.

    Values are texts, or integers, also of bools and enums. `feed` is the topic of a state that has one, without
    targets.
    """

    declared: State
    value: Node
    initial: int | str
    case: PayloadCase | None = None
    feed: CheckedSubscription | None = None

    @property
    def kind(self) -> Kind:
        return self.value.kind

    @property
    def label(self) -> str:
        return state_label(self.declared.name)


@dataclass(frozen=True, slots=True)
class CheckedCollect:
    """How the datagrams of a frame are grouped, counted and ordered."""

    span: SourceSpan
    by: Node
    count: Node
    order: Node


@dataclass(frozen=True, slots=True)
class CheckedOrder:
    """The number of `order`, which wraps around after `bits` bits."""

    number: Node
    bits: int
    is_unsigned: bool


@dataclass(frozen=True, slots=True)
class CheckedRoute:
    """A route whose payload case exists. If there are errors, it is not compiled.

    A route from UDP has `targets`, a route from ROS has `subscriptions`.
    """

    route: Route
    case: PayloadCase
    targets: tuple[Target, ...] = ()
    subscriptions: tuple[CheckedSubscription, ...] = ()
    order: CheckedOrder | None = None
    collect: CheckedCollect | None = None
    deadman: DeadmanPlan | None = None

    @property
    def all_targets(self) -> Iterator[Target]:
        yield from self.targets
        for feed in self.subscriptions:
            yield from feed.targets

    @property
    def obeyed(self) -> ObeyedPlan | None:
        return self.deadman.obeyed if self.deadman else None
