"""The route table as typed, frozen data. Every value that a finding may blame keeps its span.

Knows shapes and places only: whether a payload case, a field or a ROS type exists is the compiler's
business.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from router.errors import SourceSpan
from router.table.places import TextPlace

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Located(Generic[T]):
    """A value and the place in the table that it was read from."""

    value: T
    span: SourceSpan


class Address(NamedTuple):
    """An IPv4 address and a UDP (for metrics: TCP) port."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def bound_to(address: Address, interface: str | None) -> str:
    """Return what a local socket is bound to as text: `0.0.0.0:5000`, or `0.0.0.0:5000 on wlan0`."""
    return f"{address} on {interface}" if interface else str(address)


@dataclass(frozen=True, slots=True)
class Networks:
    """In which all addresses of the table lie. `span` is the key `networks`."""

    span: SourceSpan
    members: tuple[IPv4Network, ...]

    def __str__(self) -> str:
        """As findings name them, with the place that says so."""
        return f"the networks of {self.span.file}:{self.span.line} ({', '.join(map(str, self.members))})"


class Framing(enum.Enum):
    EXACT = "exact"
    ZERO_TRIMMED = "zero_trimmed"


class EndpointKind(enum.Enum):
    BOARD = "board"
    BASESTATION = "basestation"
    TOOL = "tool"


class Priority(enum.Enum):
    """Who goes first when an endpoint's budget is short; in this order."""

    COMMAND = "command"
    TELEMETRY = "telemetry"
    BULK = "bulk"


class Keep(enum.Enum):
    """Which of the messages that `max_rate` holds back is sent after all: none, or the latest as soon as it may."""

    FIRST = "first"
    LATEST = "latest"


ENVELOPE, ONEOF = "PBEnvelope", "payload"
"""The envelope's names where there is no table to say them."""


@dataclass(frozen=True, slots=True)
class EnvelopeSettings:
    """`protos` is an absolute path, the router's own unless the table has one; `message` and `oneof` name the envelope.

    `lock` is the absolute path of the lock file, None where it is beside the protos.
    """

    protos: Located[Path]
    message: Located[str]
    oneof: Located[str]
    lock: Located[Path] | None = None


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """`diagnostics` is where the table asks for /diagnostics, None where it does not; `span` is the key `node`."""

    name: str
    namespace: str
    diagnostics: SourceSpan | None = None
    span: SourceSpan | None = None


@dataclass(frozen=True, slots=True)
class Listener:
    """`span` is the listener's name in the table. `receive_buffer` is in bytes, `coalesce` in ns.

    With an `interface`, only what comes in by that network interface is received.
    """

    name: str
    span: SourceSpan
    address: Located[Address]
    framing: Framing
    receive_buffer: int
    coalesce: int
    interface: Located[str] | None = None

    @property
    def bound_to(self) -> str:
        return bound_to(self.address.value, self.interface.value if self.interface else None)


DEFAULT_STALE_AFTER = 5_000_000_000
"""ns."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """`span` is the endpoint's name in the table. `budget` is in bytes per second, None for no limit.

    Silent for longer than `stale_after` (ns) it is stale; None means that it never is. With a `listener`, only what
    that one receives can be from it.
    """

    name: str
    span: SourceSpan
    address: Located[Address]
    kind: EndpointKind
    source_port: Located[int] | None
    trim_trailing_zeros: bool
    budget: Located[int] | None = None
    stale_after: int | None = DEFAULT_STALE_AFTER
    listener: Located[str] | None = None


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Which datagrams are kept, and where. `span` is the key `record`; `directory` is an absolute path.

    `last` and `max_age` in ns, sizes in bytes.
    """

    span: SourceSpan
    directory: Path
    continuous: bool
    last: int | None
    max_size: int
    max_age: int
    keep: int


@dataclass(frozen=True, slots=True)
class Expression:
    """The text of an expression, not yet parsed.

    `place` tells where each character of it stands. A YAML sequence becomes `items`, with empty text.
    """

    text: str
    place: TextPlace
    items: tuple[Expression, ...] | None = None

    @property
    def span(self) -> SourceSpan:
        return self.place.whole


@dataclass(frozen=True, slots=True)
class FieldEntry:
    """`linear_acceleration: {x: accel_x}` is path ("linear_acceleration", "x"); dotted keys are split.

    `path_spans` has the place of each part of the path.
    """

    path: tuple[str, ...]
    path_spans: tuple[SourceSpan, ...]
    value: Expression


@dataclass(frozen=True, slots=True)
class FieldMap:
    """What `fields:` says. `fields: auto`, or `auto: true` among the entries, sets `auto`.

    Entries win over what auto would do with the same field.
    """

    span: SourceSpan
    auto: bool
    entries: tuple[FieldEntry, ...]


@dataclass(frozen=True, slots=True)
class Qos:
    """rclpy's names; durations in nanoseconds. None where the table says nothing."""

    span: SourceSpan
    profile: Located[str] | None = None
    reliability: Located[str] | None = None
    durability: Located[str] | None = None
    history: Located[str] | None = None
    depth: Located[int] | None = None
    deadline: Located[int] | None = None
    lifespan: Located[int] | None = None
    liveliness: Located[str] | None = None
    liveliness_lease_duration: Located[int] | None = None


@dataclass(frozen=True, slots=True)
class Destination:
    """A destination endpoint of a route. `max_rate` is in Hz; `keep` stands beside it only."""

    endpoint: Located[str]
    span: SourceSpan
    when: Expression | None = None
    max_rate: Located[float] | None = None
    keep: Located[Keep] | None = None
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class Topic:
    """A ROS topic of a route: published for a UDP source, subscribed to for `source: ros`."""

    topic: Located[str]
    type: Located[str]
    span: SourceSpan
    queue_depth: Located[int] | None = None
    qos: Qos | None = None
    when: Expression | None = None
    max_rate: Located[float] | None = None
    keep: Located[Keep] | None = None
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class Deadman:
    """What is sent in place of commands that stopped coming: the payload `case` with `fields`, to `to`.

    `span` is the key `deadman`. Durations in ns. `hands_over_to` are payload cases. `at_start` says whether it is sent
    when the router starts as well.
    """

    span: SourceSpan
    timeout: Located[int]
    case: Located[str]
    fields: FieldMap
    to: tuple[Located[str], ...]
    repeat: Located[int]
    hands_over_to: tuple[Located[str], ...] = ()
    at_start: bool = True


@dataclass(frozen=True, slots=True)
class Collect:
    """How the datagrams of one frame are found and put in order. `span` is the key `collect`; `timeout` in ns."""

    span: SourceSpan
    by: Expression
    count: Expression
    order: Expression
    timeout: Located[int]


ANY = "any"
ROS = "ros"


@dataclass(frozen=True, slots=True)
class Route:
    """What happens to one payload case, or to that part of it that comes from certain sources.

    `span` is the payload case in the table, of a route in a list its first key.
    `name` tells the routes of a table apart, in metrics and log: the payload case, or where a case has
    several routes `imu_info_from_ros`. `ignore` holds the reason of a case that goes nowhere. `sources` are endpoint
    names, or just `any`, or just `ros`. `fields` and `for_each` belong to `source: ros`, `collect` to others.
    `ttl` in ns. `no_deadman` is the reason why a command route has none.
    """

    name: str
    span: SourceSpan
    case: Located[str]
    sources: tuple[Located[str], ...]
    destinations: tuple[Destination, ...]
    topics: tuple[Topic, ...]
    fields: FieldMap | None = None
    ignore: Located[str] | None = None
    ttl: Located[int] | None = None
    deadman: Deadman | None = None
    no_deadman: Located[str] | None = None
    for_each: Expression | None = None
    collect: Collect | None = None
    priority: Located[Priority] | None = None

    @property
    def is_outbound(self) -> bool:
        return any(source.value == ROS for source in self.sources)

    @property
    def endpoint_names(self) -> tuple[str, ...]:
        """What it names as sources and destinations, `any` and `ros` among them."""
        return (
            *(source.value for source in self.sources),
            *(destination.endpoint.value for destination in self.destinations),
        )


class Transport(enum.Enum):
    """How a gateway reaches its clients."""

    UDP = "udp"
    TCP = "tcp"
    WEBSOCKET = "websocket"
    ZENOH = "zenoh"


class GatewayFormat(enum.Enum):
    """What a gateway's clients read: packets with a binary header, or JSON documents."""

    GATEWAY_V1 = "gateway_v1"
    GATEWAY_V2 = "gateway_v2"
    JSON = "json"
    JSON_LINES = "json_lines"


@dataclass(frozen=True, slots=True)
class TopicPattern:
    """A glob over absolute topic names, or a regular expression for the whole of them."""

    text: str
    is_regex: bool
    span: SourceSpan


EACH = 0
"""The period of a gateway that sends every message."""


@dataclass(frozen=True, slots=True)
class TopicRate:
    """How often topics that `pattern` matches are sent: a period in ns, or EACH."""

    pattern: TopicPattern
    period: int


@dataclass(frozen=True, slots=True)
class ZenohConfig:
    """What the Zenoh library is configured with: the file at `path`, or a mapping in the table (`path` None).

    `text` is the content of the file, or the mapping as JSON. It may hold passwords: never print it. `places` are
    those of the keys and list items of the mapping, by path.
    """

    span: SourceSpan
    text: str = field(repr=False)
    path: Path | None = None
    places: Mapping[tuple[str | int, ...], SourceSpan] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """Where a gateway meets its Zenoh network. `key` is what its key expressions begin with; locators as Zenoh has
    them, `tcp/192.168.0.10:7447`. `mode` is peer, client or router.
    """

    key: Located[str]
    mode: str = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: ZenohConfig | None = None


@dataclass(frozen=True, slots=True)
class InboundDeadman:
    """What is published in place of a client's messages that stopped coming, and at the start if `at_start` says so.

    `span` is the key `deadman`. Durations in ns.
    """

    span: SourceSpan
    timeout: Located[int]
    fields: FieldMap
    repeat: Located[int]
    at_start: bool = True


@dataclass(frozen=True, slots=True)
class Inbound:
    """A topic that a gateway's clients may publish on. `max_rate` in Hz, `ttl` in ns."""

    topic: Topic
    span: SourceSpan
    ttl: Located[int] | None = None
    max_rate: Located[float] | None = None
    deadman: InboundDeadman | None = None


@dataclass(frozen=True, slots=True)
class Gateway:
    """ROS topics for clients that speak neither ROS nor protobuf, and back. `span` is its name in the table.

    `address` is where clients are (udp) or are waited for (tcp, websocket); None for Zenoh. `receive` is the local
    address of a udp gateway. Periods in ns, sizes in bytes. `compression` is a zstd level, 0 for none. `rates` are
    asked in order; what none matches has `publish_period`.
    """

    name: str
    span: SourceSpan
    transport: Located[Transport]
    address: Located[Address] | None
    zenoh: ZenohSettings | None
    receive: Located[Address] | None
    format: GatewayFormat
    include: tuple[TopicPattern, ...]
    exclude: tuple[TopicPattern, ...]
    publish_period: int
    schema_period: int
    discovery_period: int
    compression: int
    rates: tuple[TopicRate, ...]
    max_datagram: int
    max_message: int
    max_clients: int
    max_clients_per_host: int
    inbound: tuple[Inbound, ...]


@dataclass(frozen=True, slots=True)
class IgnoredGateway:
    """A name that another table has a gateway under, and why there is none here. `span` is the name."""

    name: str
    span: SourceSpan
    reason: str


@dataclass(frozen=True, slots=True)
class RouteTable:
    """One table after `extends` and variables. `files` are all files read, the table itself first.

    `routes_span` is the place of the key `routes`. A table of gateways has none, and need not have an envelope.
    `sha256` is over the bytes of `files` in order.
    `broken` names what the table has but is left out here because of findings of its own, as
    `endpoints/arm_board`, so that nobody reports its absence as well. Of a route in it, `routes/imu_info`,
    there may be the sound part: what is missing there is no finding.
    """

    path: Path
    files: tuple[Path, ...]
    sha256: str
    envelope: EnvelopeSettings | None
    node: NodeSettings
    metrics: Located[Address] | None
    listeners: Mapping[str, Listener]
    endpoints: Mapping[str, Endpoint]
    routes: tuple[Route, ...]
    routes_span: SourceSpan | None
    gateways: Mapping[str, Gateway] = field(default_factory=dict)
    ignored_gateways: Mapping[str, IgnoredGateway] = field(default_factory=dict)
    broken: frozenset[str] = frozenset()
    record: RecordSettings | None = None
    foxglove: Located[Address] | None = None
    reload_on_change: bool = False
    networks: Networks | None = None
