"""The route table as typed, frozen data. Every value that a finding can point at keeps its span.

The fields declare the keys of the table (see `keys`). The compiler checks whether payload cases, fields and ROS types
exist.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from pathlib import Path
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.addresses import LOCAL, REMOTE, Address
from router.table.keys import Named, Words
from router.table.nodes import TextPlace
from router.table.units import (
    DATA_RATE,
    DATAGRAM_SIZE,
    DISK_SIZE,
    DURATION,
    INTERVAL,
    MESSAGE_SIZE,
    PATIENCE,
    PERIOD,
    RATE,
    SIZE,
    TOPIC_RATE,
    Quantity,
)


def bound_to(address: Address, interface: str | None) -> str:
    """Return the local address of a socket as text: `0.0.0.0:5000`, or `0.0.0.0:5000 on wlan0`."""
    return f"{address} on {interface}" if interface else str(address)


@dataclass(frozen=True, slots=True)
class Networks:
    """The networks that contain every address of the table. `span` is the key `networks`."""

    span: SourceSpan
    members: tuple[IPv4Network, ...]

    def __str__(self) -> str:
        """Return the text for findings, with the position of the key."""
        return f"the networks of {self.span.file}:{self.span.line} ({', '.join(map(str, self.members))})"


class Framing(enum.Enum):
    EXACT = "exact"
    ZERO_TRIMMED = "zero_trimmed"


class EndpointKind(enum.Enum):
    BOARD = "board"
    BASESTATION = "basestation"
    TOOL = "tool"


class Priority(enum.Enum):
    """The order of targets when an endpoint's bandwidth is insufficient."""

    COMMAND = "command"
    TELEMETRY = "telemetry"
    BULK = "bulk"


class OnLimit(enum.Enum):
    """What happens to messages beyond `max_rate`: all are dropped, or the latest is kept and sent later."""

    FIRST = "first"
    LATEST = "latest"


@dataclass(frozen=True, slots=True)
class EnvelopeSettings:
    """The envelope: `message` and `oneof`, declared in `protos`, an absolute path (by default the router's own protos).

    `lock` is the absolute path of the lock file, None if it is beside the protos. `exclude` are files and folders
    relative to `protos`. `because` is the reason why other fields of the message may be empty.
    """

    protos: Located[Path]
    message: Located[str]
    oneof: Located[str]
    lock: Located[Path] | None = None
    exclude: tuple[Located[str], ...] = ()
    because: str | None = None


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """The ROS node; `span` is the key `node`. `diagnostics` is the span of the key for /diagnostics, None if off."""

    name: str = "rover_router"
    namespace: str = "/"
    diagnostics: SourceSpan | None = None
    span: SourceSpan | None = None


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """A server of the router, for clients from `networks` or from anywhere. `span` is its key in the table."""

    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    networks: Annotated[tuple[IPv4Network, ...], Named("from")] = ()


@dataclass(frozen=True, slots=True)
class Listener:
    """A listener; `span` is its name in the table. `receive_buffer` is in bytes.

    With an `interface`, only datagrams that arrive on that network interface are received.
    """

    name: str
    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    framing: Framing = Framing.ZERO_TRIMMED
    receive_buffer: Annotated[int, SIZE] = 4 << 20
    interface: str | None = None

    @property
    def bound_to(self) -> str:
        return bound_to(self.address.value, self.interface)


EPHEMERAL = "ephemeral"
"""The value of `send_from` for a source port chosen by the kernel, instead of a listener's port."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An endpoint; `span` is its name in the table. `bandwidth` is in bytes per second, None for no limit.

    An endpoint that is silent for longer than `stale_after` (ns) is stale; None means never. With a `listener`, only
    datagrams that this listener receives are attributed to it. `send_from` is a listener's name, EPHEMERAL, or None if
    it is not set. With `allow_non_finite`, a board also receives NaN and infinities.
    """

    name: str
    span: SourceSpan
    address: Annotated[Located[Address], REMOTE]
    kind: EndpointKind
    source_port: Located[int] | None = None
    trim_trailing_zeros: bool = False
    allow_non_finite: bool = False
    bandwidth: Annotated[int | None, DATA_RATE] = None
    stale_after: Annotated[int | None, PATIENCE] = 5_000_000_000
    listener: Located[str] | None = None
    send_from: Located[str] | None = None


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Which datagrams are recorded, and where. `span` is the key `record`; `directory` is an absolute path.

    `last` and `max_age` are in ns, sizes in bytes.
    """

    span: SourceSpan
    directory: Path
    continuous: bool = True
    last: Annotated[int | None, DURATION] = None
    max_size: Annotated[int, DISK_SIZE, Named("rotate_after.size")] = 256 << 20
    max_age: Annotated[int, DURATION, Named("rotate_after.age")] = 600_000_000_000
    retention: Annotated[int, DISK_SIZE] = 4 << 30


HOW_TO_KEEP = (
    "add `last: 60s` to the table's 'record', or `record: {directory: ../recordings, last: 60s, continuous: false}`, "
    "and restart the router"
)
"""What to do if a router keeps no datagrams to save."""


@dataclass(frozen=True, slots=True)
class Expression:
    """The text of an expression, not yet parsed.

    `place` has the position of each character. A YAML sequence becomes `items`, a mapping with the key `map` becomes
    `choices`; both have empty text. `literal` text, `{text: imu_link}`, is not an expression.
    """

    text: str
    place: TextPlace
    items: tuple[Expression, ...] | None = None
    choices: Choices | None = None
    literal: bool = False

    @property
    def span(self) -> SourceSpan:
        return self.place.whole

    def __str__(self) -> str:
        if self.choices is not None:
            return str(self.choices)
        if self.literal:
            return repr(self.text)
        return self.text if self.items is None else f"[{', '.join(map(str, self.items))}]"


@dataclass(frozen=True, slots=True)
class Choices:
    """`{map: fix_quality, GPS_FIX: 1, else: 0}`: the value of `subject` selects one of `values` by name."""

    subject: Expression
    values: tuple[tuple[Located[str], Expression], ...]
    otherwise: Expression | None

    def __str__(self) -> str:
        parts = [f"map: {self.subject}", *(f"{name.value}: {value}" for name, value in self.values)]
        parts += [f"else: {self.otherwise}"] if self.otherwise is not None else []
        return f"{{{', '.join(parts)}}}"


@dataclass(frozen=True, slots=True)
class FieldEntry:
    """`linear_acceleration: {x: accel_x}` has the path ("linear_acceleration", "x"); dotted keys are split.

    `path_spans` has the span of each part of the path.
    """

    path: tuple[str, ...]
    path_spans: tuple[SourceSpan, ...]
    value: Expression


@dataclass(frozen=True, slots=True)
class FieldMap:
    """The value of `fields`. `fields: auto`, or `auto: true` among the entries, sets `auto`.

    Entries take precedence over `auto`.
    """

    span: SourceSpan
    auto: bool
    entries: tuple[FieldEntry, ...]

    def __str__(self) -> str:
        """Return the text of a table: `{brake: true}`."""
        entries = ["auto"] if self.auto else []
        entries += [f"{'.'.join(entry.path)}: {entry.value}" for entry in self.entries]
        return f"{{{', '.join(entries)}}}"


@dataclass(frozen=True, slots=True)
class Qos:
    """QoS settings under rclpy's names; durations in nanoseconds. None means not set."""

    span: SourceSpan
    profile: Located[str] | None = None
    reliability: Located[str] | None = None
    durability: Located[str] | None = None
    history: Located[str] | None = None
    depth: Located[int] | None = None
    deadline: Annotated[Located[int] | None, DURATION] = None
    lifespan: Annotated[Located[int] | None, DURATION] = None
    liveliness: Located[str] | None = None
    liveliness_lease_duration: Annotated[Located[int] | None, DURATION] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetKeys:
    """Common keys of destinations and topics. `max_rate` is in Hz."""

    when: Annotated[Expression | None, Words("when {}")] = None
    max_rate: Annotated[float | None, RATE, Words("at most {}")] = None
    on_limit: Annotated[OnLimit, Words("keeping the {}", beside="max_rate")] = OnLimit.FIRST


@dataclass(frozen=True, slots=True)
class Destination(TargetKeys):
    """A destination of a route. `fields` is for routes from topics."""

    endpoint: Located[str]
    span: SourceSpan
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class Topic(TargetKeys):
    """A ROS topic of a route, as a target or as a source.

    The `type` of a route's topic may be missing in a table, but not in a checked one (see `compiler.check`).
    """

    topic: Located[str]
    span: SourceSpan
    type: Located[str] | None = None
    queue_depth: Located[int] | None = None
    qos: Qos | None = None
    fields: FieldMap | None = None

    @property
    def type_name(self) -> str:
        return self.type.value if self.type else ""


AT_START = Quantity(parse=lambda word: word == "send", show=lambda sends: "send" if sends else "silent")
DEFAULT_REPEAT = Located(100_000_000, SourceSpan("the default"))
"""Default interval between the datagrams of a deadman, in ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadmanKeys:
    """Common keys of the deadmen of routes and gateways. Durations are in ns.

    `because` justifies settings that look like a mistake.
    """

    timeout: Annotated[Located[int], DURATION]
    repeat: Annotated[Located[int], DURATION] = DEFAULT_REPEAT
    at_start: Annotated[bool, AT_START] = True
    because: str | None = None


@dataclass(frozen=True, slots=True)
class Obeyed:
    """What shows that the rover has stopped: a message of `case`, from each board, that meets the condition `when`.

    `span` is the key `obeyed`. `within` (ns) is the longest time from the first brake to that message.
    """

    span: SourceSpan
    case: Located[str]
    when: Expression
    within: Annotated[Located[int], DURATION]


@dataclass(frozen=True, slots=True)
class Payload:
    """A payload of constants: a payload `case` with `fields`."""

    case: Located[str]
    fields: FieldMap

    def __str__(self) -> str:
        return f"{self.case.value} {self.fields}" if self.fields.entries else self.case.value


@dataclass(frozen=True, slots=True)
class Deadman(DeadmanKeys):
    """What is sent when commands stop: each of `payloads` in this order, to the endpoints `to`.

    `span` is the key `deadman`. `disarmed_by` are payload cases or names of routes, None if not set. With `at_start`,
    the payloads are also sent when the router starts.
    """

    span: SourceSpan
    payloads: Annotated[tuple[Payload, ...], Named("send")]
    to: tuple[Located[str], ...]
    disarmed_by: tuple[Located[str], ...] | None = None
    obeyed: Obeyed | None = None


@dataclass(frozen=True, slots=True)
class Collect:
    """How datagrams are grouped into frames and ordered. `span` is the key `collect`; `timeout` is in ns."""

    span: SourceSpan
    by: Expression
    count: Expression
    order: Expression
    timeout: Annotated[Located[int], DURATION]


ANY = "any"
ROS = "ros"
"""The source of messages from topics, as metrics name it."""


@dataclass(frozen=True, slots=True)
class Route:
    """What happens to one payload case, or to its messages from certain sources.

    `span` is the payload case in the table, or the first key of a route in a list. `name` is unique, for metrics and
    log: the payload case, or, for one of several routes of a case, a name such as `imu_info_from_ros`. `ignore` is the
    reason for ignoring the case. Messages come from `sources`, which are names of endpoints or only `any`, or from
    `source_topics`. `topics` (published) and `collect` are for the former, `fields` and `for_each` for the latter.
    `ttl` is in ns. `no_ttl` is the reason why messages of any age may leave, `no_deadman` why a route with commands has
    no deadman.
    """

    name: str
    span: SourceSpan
    case: Located[str]
    sources: Annotated[tuple[Located[str], ...], Named("source")] = ()
    source_topics: Annotated[tuple[Topic, ...], Named("source")] = ()
    destinations: tuple[Destination, ...] = ()
    topics: tuple[Topic, ...] = ()
    fields: FieldMap | None = None
    ignore: str | None = None
    ttl: Annotated[Located[int] | None, DURATION, Words("dropped when older than {}")] = None
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None
    deadman: Deadman | None = None
    no_deadman: str | None = None
    for_each: Expression | None = None
    collect: Collect | None = None
    priority: Priority | None = None

    @property
    def is_outbound(self) -> bool:
        """Whether the messages come from ROS."""
        return bool(self.source_topics)

    @property
    def all_topics(self) -> tuple[Topic, ...]:
        """All topics of the route, targets and sources."""
        return (*self.topics, *self.source_topics)


class Transport(enum.Enum):
    """How a gateway reaches its clients."""

    UDP = "udp"
    TCP = "tcp"
    WEBSOCKET = "websocket"
    ZENOH = "zenoh"


class GatewayFormat(enum.Enum):
    """The format that a gateway's clients read: packets with a binary header, or JSON documents."""

    GATEWAY_V1 = "gateway_v1"
    GATEWAY_V2 = "gateway_v2"
    JSON = "json"
    JSON_LINES = "json_lines"


@dataclass(frozen=True, slots=True)
class TopicPattern:
    """A glob, or a regular expression, that matches whole absolute topic names."""

    text: str
    is_regex: bool
    span: SourceSpan

    def __str__(self) -> str:
        return f"{{regex: {self.text}}}" if self.is_regex else self.text


EACH = 0
"""The period of a gateway that sends every message."""

MAX_OUTBOUND, MAX_INBOUND = 16 << 20, 64 << 10
"""Maximum bytes of a message to and from clients of a gateway without `max_message`."""

MOST_INBOUND = 1 << 20
"""Maximum bytes of a message from clients, whatever `max_message` is: it is read in one go."""


@dataclass(frozen=True, slots=True)
class TopicRate:
    """The period (ns, or EACH) at which topics that match `pattern` are sent."""

    pattern: TopicPattern
    period: int

    def __str__(self) -> str:
        return f"{self.pattern}: {TOPIC_RATE.show(self.period)}"


@dataclass(frozen=True, slots=True)
class ZenohConfig:
    """Configuration of the Zenoh library: the file at `path`, or a mapping in the table (`path` None).

    `text` is the content of the file, or the mapping as JSON. It may contain passwords: never print it. `places` are
    the spans of the mapping's keys and list items, by path.
    """

    span: SourceSpan
    text: str = field(repr=False)
    path: Path | None = None
    places: Mapping[tuple[str | int, ...], SourceSpan] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """How a gateway connects to its Zenoh network.

    `key` is the prefix of its key expressions; `connect` and `listen` are Zenoh locators, `tcp/192.168.0.10:7447`.
    `mode` is peer, client or router.
    """

    key: Located[str]
    mode: str = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: ZenohConfig | None = None


@dataclass(frozen=True, slots=True)
class InboundDeadman(DeadmanKeys):
    """What is published when a client's messages stop, and with `at_start` when the router starts.

    `span` is the key `deadman`.
    """

    span: SourceSpan
    fields: Annotated[FieldMap, Named("send")]


@dataclass(frozen=True, slots=True)
class Inbound:
    """A topic that a gateway's clients may publish on. `ttl` and `no_ttl` are as in a route, `max_lead` is in ns."""

    topic: Topic
    span: SourceSpan
    ttl: Annotated[Located[int] | None, DURATION, Words("dropped when older than {}")] = None
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None
    max_lead: Annotated[int, DURATION] = 2_000_000_000
    deadman: InboundDeadman | None = None


@dataclass(frozen=True, slots=True)
class Gateway:
    """ROS topics for clients that speak neither ROS nor protobuf, and back. `span` is its name in the table.

    `address` is the clients' address (udp) or the one to listen on (tcp, websocket); None for Zenoh. `receive` is the
    local address of a udp gateway. Periods are in ns, sizes in bytes. `compression` is a zstd level, 0 for none. The
    first of `rates` that matches a topic applies, else `publish_period`. Clients connect from `networks`, or from
    anywhere.
    """

    name: str
    span: SourceSpan
    transport: Located[Transport]
    address: Located[Address] | None
    zenoh: ZenohSettings | None
    format: GatewayFormat
    receive: Annotated[Located[Address] | None, LOCAL] = None
    include: Annotated[tuple[TopicPattern, ...], Named("topics.include")] = ()
    exclude: Annotated[tuple[TopicPattern, ...], Named("topics.exclude")] = ()
    publish_period: Annotated[int, PERIOD] = 500_000_000
    schema_period: Annotated[int, INTERVAL] = 5_000_000_000
    discovery_period: Annotated[int, INTERVAL] = 5_000_000_000
    compression: Annotated[int, Named("compression.zstd")] = 0
    rates: tuple[TopicRate, ...] = ()
    max_datagram: Annotated[int, DATAGRAM_SIZE] = 1400
    max_message: Annotated[int | None, MESSAGE_SIZE] = None
    max_topics: int = 500
    max_clients: int = 1024
    max_clients_per_host: int = 16
    networks: Annotated[tuple[IPv4Network, ...], Named("from")] = ()
    inbound: tuple[Inbound, ...] = ()

    @property
    def max_outbound(self) -> int:
        """Maximum bytes of a packet or document to clients."""
        return MAX_OUTBOUND if self.max_message is None else self.max_message

    @property
    def max_inbound(self) -> int:
        """Maximum bytes of a packet or document from clients, before and after decompression."""
        return MAX_INBOUND if self.max_message is None else min(self.max_message, MOST_INBOUND)


@dataclass(frozen=True, slots=True)
class IgnoredGateway:
    """A gateway of an extended table that this table ignores, with the reason. `span` is its name."""

    name: str
    span: SourceSpan
    reason: Annotated[str, Named("ignore")]


@dataclass(frozen=True, slots=True)
class RouteTable:
    """A table after `extends` and variables. `files` are all files read, the table itself first.

    `routes_span` is the key `routes`; a table with only gateways has none and needs no envelope. `sha256` is over the
    bytes of `files` in order. `broken` names parts with findings, such as `endpoints/arm_board`, which were left out,
    so that their absence is not reported again. The valid rest of a broken route may still be in `routes`.
    """

    path: Path
    files: tuple[Path, ...]
    sha256: str
    envelope: EnvelopeSettings | None
    node: NodeSettings
    http: ServerSettings | None
    listeners: Mapping[str, Listener]
    endpoints: Mapping[str, Endpoint]
    routes: tuple[Route, ...]
    routes_span: SourceSpan | None
    gateways: Mapping[str, Gateway] = field(default_factory=dict)
    ignored_gateways: Mapping[str, IgnoredGateway] = field(default_factory=dict)
    broken: frozenset[str] = frozenset()
    record: RecordSettings | None = None
    foxglove: ServerSettings | None = None
    reload_on_change: bool = False
    networks: Networks | None = None
    package: Located[str] | None = None
