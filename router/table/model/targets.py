"""Targets of routes: endpoints and ROS topics, with conditions, rates and QoS."""

import enum
from dataclasses import dataclass
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.keys import OneOf, Range, Shape, Words
from router.table.model.expressions import Expression, FieldMap
from router.table.units import DURATION, RATE

DEPTH = Range(1, 100_000)
QOS_PROFILES = (
    "default sensor_data services_default parameters parameter_events action_status_default system_default "
    "best_available"
)


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


USUAL_REPLY_RATE = 20.0
"""In Hz."""


@dataclass(frozen=True, slots=True)
class Reply:
    """What the router itself answers: an envelope with the payload `case`, sent to the address and port that the
    datagram came from. {CASE: FIELDS} is short for {case: CASE, fields: FIELDS}.

    `span` is the key `reply`; `max_rate` is in Hz.

    Example: {pong: {id: id}}
    Example: {case: connect, fields: {sender: ROVER}, when: sender != Device.ROVER}
    """

    case: Located[str]
    """The payload case of the reply.

    Example: pong
    """
    span: SourceSpan
    fields: FieldMap | None = None
    when: Annotated[Expression | None, Shape("condition"), Words("when {}")] = None
    """A boolean expression over the received message. Messages for which it is false get no reply, and are counted as
    filtered.

    Example: sender != Device.ROVER
    """
    max_rate: Annotated[float | None, RATE, Words("at most {}")] = None
    """At most this many replies per second to each endpoint, on average; others are dropped as rate_limited. This also
    ends an exchange between two programs that answer each other's replies. Default: 20 Hz.

    Title: Largest rate
    Example: 50 Hz
    """


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
    for_each: Annotated[Expression | None, Shape("list_expression"), Words("one message for each of {}")] = None
    """An expression over the payload that gives a list: one message is published for each element. 'when' and 'fields'
    see 'item', 'index' and 'count' beside the fields of the payload, and 'auto' copies from 'item'. Only for topics
    that a route publishes.

    Example: robots_blue
    """
    fields: FieldMap | None = None

    @property
    def type_name(self) -> str:
        return self.type.value if self.type else ""
