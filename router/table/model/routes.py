"""Routes of payload cases, with their deadmen and frames."""

from dataclasses import dataclass
from typing import Annotated

from router.errors import Located, SourceSpan
from router.table.keys import Listed, Named, Shape, Words
from router.table.model.expressions import Expression, FieldMap
from router.table.model.targets import Destination, Priority, Reply, Topic
from router.table.units import DURATION, Quantity

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
    from `sources`, which are names of endpoints or only `any`, or from `source_topics`. `topics` (published), `reply`,
    `order` and `collect` are for the former, `fields` and `for_each` for the latter. `ttl` is in ns. `no_ttl` is the
    reason why messages of any age may leave, `no_deadman` why a route with commands has no deadman.
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
    reply: Reply | None = None
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
    order: Expression | None = None
    """An expression that gives an integer which grows from message to message of a sender: only messages with a higher
    one than all before them pass, others are dropped as out_of_order. It may wrap around. A sender whose messages all
    have lower ones, because it has restarted, passes again after its 'stale_after'. Not for a topic as the source.

    Example: envelope.seq
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
