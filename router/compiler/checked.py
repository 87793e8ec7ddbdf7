"""Routes and gateways after their checks: plain data from which code is generated and `explain` prints."""

from __future__ import annotations

from dataclasses import dataclass

from router.compiler.expressions import Reads, Typed
from router.compiler.mapping import Row
from router.compiler.plan import Record
from router.errors import SourceSpan
from router.table.model import Gateway, Inbound, Keep, Priority, Route, Topic
from router.types.model import MessageType
from router.types.protobuf import PayloadCase


@dataclass(frozen=True, slots=True)
class Target:
    """A destination or a topic. `name` is its label in the counters. Without a `plan` the datagram is forwarded.

    `reads` makes the variables of its expressions; None where they are made once for all targets of the route.
    `deadmen` are the routes whose deadmen hear of each command to it.
    """

    name: str
    span: SourceSpan
    is_topic: bool
    reads: Reads | None
    when: Typed | None = None
    max_rate: float | None = None
    keep: Keep = Keep.FIRST
    priority: Priority = Priority.TELEMETRY
    has_budget: bool = False
    trim: bool = False
    plan: Record | None = None
    deadmen: tuple[str, ...] = ()

    @property
    def is_deferred(self) -> bool:
        """Whether it may be served later, and by another thread."""
        return self.has_budget or self.keep is Keep.LATEST


@dataclass(frozen=True, slots=True)
class CheckedTarget:
    """A target with what its mapping came to, for `explain`.

    `topic` and `type` are those of a ROS topic that is published. `rows` are empty for unchanged forwarding.
    """

    target: Target
    topic: Topic | None = None
    type: MessageType | None = None
    rows: tuple[Row, ...] = ()


@dataclass(frozen=True, slots=True)
class CheckedFeed:
    """A topic that an outbound route is fed from, with a target for each destination.

    `reads` serves all expressions in it. `when` is the topic's own. With `for_each`, a list, `when` and the
    targets are evaluated for each element: `item` and `index` of `count`. `stamp` is the message's `header.stamp`
    (ns) where the route has a `ttl` and the type has the stamp.
    """

    topic: Topic
    type: MessageType
    reads: Reads
    when: Typed | None
    for_each: Typed | None
    stamp: Typed | None
    targets: tuple[CheckedTarget, ...]


@dataclass(frozen=True, slots=True)
class CheckedCollect:
    """The three numbers of a datagram that is part of a frame. `reads` serves them, and nothing else."""

    span: SourceSpan
    reads: Reads
    by: Typed
    count: Typed
    order: Typed


@dataclass(frozen=True, slots=True)
class CheckedDeadman:
    """What is sent when commands stop coming: the envelope, with its zeros, of a `case`.

    `to` are endpoint names, `timeout` and `repeat` in ns. `hands_over_to` are routes, not the cases of the table.
    `at_start` as in the table's Deadman.
    """

    timeout: int
    repeat: int
    case: PayloadCase
    datagram: bytes
    to: tuple[str, ...]
    hands_over_to: tuple[str, ...]
    at_start: bool


@dataclass(frozen=True, slots=True)
class CheckedRoute:
    """A route whose names all exist. Findings that it has beside that keep it out of a program.

    `targets` are those of a route from UDP, `feeds` those topics that a route from ROS is fed from.
    """

    route: Route
    case: PayloadCase
    targets: tuple[CheckedTarget, ...] = ()
    feeds: tuple[CheckedFeed, ...] = ()
    collect: CheckedCollect | None = None
    deadman: CheckedDeadman | None = None


@dataclass(frozen=True, slots=True)
class CheckedInbound:
    """A topic that clients may publish on, with its absolute name. `stop` are the CDR bytes that its deadman sends."""

    inbound: Inbound
    topic: str
    type: MessageType
    stop: bytes | None


@dataclass(frozen=True, slots=True)
class CheckedGateway:
    """A gateway, with those of its inbound topics whose types exist."""

    settings: Gateway
    inbound: tuple[CheckedInbound, ...]
