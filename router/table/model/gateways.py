"""Gateways, which send ROS topics to clients and publish their messages."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.addresses import LOCAL, Address, IPNetwork
from router.table.keys import SOME, Named, OneOf, Range, Shape, Words
from router.table.model.expressions import FieldMap
from router.table.model.routes import DeadmanKeys
from router.table.model.targets import Topic
from router.table.units import DATAGRAM_SIZE, DURATION, INTERVAL, MESSAGE_SIZE, PERIOD, RATE, TOPIC_RATE


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

    `text` is the content of the file, or the mapping as JSON. It may contain passwords: never print it. `spans` are
    those of the mapping's keys and list items, by path.
    """

    span: SourceSpan
    text: str = field(repr=False)
    path: Path | None = None
    spans: Mapping[tuple[str | int, ...], SourceSpan] = field(default_factory=dict, repr=False)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class InboundAge:
    """How old what clients send may be. `ttl` and `no_ttl` are as in a route, `max_lead` is in ns."""

    ttl: Annotated[Located[int] | None, DURATION, Shape("age_limit"), Words("dropped when older than {}")] = None
    """The greatest age of a message when it is published, or of a call when it is passed on, by the time in it; older
    ones are dropped as stale or refused. Default: no limit; {none: why} says that this is intended. The clients' clocks
    must agree with this computer's.

    Title: Time to live
    Example: 300ms
    Example: {none: it stops the rover at any age}
    """
    no_ttl: Annotated[str | None, Words("no ttl: {}")] = None
    max_lead: Annotated[int, DURATION] = 2_000_000_000
    """How far the time in a message or call may be in the future, if there is a 'ttl'. Those beyond that are refused as
    premature: somebody could keep them and send them again later.

    Title: Largest lead
    Example: 500ms
    """


@dataclass(frozen=True, slots=True)
class Inbound(InboundAge):
    """A topic that clients may publish on.

    Title: Inbound topic
    """

    topic: Topic
    span: SourceSpan
    deadman: InboundDeadman | None = None


@dataclass(frozen=True, slots=True)
class InboundService(InboundAge):
    """A ROS service that clients may call, over tcp with 'json_lines' and over websocket with 'json'.

    `timeout` is in ns, `max_rate` in Hz.

    Title: Inbound service
    """

    span: SourceSpan
    service: Annotated[Located[str], Shape("service_name")]
    """The name of the service in ROS, which is resolved in the node's namespace. Clients use the absolute name.

    Example: arm
    """
    type: Located[str]
    """The ROS service type.

    Example: std_srvs/srv/SetBool
    """
    timeout: Annotated[Located[int], DURATION, Words("waits {} for the response")]
    """How long to wait for the server's response.

    Example: 1s
    """
    max_rate: Annotated[float | None, RATE, Words("at most {}")] = None
    """At most this many calls per second of all clients together reach the service, on average; of a burst only the
    first passes. A number, or a text with its unit.

    Title: Largest rate
    Example: 2 Hz
    """


@dataclass(frozen=True, slots=True)
class Gateway:
    """Sends ROS topics of any type to its clients, and publishes their messages on the topics of 'inbound'. Or why it
    is ignored.

    `span` is its name in the table. `address` is the clients' address (udp) or the one to listen on (tcp, websocket);
    None for Zenoh. `calls` are the services in 'inbound', whose other items are topics. Periods are in ns, sizes in
    bytes. `compression` is a zstd level, 0 for none.
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
    networks: Annotated[tuple[IPNetwork, ...], Named("from"), SOME] = ()
    """Only clients in these networks may connect over tcp or websocket, as for `http`.

    Title: Clients' networks
    Example: [192.168.0.0/24]
    """
    inbound: tuple[Inbound, ...] = ()
    """The topics that clients may publish on, and the services that they may call. Messages for others are rejected and
    counted.

    Example: [{topic: /cmd_vel, type: geometry_msgs/msg/Twist}]
    Example: [{service: /arm, type: std_srvs/srv/SetBool, timeout: 1s}]
    """
    calls: tuple[InboundService, ...] = ()

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
