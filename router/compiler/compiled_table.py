"""The compiled table, as plain data: its routes, the carrier's routines, and the sockets and topics to open."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING

from router.compiler.expressions.kinds import BoolKind, EnumKind, StringKind
from router.compiler.expressions.tree import STATE
from router.compiler.metrics import Counters
from router.declared import BesideEncoding, BesideValue
from router.errors import SourceSpan
from router.table.addresses import LinkPlace
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.gateways import Gateway, Inbound, InboundService
from router.types.board_limits import BoardLimits
from router.types.model import MessageType
from router.types.protobuf import PayloadCase
from router.types.table_envelopes import Envelopes

if TYPE_CHECKING:
    from router.compiler.checked import Target
    from router.compiler.expressions.kinds import Kind
    from router.compiler.expressions.tree import Node
    from router.compiler.lowering import Lowered
    from router.compiler.mapping import Row
    from router.compiler.plan import Record

STRANGER = None
"""The source of a datagram whose sender is not an endpoint of the table."""


def state_label(name: str) -> str:
    """Return the name of a state in expressions and the log, as the target of messages without a value, and as the
    route of messages of its topic."""
    return f"{STATE}.{name}"


_SERVICE = "service."


def service_label(name: str) -> str:
    """Return the name of a service as the route and topic of its requests, and as the target of its replies."""
    return f"{_SERVICE}{name}"


def is_service(label: str) -> bool:
    """Return whether a service has this name in place of a topic: names of topics have no dots."""
    return label.startswith(_SERVICE)


OUTCOMES: Mapping[str, str] = {
    "timed_out": "{endpoint} did not reply within {timeout}",
    "busy": "{endpoint} has not replied to an earlier call",
    "unsent": "{endpoint} cannot be sent to",
    "refused": "the request is too old, or {endpoint} cannot take its values",
    "cancelled": "the router has reloaded its table, or stops",
}
"""How a call ends without a reply, with the text of `reason` in `on_timeout`."""

CALL_FAILURES: Mapping[str, str] = {
    "timed_out": "{service} did not respond within {timeout}",
    "busy": "too many calls of {service} are open",
    "unsent": "there is no server of {service}",
    "cancelled": "the router has reloaded its table, or stops",
}
"""How a call that an endpoint makes ends without a response, with the text of `reason` in `on_timeout`."""

ANSWERED = "answered"
"""The outcome of a call with a reply."""

MOST_CALLS = (1 << 31) - 1
"""The largest number of a call: it fits each integer of protobuf."""


def source_label(source: str | None) -> str:
    """Return the `source` label of a sender: its name, or `unknown` for a stranger on a route from `any`."""
    return source if source is not None else "unknown"


@dataclass(frozen=True, slots=True)
class QosPlan:
    """A complete ROS QoS, with rclpy's names. Durations in ns; None is infinite."""

    reliability: str
    durability: str
    history: str
    depth: int
    deadline: int | None = None
    lifespan: int | None = None
    liveliness: str = "system_default"
    liveliness_lease_duration: int | None = None

    @property
    def serves_late_joiners(self) -> bool:
        """Whether late subscribers get the last messages, which must then be published even without subscribers."""
        return self.durability == "transient_local"


@dataclass(frozen=True, slots=True)
class TopicPlan:
    """A ROS publisher or subscription: `label` names it in metrics, `topic` is the name that ROS resolves.

    `definitions` determine the layout of its CDR bytes: the fields of the type and of each nested type, by type name,
    as rclpy spells them.
    """

    label: str
    topic: str
    type_name: str
    qos: QosPlan
    definitions: Mapping[str, tuple[tuple[str, str], ...]]


@dataclass(frozen=True, slots=True)
class ObeyedPlan:
    """What shows that a deadman's brake is obeyed: a message of `case` from each of `endpoints`, `within` ns.

    The message must meet the condition `when`, which is among the routines (`Lowered.obeyed`).
    """

    case: PayloadCase
    when: Node
    within: int
    endpoints: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Changing:
    """A field beside the payload that is filled when a message is sent: `struct beside_field`."""

    size: int
    encoding: BesideEncoding
    value: BesideValue
    bits: int = 64
    is_signed: bool = False
    unit: int = 1
    modulus: int = 0
    scale: float = 0.0
    offset: int = 0

    @property
    def members(self) -> tuple[int | float, ...]:
        """All values, in the order of the structure."""
        return (
            *(self.offset, self.size, int(self.encoding), int(self.value)),
            *(self.bits, int(self.is_signed), 0, self.unit, self.modulus, self.scale),
        )

    @property
    def zero(self) -> bytes:
        """The bytes of the field until it is filled."""
        is_padded = self.encoding in (BesideEncoding.VARINT, BesideEncoding.ZIGZAG)
        return b"\x80" * (self.size - 1) + b"\0" if is_padded else bytes(self.size)


@dataclass(frozen=True, slots=True)
class Beside:
    """What the router puts before the payload in its messages for an endpoint, and what is filled in that.

    `plan` has all fields beside the payload, `rows` describe them for `explain`.
    """

    data: bytes
    changing: tuple[Changing, ...]
    rows: tuple[Row, ...]
    plan: Record


@dataclass(frozen=True, slots=True)
class DeadmanPlan:
    """A route's deadman: the datagrams that are sent if no fresh command was sent for `timeout` (all times in ns).

    `datagrams` are by endpoint, in the order of sending. With `at_start`, they are also sent when the router starts.
    Endpoints in `following` get no commands from the route, and are armed and disarmed with the others. `disarmed_by`
    are names of routes, not the payload cases of the table. `watched` are the commands of the route: each source, with
    the payload case. `beside` is what `set` of an endpoint fills in these datagrams.
    """

    route: str
    timeout: int
    repeat: int
    datagrams: tuple[tuple[str, tuple[bytes, ...]], ...]
    at_start: bool = True
    following: frozenset[str] = frozenset()
    disarmed_by: tuple[str, ...] = field(default=(), compare=False)
    watched: frozenset[tuple[str, str]] = field(default=frozenset(), compare=False)
    obeyed: ObeyedPlan | None = None
    beside: Mapping[str, Beside] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StatePlan:
    """A state: a text, or an integer, also for a bool or an enum. `valid_for` is in ns, None for never.

    `setters` are the routes whose messages set it, each with the senders that do, or its label with its topic.
    `readers` are the routes with conditions that read it. `place` computes the value.
    """

    name: str
    kind: Kind
    initial: int | str
    valid_for: int | None
    setters: Mapping[str, Collection[str]]
    readers: Collection[str]
    place: str

    @property
    def label(self) -> str:
        return state_label(self.name)

    @property
    def type(self) -> str:
        """The type with all its values: a reload keeps the state as long as it stays the same."""
        values = self.kind.enum.values if isinstance(self.kind, EnumKind) else ()
        return " ".join([str(self.kind), *(f"{name}={number}" for name, number in values)])

    @property
    def is_text(self) -> bool:
        return isinstance(self.kind, StringKind)

    @property
    def values(self) -> Collection[str] | None:
        """All values as a table writes them; None for an integer or a text."""
        if isinstance(self.kind, EnumKind):
            return [name for name, _ in self.kind.enum.values]
        return ("true", "false") if isinstance(self.kind, BoolKind) else None

    def shown(self, value: int | str) -> str:
        """Return a value as a table writes it."""
        if isinstance(value, str):
            return repr(value)
        if isinstance(self.kind, EnumKind):
            return next((name for name, number in self.kind.enum.values if number == value), str(value))
        if isinstance(self.kind, BoolKind):
            return "true" if value else "false"
        return str(value)


@dataclass(frozen=True, slots=True)
class ServicePlan:
    """A ROS service that an endpoint answers. `timeout` is in ns, `responses` has CDR bytes by outcome (OUTCOMES).

    `ros_name` is absolute. `definitions` are those of request and response, as in TopicPlan. `match` are the names of
    the field that tells which call a reply answers, None if any reply does. `group` is the payload case of the replies
    with their sender: services with the same one get the same replies. After the number `most` of a call, 1 follows.
    """

    name: str
    ros_name: str
    type_name: str
    definitions: Mapping[str, tuple[tuple[str, str], ...]]
    endpoint: str
    match: tuple[str, ...] | None
    group: tuple[str, str]
    most: int
    timeout: int
    retries: int
    responses: Mapping[str, bytes]
    span: SourceSpan

    @property
    def label(self) -> str:
        return service_label(self.name)


@dataclass(frozen=True, slots=True)
class CalledPlan:
    """A ROS service that an endpoint calls. `timeout` is in ns, `reasons` has texts by outcome (CALL_FAILURES).

    `service` is the name of the service in ROS, as the table writes it. `kept` is the number of bytes before its
    request, which its reply gets. `failed` is the label of replies without a response.
    """

    name: str
    service: str
    type_name: str
    definitions: Mapping[str, tuple[tuple[str, str], ...]]
    kept: int
    timeout: int
    reasons: Mapping[str, str]
    span: SourceSpan

    @property
    def label(self) -> str:
        return service_label(self.name)

    @property
    def failed(self) -> str:
        return f"{self.label}.on_timeout"


@dataclass(frozen=True, slots=True)
class InboundPlan:
    """A topic that a gateway's clients may publish on; `label` is its absolute name, which clients use.

    The datagrams of its deadman are CDR bytes, with the topic in place of an endpoint.
    """

    settings: Inbound
    label: str
    type: MessageType
    deadman: DeadmanPlan | None

    @property
    def is_command(self) -> bool:
        """Whether messages of clients are commands: the topic has a deadman or a `ttl`."""
        return self.deadman is not None or self.settings.ttl is not None


@dataclass(frozen=True, slots=True)
class ClientCallPlan:
    """A ROS service that a gateway's clients may call; `label` is its absolute name, which clients use.

    `request` and `response` are the types of its two messages, `definitions` as in TopicPlan. Calls are counted under
    `name`, which has the gateway's name.
    """

    settings: InboundService
    name: str
    label: str
    request: MessageType
    response: MessageType
    definitions: Mapping[str, tuple[tuple[str, str], ...]]

    @property
    def service(self) -> str:
        """The name of the service as the table writes it, which ROS resolves and remaps."""
        return self.settings.service.value

    @property
    def type_name(self) -> str:
        return self.settings.type.value

    @property
    def span(self) -> SourceSpan:
        return self.settings.span


@dataclass(frozen=True, slots=True)
class GatewayPlan:
    """A gateway, with the topics that its clients may publish on, by absolute name, and likewise the services."""

    settings: Gateway
    inbound: Mapping[str, InboundPlan]
    calls: Mapping[str, ClientCallPlan]


@dataclass(frozen=True, slots=True)
class RoutePlan:
    """A route from UDP, or a route from ROS for one of its topics; or a topic that sets a state, without a case.

    `sources` are the endpoints that may send the message, possibly with STRANGER; a route from ROS has none. `ttl` and
    `collect_timeout` are in ns, or None.
    """

    route: str
    case: PayloadCase | None
    targets: tuple[Target, ...]
    sources: frozenset[str | None]
    topic: str | None = None
    ttl: int | None = None
    collect_timeout: int | None = None


@dataclass(frozen=True, slots=True)
class CompiledTable:
    """A compiled table. `senders` are all endpoints that are sent to, `lowered` has the routines of the carrier.

    `inbound` has the routes by payload case; several routes of a case differ in their sources. `outbound` has the
    routes by topic. `ignored` has the ignored cases, also of types that no route can take, `boards` the limits of each
    board by name. `named` is the table with the host names that this one has replaced by addresses, or None.
    """

    table: RouteTable
    envelopes: Envelopes
    counters: Counters
    senders: tuple[Endpoint, ...]
    publishers: tuple[TopicPlan, ...]
    subscriptions: tuple[TopicPlan, ...]
    inbound: Mapping[str, tuple[RoutePlan, ...]]
    outbound: Mapping[str, tuple[RoutePlan, ...]]
    deadmen: tuple[DeadmanPlan, ...]
    ignored: frozenset[str]
    lowered: Lowered
    boards: Mapping[str, BoardLimits]
    gateways: tuple[GatewayPlan, ...] = ()
    states: tuple[StatePlan, ...] = ()
    services: tuple[ServicePlan, ...] = ()
    called: tuple[CalledPlan, ...] = ()
    named: CompiledTable | None = None

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """All listeners, first those that are sockets."""
        return (*self.table.sockets, *self.table.links)

    @property
    def links(self) -> tuple[tuple[Listener, Endpoint], ...]:
        """The endpoints at the other ends of serial lines and TCP connections, with their listeners."""
        endpoints = self.table.endpoints.values()
        ends = [(each, each.listener.value) for each in endpoints if each.listener is not None]
        return tuple((link, each) for link in self.table.links for each, name in ends if name == link.name)

    @property
    def udp_senders(self) -> tuple[Endpoint, ...]:
        """The endpoints that datagrams are sent to."""
        return tuple(each for each in self.senders if not isinstance(each.address.value, LinkPlace))

    @property
    def routes(self) -> Iterator[RoutePlan]:
        return chain.from_iterable((*self.inbound.values(), *self.outbound.values()))

    @property
    def uses_ros(self) -> bool:
        """Whether it needs a ROS node."""
        return bool(self.publishers or self.subscriptions or self.gateways or self.service_names)

    @property
    def service_names(self) -> list[str]:
        """The services that endpoints answer or call."""
        return [*(plan.name for plan in self.services), *(plan.name for plan in self.called)]

    @property
    def client_calls(self) -> list[ClientCallPlan]:
        """The services that clients of all gateways may call."""
        return [plan for gateway in self.gateways for plan in gateway.calls.values()]

    @property
    def request_labels(self) -> list[str]:
        """What stands for services as the source of messages."""
        return [*map(service_label, self.service_names), *(plan.failed for plan in self.called)]

    @property
    def client_deadmen(self) -> list[DeadmanPlan]:
        """The deadmen of topics that clients of gateways may publish on."""
        return [plan.deadman for gateway in self.gateways for plan in gateway.inbound.values() if plan.deadman]

    @property
    def protos_sha256(self) -> str:
        return self.envelopes.sha256
