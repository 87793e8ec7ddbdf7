"""The route table as typed, frozen data. Every value that a finding can point at keeps its span.

The fields declare the keys of the table (see `keys`); the docstrings of fields are what editors show (see
`grammar.keys`). The compiler checks whether payload cases, fields and ROS types exist.
"""

# Annotations are evaluated here: as strings, they would be compiled whenever a table is read.

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from pathlib import Path
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.addresses import LOCAL, REMOTE, Address
from router.table.keys import Listed, Named, OneOf, Range, Shape, Words
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

SOME = Listed(least=1)
DEPTH = Range(1, 100_000)
QOS_PROFILES = (
    "default sensor_data services_default parameters parameter_events action_status_default system_default "
    "best_available"
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
    ZERO_TRIMMED = "zero_trimmed"
    EXACT = "exact"


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
    """Which protobuf message wraps every payload on the wire.

    `protos` and `lock` are absolute paths; without `lock`, the lock file is beside the protos.
    """

    protos: Located[Path]
    """The folder with the .proto files, relative to this file. Default: the protos shipped with the router.

    Title: Proto folder
    Example: ../protos
    """
    message: Located[str]
    """The name of the protobuf message that every datagram holds.

    Title: Envelope message
    Example: PBEnvelope
    """
    oneof: Located[str]
    """The name of the envelope's oneof whose members are the payload cases.

    Title: Payload oneof
    Example: payload
    """
    lock: Located[Path] | None = None
    """The file that records the field numbers, relative to this file. Default: envelope.lock.json in the folder of the
    .proto files. Set it if that folder is not yours to change, such as a submodule.

    Title: Lock file
    Example: ../envelope.lock.json
    """
    exclude: tuple[Located[str], ...] = ()
    """Files and folders of `protos`, relative to it, that are ignored: files of other people in that folder that the
    envelope does not import.

    Title: Excluded protos
    Example: [motor/old.proto, tests]
    """
    because: Annotated[str | None, Shape("reason")] = None
    """Why boards accept envelopes whose fields beside the payload are empty. The router fills none in those that it
    makes from ROS messages and for deadman timers; forwarded ones keep theirs.

    Example: boards do not check the sequence number
    Error: must be a text that says why these fields may be empty
    """


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """How the router appears in the ROS graph.

    `span` is the key `node`, `diagnostics` the span of its key, None if off.

    Title: ROS node
    """

    name: Annotated[str, Shape("node_name")] = "rover_router"
    """The ROS node's name.

    Title: Node name
    """
    namespace: Annotated[str, Shape("namespace")] = "/"
    """The ROS namespace in which relative topic names are resolved.

    Title: Node namespace
    """
    diagnostics: SourceSpan | None = None
    """Publish one status for each route and endpoint on /diagnostics once a second, for ROS's own monitors."""
    span: SourceSpan | None = None


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """A server of the router, for clients from `networks` or from anywhere. `span` is its key in the table."""

    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    """The local TCP address that clients connect to."""
    networks: Annotated[tuple[IPv4Network, ...], Named("from"), SOME] = ()
    """Only clients in these networks may connect, and always those on the router's own computer, which include all
    clients of a proxy there. Others are refused, counted and logged. Without this key anybody may connect.

    Title: Clients' networks
    Example: [192.168.0.0/24]
    """


@dataclass(frozen=True, slots=True)
class Listener:
    """A local UDP address that the router binds.

    `span` is its name in the table. `receive_buffer` is in bytes.
    """

    name: str
    span: SourceSpan
    address: Annotated[Located[Address], LOCAL]
    """The local address to bind; 0.0.0.0 is every network of this computer.

    Title: Listener address
    Example: 0.0.0.0:5000
    """
    framing: Framing = Framing.ZERO_TRIMMED
    """zero_trimmed: senders may remove trailing zero bytes or pad with them; the router undoes both before it forwards.
    exact: a datagram is the envelope and nothing else, so a truncated one is never mistaken for a trimmed one.
    """
    receive_buffer: Annotated[int, SIZE] = 4 << 20
    """How much the kernel may hold for this listener while the router is busy. The kernel's own limit
    (net.core.rmem_max) applies.
    """
    interface: Annotated[str | None, Shape("interface")] = None
    """Receive only datagrams that arrive on this network interface. Several listeners may have the same address, each
    on an interface of its own.

    Example: wlan0
    Example: wg0
    """

    @property
    def bound_to(self) -> str:
        return bound_to(self.address.value, self.interface)


EPHEMERAL = "ephemeral"
"""The value of `send_from` for a source port chosen by the kernel, instead of a listener's port."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A named UDP address: a board, a basestation, a tool.

    `span` is its name in the table. `bandwidth` is in bytes per second, `stale_after` in ns, None for never.
    `send_from` is a listener's name, EPHEMERAL, or None if it is not set.
    """

    name: str
    span: SourceSpan
    address: Annotated[Located[Address], REMOTE]
    """Where datagrams to it are sent. Datagrams from it are recognised by the IP address.

    Title: Endpoint address
    Example: 192.168.0.30:8
    """
    kind: EndpointKind
    """board: a microcontroller that decodes into fixed-size structures, so datagrams for it are checked against their
    limits. basestation or tool: an ordinary computer.

    Example: board
    """
    listener: Located[str] | None = None
    """Accept its datagrams only at this listener; at any other, a datagram from its address counts as a stranger's.
    Default: accept them at every listener.

    Example: radio
    """
    send_from: Located[str] | None = None
    """Send datagrams to it from this listener's address and port, so that replies reach that listener. ephemeral: from
    a port that the kernel chooses, so replies are lost. Default: the endpoint's listener; without one, the address and
    port of all listeners if they are the same, else ephemeral.

    Example: rover
    Example: ephemeral
    """
    source_port: Annotated[Located[int] | None, Range(1, 65_535)] = None
    """The UDP port that it sends from. Needed to distinguish endpoints that share an IP address.

    Example: 9000
    """
    stale_after: Annotated[int | None, PATIENCE] = 5_000_000_000
    """An endpoint that has been silent for longer counts as stale in diagnostics, on the status page, for 'router
    doctor' and in alerts. never: for an endpoint that only sends now and then.

    Example: 5s
    Example: never
    """
    bandwidth: Annotated[int | None, DATA_RATE] = None
    """The most bytes per second to send to it: the capacity of the radio link. When it is used up, commands go first,
    then telemetry, then bulk, and the oldest bulk is dropped. It counts the bytes of router_sent_bytes_total: UDP and
    IP add 28 to each datagram, the link more. Default: no limit.

    Example: 500kB/s
    """
    trim_trailing_zeros: bool = False
    """Send envelopes to it without their trailing zero bytes, for a receiver that restores them."""
    allow_non_finite: bool = False
    """Send a board datagrams with NaN or infinity, because its firmware handles them. Default: drop them as non_finite.
    Only for kind: board; other endpoints always get them.

    Title: Allow NaN and infinity
    """


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Record every received datagram, including rejected ones, in MCAP files.

    `span` is the key `record`; `directory` is an absolute path. `last` and `max_age` are in ns, sizes in bytes.

    Title: Recording
    """

    span: SourceSpan
    directory: Path
    """Where the files are written, relative to this file. The directory is created if it is missing.

    Example: ../recordings
    """
    continuous: bool = True
    """Write everything to files all the time. false: write only what 'last' holds, on request."""
    last: Annotated[int | None, DURATION] = None
    """Keep this much in memory, and save it to a file of its own on SIGUSR1, on POST /record/save, and when a deadman
    trips.

    Example: 60s
    """
    max_size: Annotated[int, DISK_SIZE, Named("rotate_after.size")] = 256 << 20
    """Begin a new file when the current one reaches this size.

    Example: 256MiB
    """
    max_age: Annotated[int, DURATION, Named("rotate_after.age")] = 600_000_000_000
    """Begin a new file when the current one reaches this age.

    Example: 10min
    """
    retention: Annotated[int, DISK_SIZE] = 4 << 30
    """Delete the router's oldest files in the directory when their total size exceeds this.

    Example: 4GiB
    """


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
    items: "tuple[Expression, ...] | None" = None
    choices: "Choices | None" = None
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
    """How the target is filled: 'auto' for fields of the same name on both sides, or each field with its expression.
    The entry 'auto: true' adds the fields of the same name that are not listed. Default: 'auto', if every field of the
    ROS message has a field of the same name on the other side.

    `span` is that of the value. `fields: auto`, or `auto: true` among the entries, sets `auto`. Entries take
    precedence.

    Title: Fields
    Error: must be 'auto' or a mapping of fields to expressions
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
    """ROS QoS, with rclpy's names. Keys override the profile. A profile's name alone is short for {profile: NAME}.

    Durations are in nanoseconds. None means not set.

    Title: Quality of service
    Example: sensor_data
    Example: {profile: sensor_data, depth: 5}
    Error: must be a profile such as sensor_data, or a mapping with rclpy's names
    """

    span: SourceSpan
    profile: Annotated[Located[str] | None, OneOf(QOS_PROFILES)] = None
    """The rclpy preset that the other keys start from. Default: default."""
    reliability: Annotated[Located[str] | None, OneOf("reliable best_effort best_available system_default")] = None
    """Whether lost messages are sent again."""
    durability: Annotated[Located[str] | None, OneOf("volatile transient_local best_available system_default")] = None
    """Whether late subscribers get the last messages."""
    history: Annotated[Located[str] | None, OneOf("keep_last keep_all system_default")] = None
    """Whether the last 'depth' messages are kept, or all."""
    depth: Annotated[Located[int] | None, DEPTH] = None
    """How many messages are kept with 'history: keep_last'. The same as 'queue_depth'.

    Example: 10
    """
    deadline: Annotated[Located[int] | None, DURATION] = None
    """The longest time between two messages, as requested and offered in ROS."""
    lifespan: Annotated[Located[int] | None, DURATION] = None
    """How long a message is valid; older ones are not delivered."""
    liveliness: Annotated[Located[str] | None, OneOf("automatic manual_by_topic best_available system_default")] = None
    """How a publisher shows that it is alive."""
    liveliness_lease_duration: Annotated[Located[int] | None, DURATION] = None
    """How long a publisher counts as alive after it last showed it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetKeys:
    """Common keys of destinations and topics. `max_rate` is in Hz."""

    when: Annotated[Expression | None, Shape("condition"), Words("when {}")] = None
    """A boolean expression over the source message. Messages for which it is false are withheld from this target and
    counted as filtered.

    Example: state == SensorState.SENSOR_OPERATING
    """
    max_rate: Annotated[float | None, RATE, Words("at most {}")] = None
    """At most this many messages per second of each source go to this target, on average; of a burst only the first
    passes. A number, or a text with its unit.

    Title: Largest rate
    Example: 30 Hz
    Example: 0.5
    """
    on_limit: Annotated[OnLimit, Words("keeping the {}", beside="max_rate")] = OnLimit.FIRST
    """What happens to messages that exceed 'max_rate'. first: they are dropped. latest: the newest is held and sent as
    soon as the rate allows, so that a last command or a final state always gets through. Only with 'max_rate'.
    """


@dataclass(frozen=True, slots=True)
class Destination(TargetKeys):
    """An endpoint's name, or a mapping with the endpoint and conditions.

    `fields` is for routes from topics.
    """

    endpoint: Located[str]
    """The name of the endpoint.

    Example: basestation
    """
    span: SourceSpan
    fields: FieldMap | None = None


@dataclass(frozen=True, slots=True)
class Topic(TargetKeys):
    """A ROS topic that is published, with its type, QoS and field mapping; or its name alone.

    Also a topic as the source of a route. The `type` of a route's topic may be missing in a table, but not in a checked
    one (see `compiler.check`).
    """

    topic: Located[str]
    """The topic's name. A relative name is resolved in the node's namespace.

    Example: imu/data_raw
    """
    span: SourceSpan
    type: Located[str] | None = None
    """The ROS message type. Default: the type in 'defaults.package' with the name of the payload's protobuf message.

    Example: sensor_msgs/msg/Imu
    """
    queue_depth: Annotated[Located[int] | None, DEPTH] = None
    """The depth of the ROS history; the rest of the QoS keeps its defaults. Use 'qos' to set more.

    Example: 10
    """
    qos: Qos | None = None
    fields: FieldMap | None = None

    @property
    def type_name(self) -> str:
        return self.type.value if self.type else ""


AT_START = Quantity("at_start", parse=lambda word: word == "send", show=lambda sends: "send" if sends else "silent")
DEFAULT_REPEAT = Located(100_000_000, SourceSpan("the default"))
"""Default interval between the datagrams of a deadman, in ns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeadmanKeys:
    """Common keys of the deadmen of routes and gateways. Durations are in ns.

    `because` justifies settings that look like a mistake.
    """

    timeout: Annotated[Located[int], DURATION]
    """The longest time without a fresh command before the payload is sent. Required unless 'defaults' has it.

    Example: 500ms
    """
    repeat: Annotated[Located[int], DURATION] = DEFAULT_REPEAT
    """How often the payload is repeated until a fresh command comes, because datagrams get lost."""
    at_start: Annotated[bool, AT_START] = True
    """What the deadman does when the router starts. send: it sends its payload before anything else, because a board
    may still obey the last command of a router that was killed; the deadman of a route repeats it each second until a
    command is sent or the endpoint was heard. silent: it does not; say why in a comment.
    """
    because: Annotated[str | None, Shape("reason")] = None
    """Why unusual settings of the deadman are intended: `router validate` then does not warn about its 'timeout',
    'repeat', 'to' and 'disarmed_by', or about a longer 'ttl'.

    Example: a probe takes 15 s to come up
    Error: must say why
    """


@dataclass(frozen=True, slots=True)
class Obeyed:
    """What shows that the rover has stopped: a message of `case`, from each board, that meets the condition `when`.

    `span` is the key `obeyed`. `within` (ns) is the longest time from the first brake to that message.
    """

    span: SourceSpan
    case: Located[str]
    when: Expression
    within: Annotated[Located[int], DURATION]
    """The longest time from the first brake to a message that meets the condition: the time to stop from full speed,
    and one more period of these messages.

    Example: 2s
    """


@dataclass(frozen=True, slots=True)
class Payload:
    """A payload of constants: a payload `case` with `fields`."""

    case: Located[str]
    fields: FieldMap

    def __str__(self) -> str:
        return f"{self.case.value} {self.fields}" if self.fields.entries else self.case.value


@dataclass(frozen=True, slots=True)
class Deadman(DeadmanKeys):
    """Stops the rover when commands stop coming. The first command that is sent arms it; it sends its payload when no
    fresh command comes in time, repeats it until one does, and sends it at shutdown. Or {none: why} if a route has none
    on purpose.

    `span` is the key `deadman`. `payloads` are sent in this order, also when the router starts with `at_start`.
    `disarmed_by` is None if not set.

    Example: {timeout: 500ms, send: {manual_brake: {brake: true}}}
    Example: {none: the board stops by itself after 1 s without commands}
    Error: must be a mapping with 'send', or {none: why} if there is none on purpose
    """

    span: SourceSpan
    payloads: Annotated[tuple[Payload, ...], Named("send")]
    """The payload that stops the rover: a payload case with constants for its fields. Fields that are left out keep
    their defaults. Several cases are sent in this order, for example because boards with different firmware obey
    different ones.

    Example: {manual_brake: {brake: true}}
    """
    to: Annotated[tuple[Located[str], ...], Listed(least=1, unique=True, alone=True)]
    """The endpoint or endpoints that get it. Default: the route's destinations.

    Example: driving_board
    """
    disarmed_by: Annotated[tuple[Located[str], ...] | None, Listed(unique=True, alone=True)] = None
    """Payload cases, or names of routes, that move the same motors. A fresh command of one of them to an endpoint
    disarms this deadman for that endpoint until the next command of this route to it, because the other route has a
    deadman of its own. [] says that others move something else, so this deadman stays armed between their commands.

    Example: drive_motor
    """
    obeyed: Obeyed | None = None


@dataclass(frozen=True, slots=True)
class Collect:
    """Joins the messages of one frame: the topics are published once, when all messages have arrived, in any order. The
    topics' expressions see the fields of the first message; 'items' has all messages in order, 'count' their number.
    Not for a topic as the source.

    `span` is the key `collect`; `timeout` is in ns.

    Example: {by: frame_id, count: total_count, order: index, timeout: 1s}
    """

    span: SourceSpan
    by: Expression
    """An expression with the same value in all messages of a frame, and other values in other frames from the same
    source.

    Example: frame_id
    """
    count: Expression
    """How many messages the frame has.

    Example: total_count
    """
    order: Expression
    """The message's place in the frame, starting at 0.

    Example: index
    """
    timeout: Annotated[Located[int], DURATION]
    """How long to wait for the other messages of a frame after its first. Then the frame is dropped as incomplete.

    Example: 1s
    """


ANY = "any"
ROS = "ros"
"""The source of messages from topics, as metrics name it."""


@dataclass(frozen=True, slots=True)
class Route:
    """Where one payload case comes from, where it is forwarded to, and which topics carry it. Or why it is ignored.

    `span` is the payload case in the table, or the first key of a route in a list. `name` is unique, for metrics and
    log: the payload case, or, for one of several routes of a case, a name such as `imu_info_from_ros`. Messages come
    from `sources`, which are names of endpoints or only `any`, or from `source_topics`. `topics` (published) and
    `collect` are for the former, `fields` and `for_each` for the latter. `ttl` is in ns. `no_ttl` is the reason why
    messages of any age may leave, `no_deadman` why a route with commands has no deadman.
    """

    name: str
    span: SourceSpan
    case: Located[str]
    ignore: Annotated[str | None, Shape("reason")] = None
    """Why this payload case goes nowhere. Its datagrams are counted and dropped.

    Example: nobody needs it yet
    Error: must be a text that says why it goes nowhere
    """
    sources: Annotated[tuple[Located[str], ...], Named("source"), Shape("source"), Listed(least=1, alone=True)] = ()
    """The sender: an endpoint, a ROS topic, or a list of these; 'any' is every sender.

    Example: sensor_board
    Example: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage, queue_depth: 10}
    """
    source_topics: Annotated[tuple[Topic, ...], Named("source")] = ()
    destinations: Annotated[tuple[Destination, ...], Listed(unique=True, alone=True)] = ()
    """The endpoint or endpoints that get it: datagrams byte for byte, messages from a topic as a new envelope.

    Example: basestation
    Example: [basestation, logger]
    """
    topics: Annotated[tuple[Topic, ...], Listed(alone=True)] = ()
    """The ROS topic or topics that are published.

    Example: imu_data
    Example: [{topic: imu/data_raw, type: sensor_msgs/msg/Imu}, imu_data]
    """
    fields: FieldMap | None = None
    ttl: Annotated[Located[int] | None, DURATION, Shape("age_limit"), Words("dropped when older than {}")] = None
    """The greatest age of a message when it is sent or published; older ones are dropped as stale. Default: no limit;
    {none: why} says that this is intended. Age counts from arrival; for a ROS message from its publication, or from its
    header.stamp if that is earlier. Clock steps do not matter, but publishers' clocks must agree with this computer's.

    Title: Time to live
    Example: 200ms
    Example: {none: it stops the rover at any age}
    """
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None
    deadman: Deadman | None = None
    no_deadman: str | None = None
    for_each: Annotated[Expression | None, Shape("list_expression")] = None
    """An expression over the ROS message that gives a list: each element becomes an envelope of its own. The route's
    expressions see 'item', 'index' and 'count', and 'auto' copies from 'item'. Only for a topic as the source.

    Example: detections
    """
    collect: Collect | None = None
    priority: Priority | None = None
    """Which messages go first when an endpoint's bandwidth is used up. Default: command for a route that goes to a
    board or feeds a deadman, telemetry for any other.
    """

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
    """How the gateway joins its Zenoh network.

    Example: {key: rovers/rover_1, connect: [tcp/192.168.0.10:7447]}
    """

    key: Annotated[Located[str], Shape("key_prefix")]
    """The prefix of all key expressions of this gateway, different for each rover: data is at KEY/data/TOPIC, schemas
    at KEY/schema/TYPE, and clients publish at KEY/inbound/TOPIC.

    Example: rovers/rover_1
    """
    mode: Annotated[str, OneOf("peer client router")] = "peer"
    """The gateway's role in the network. A client needs a router, peers discover each other, a router also serves
    clients.
    """
    connect: Annotated[tuple[str, ...], Shape("locator")] = ()
    """The locators that it connects to, such as tcp/192.168.0.10:7447. With 'connect' or 'listen', there is no
    discovery by multicast; connected peers may still announce others (gossip).

    Example: [tcp/192.168.0.10:7447]
    """
    listen: Annotated[tuple[str, ...], Shape("locator")] = ()
    """The locators at which it accepts connections. Default: Zenoh's choice.

    Example: [tcp/0.0.0.0:7447]
    """
    config: ZenohConfig | None = None
    """Further configuration of the Zenoh library, such as certificates, passwords and access control: a mapping, or a
    Zenoh configuration file (JSON5 or YAML), relative to this file.

    Title: Configuration
    Example: zenoh.json5
    Example: {transport: {link: {tls: {root_ca_certificate: /etc/rover/ca.pem}}}}
    """


@dataclass(frozen=True, slots=True)
class InboundDeadman(DeadmanKeys):
    """Stops the rover when clients' messages stop coming. The first one arms it; it publishes its message when no fresh
    one comes in time, repeats it until one does, and publishes it at shutdown.

    `span` is the key `deadman`. With `at_start`, the message is also published when the router starts.

    Title: Deadman of an inbound topic
    Example: {timeout: 500ms, send: {linear.x: 0.0}}
    """

    span: SourceSpan
    fields: Annotated[FieldMap, Named("send"), Shape("constants")]
    """Constants for the fields of the message that is published. Fields that are left out keep their defaults; {} is
    all zero.

    Example: {linear.x: 0.0}
    """


@dataclass(frozen=True, slots=True)
class Inbound:
    """A topic that clients may publish on.

    `ttl` and `no_ttl` are as in a route, `max_lead` is in ns.

    Title: Inbound topic
    """

    topic: Topic
    span: SourceSpan
    ttl: Annotated[Located[int] | None, DURATION, Shape("age_limit"), Words("dropped when older than {}")] = None
    """The greatest age of a message when it is published, by the time in the message; older ones are dropped as stale.
    Default: no limit; {none: why} says that this is intended. The clients' clocks must agree with this computer's.

    Title: Time to live
    Example: 300ms
    Example: {none: it stops the rover at any age}
    """
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None
    max_lead: Annotated[int, DURATION] = 2_000_000_000
    """How far the time in a message may be in the future, if there is a 'ttl'. Messages beyond that are refused as
    premature: somebody could keep them and send them again later.

    Title: Largest lead
    Example: 500ms
    """
    deadman: InboundDeadman | None = None


@dataclass(frozen=True, slots=True)
class Gateway:
    """Sends ROS topics of any type to its clients, and publishes their messages on the topics of 'inbound'. Or why it
    is ignored.

    `span` is its name in the table. `address` is the clients' address (udp) or the one to listen on (tcp, websocket);
    None for Zenoh. Periods are in ns, sizes in bytes. `compression` is a zstd level, 0 for none.
    """

    name: str
    span: SourceSpan
    transport: Located[Transport]
    address: Located[Address] | None
    zenoh: ZenohSettings | None
    format: GatewayFormat
    """The format that clients read. gateway_v1: one packet per message, with a binary header (udp, tcp, websocket,
    zenoh). gateway_v2: the same in batches (udp). json: documents (websocket, zenoh). json_lines: one document per line
    (tcp). Default: gateway_v1, over websocket json.

    Example: gateway_v1
    Example: json
    """
    receive: Annotated[Located[Address] | None, LOCAL] = None
    """The local address at which a udp gateway sends and receives. Default: it sends from any port and receives
    nothing.

    Example: 10.0.0.230:8500
    """
    include: Annotated[tuple[TopicPattern, ...], Named("topics.include"), SOME] = ()
    """Patterns of the topics that are sent. Default: every topic that is not hidden.

    Example: [/rover/**, /imu/*]
    """
    exclude: Annotated[tuple[TopicPattern, ...], Named("topics.exclude")] = ()
    """Patterns of topics that are not sent, even if 'include' matches them.

    Example: [/rover/camera/**]
    """
    publish_period: Annotated[int, PERIOD] = 500_000_000
    """The time between two sent values of a topic, at least 1ms. Only the latest value is sent. each: every message is
    sent.
    """
    schema_period: Annotated[int, INTERVAL] = 5_000_000_000
    """The time after which schemas are sent again over udp and zenoh, where the gateway does not notice new clients. At
    least 10ms.
    """
    discovery_period: Annotated[int, INTERVAL] = 5_000_000_000
    """The time between two searches for new and removed topics. At least 10ms."""
    compression: Annotated[int, Named("compression.zstd"), Range(1, 22)] = 0
    """The level, from 1 (fast) to 22 (small).

    Title: Zstandard
    Example: 3
    """
    rates: tuple[TopicRate, ...] = ()
    """How often topics that match a glob are sent, in place of 'publish_period': a rate up to 1000 Hz, or 'each' for
    every message. The first matching glob applies.

    Example: {/rover/imu: 50 Hz, /tf: each}
    """
    max_datagram: Annotated[int, DATAGRAM_SIZE] = 1400
    """The largest datagram of gateway_v2, 576B to 65507B. A longer packet is sent alone.

    Title: Largest datagram
    Example: 1400B
    Example: 8kB
    """
    max_message: Annotated[int | None, MESSAGE_SIZE] = None
    """The longest packet or document that is sent, by its size on the wire: 1kB to 256MiB. It also limits what clients
    send, before and after decompression, up to 1MiB. Default: 16MiB are sent, and clients may send 64KiB. Longer ones
    are dropped or rejected as too_large.

    Title: Largest message
    """
    max_topics: Annotated[int, Range(1, 100_000)] = 500
    """How many topics are served at the same time. Topics named in `include` and those of the table come first, then
    those that are served already. The others cost nothing, and are counted and logged.

    Title: Most topics
    """
    max_clients: Annotated[int, Range(1, 10_000)] = 1024
    """How many clients may be connected at the same time over tcp or websocket.

    Title: Most clients
    """
    max_clients_per_host: Annotated[int, Range(1, 10_000)] = 16
    """How many clients of one IP address may be connected at the same time over tcp or websocket.

    Title: Most clients per host
    """
    networks: Annotated[tuple[IPv4Network, ...], Named("from"), SOME] = ()
    """Only clients in these networks may connect over tcp or websocket, as for `http`.

    Title: Clients' networks
    Example: [192.168.0.0/24]
    """
    inbound: tuple[Inbound, ...] = ()
    """The topics that clients may publish on. Messages for other topics are rejected and counted.

    Example: [{topic: /cmd_vel, type: geometry_msgs/msg/Twist}]
    """

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
    reason: Annotated[str, Named("ignore"), Shape("reason")]
    """Why this table turns off the gateway of the base table.

    Example: no page on this rover
    Error: must be a text that says why there is none
    """


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
