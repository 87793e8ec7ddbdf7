"""The mappings of a table: keys of the model's classes, and around them what no class declares."""

from __future__ import annotations

from router.table.grammar.keys import REASON, TEXT, Schema, about, key, mapping, part, properties, ref, required
from router.table.grammar.rules import CALLS, ENDPOINT, GATEWAY, IS_CALLED, LIMIT, ROUTE, STATE, alone, without
from router.table.grammar.values import expression, one_of
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.gateways import Gateway, IgnoredGateway, Inbound, InboundDeadman, InboundService, ZenohSettings
from router.table.model.routes import Collect, Deadman, DeadmanKeys, Obeyed, Route
from router.table.model.serial import SerialLine
from router.table.model.services import (
    CalledReply,
    CalledService,
    Service,
    ServiceCall,
    ServiceReply,
    ServiceRequest,
    ServiceSource,
)
from router.table.model.settings import EnvelopeSettings
from router.table.model.state import State
from router.table.model.targets import QOS_PROFILES, Destination, Qos, Reply, Topic
from router.table.model.tcp import TcpClient, TcpServer

_OF_ALL_TOPICS = ("topic", "type", "queue_depth", "qos")


def _some(keys: Schema, *names: str) -> Schema:
    return {name: keys[name] for name in names}


def _named(model: type, must_be: str) -> Schema:
    """Return the schema of a target: a name alone, or a mapping with the keys of a class."""
    target = mapping(properties(model), required=required(model), allOf=[LIMIT])
    return {**about(model), **expression("string", "object", must_be=must_be), "if": {"type": "object"}, "then": target}


_ROUTE = {
    **about(Route),
    **mapping({
        **properties(Route),
        "topic": key("Topic", "Short for 'topics' with one topic.", ref("topic"), "imu_data"),
    }),
    **alone("ignore"),
    "else": {"allOf": ROUTE},
}  # fmt: skip
_CASE = key(
    "Payload case",
    "What happens to one payload case: a route, or a list of routes with different sources (for example a board and "
    "ROS).",
    {
        "type": ["object", "array"],
        **one_of("array", {"minItems": 1, "items": {"allOf": [
            ref("route"),
            ref("complete_route"),
            without("ignore", "belongs to a payload case as a whole, not to one route in a list"),
        ]}}, ref("route")),
    },
    must="be a route (a mapping) or a list of routes",
)  # fmt: skip
_SOURCE = key(
    "Source",
    "An endpoint's name, 'any', or a ROS topic that messages come from.",
    {"type": ["string", "object"], "minLength": 1, "if": {"type": "object"}, "then": ref("source_topic")},
    must="be an endpoint, 'any', or a topic as {topic: NAME, type: TYPE}",
)
_SOURCE_TOPIC = key(
    "Source topic",
    "A ROS topic that messages come from: the router subscribes to it.",
    mapping(_some(properties(Topic), *_OF_ALL_TOPICS, "when"), required=["topic"]),
)
_STATE = {
    **about(State),
    **mapping({
        **_some(properties(State), "case", "source"),
        "topic": key("Topic", "The ROS topic whose messages set it: the router subscribes to it.", TEXT, "mode/set"),
        "type": key("Type", "The ROS message type of the topic.", TEXT, "std_msgs/msg/Bool"),
        **_some(properties(Topic), "queue_depth", "qos"),
        **properties(State),
    }),
    "allOf": STATE,
}  # fmt: skip
_QOS = {
    **about(Qos),
    "type": ["object", "string"],
    **one_of("string", {"enum": QOS_PROFILES.split()}, mapping(properties(Qos))),
}
_MUST_SHOW = "be one payload case with a condition, and 'within', such as {drive_diag: abs(rpm) < 5, within: 2s}"
_OBEYED = key(
    "Obeyed",
    "What shows that the rover has stopped: a payload case that each board of 'to' sends, with a condition over its "
    "fields, and the time within which a message must meet it. Until one does, the board does not obey the brake, "
    "which is a critical problem.",
    {
        "type": "object",
        "required": ["within"],
        "if": {"required": ["within"]},
        "then": {"minProperties": 2, "errorMessage": f"must {_MUST_SHOW}"},
        "maxProperties": 2,
        "additionalProperties": {**expression("string"), "examples": ["abs(front_left_motor.rpm) < 5"]},
        "properties": properties(Obeyed),
    },
    {"drive_diag": "has(front_left_motor) and abs(front_left_motor.rpm) < 5", "within": "2s"},
    must=_MUST_SHOW,
)
_REPLY = {
    **about(Reply),
    "type": "object",
    "if": {"required": ["case"]},
    "then": mapping(properties(Reply)),
    "else": {
        "minProperties": 1,
        "maxProperties": 1,
        "additionalProperties": ref("fields"),
        "errorMessage": "must be one payload case with its fields, such as {pong: {id: id}}; with other keys, write "
        "{case: pong, fields: {id: id}, when: id > 0}",
    },
}
_NO_DEADMAN = key(
    "None", "Why this route has no deadman.", REASON, "the board stops by itself after 1 s without commands",
    must="be a text that says why there is none",
)  # fmt: skip
_INBOUND = {
    **about(Inbound),
    **mapping({
        **_some(
            properties(
                Topic,
                type="The ROS message type.",
                max_rate="At most this many messages per second of all clients together are published, on average; of "
                "a burst only the first passes. A number, or a text with its unit.",
            ),
            *_OF_ALL_TOPICS, "max_rate",
        ),
        **properties(Inbound),
    }, required=["topic", "type"]),
}  # fmt: skip
_INBOUND_DEADMAN = part(
    InboundDeadman,
    timeout="The longest time without a fresh message before the deadman publishes. Required unless 'defaults' has it.",
    repeat="How often the message is repeated until a fresh one comes.",
)
_GATEWAY = properties(
    Gateway,
    transport=ref("transport"),
    topics=key(
        "Topics",
        "Which topics are sent. Hidden topics (a part of the name begins with '_') and those of 'inbound' are sent "
        "only if 'include' has their exact name. The gateway subscribes with a QoS that matches all publishers of a "
        "topic: best effort if one of them is.",
        {"minProperties": 1, "default": {}},
        {"include": ["/rover/**", {"regex": "/imu/.*"}], "exclude": ["/rover/camera/**"]},
    ),
    compression=key(
        "Compression",
        "How the data in packets is compressed; schemas never are. Default: no compression.",
        {"required": ["zstd"]},
        {"zstd": 3},
        must="be a mapping, such as {zstd: 3}",
    ),
)
_TRANSPORT = key(
    "Transport",
    "How clients are reached: one of udp (datagrams to one address), tcp and websocket (clients connect to a local "
    "address), zenoh.",
    mapping({
        "udp": key(
            "UDP", "The address of the one client, to which datagrams are sent.", ref("address"), "10.0.20.219:8502",
        ),
        "tcp": key(
            "TCP", "The local address that clients connect to; 0.0.0.0 is every network of this computer.",
            ref("address"), "0.0.0.0:8600",
        ),
        "websocket": key(
            "WebSocket", "The local address that clients connect to. A browser gets a page that shows the topics.",
            ref("address"), "0.0.0.0:8765",
        ),
        "zenoh": ref("zenoh"),
    }, minProperties=1, maxProperties=1),
    {"udp": "192.168.0.20:8502"}, {"websocket": "0.0.0.0:8765"},
    must="be one of udp, tcp, websocket and zenoh, such as {udp: 192.168.0.20:8502}",
)  # fmt: skip
_DEFAULTS = key("Defaults", "Values for parts of the table that do not set their own.", mapping({
    "package": key(
        "Package",
        "The ROS package of topics without 'type': their type is PACKAGE/msg/ and the name of the payload's protobuf "
        "message.",
        TEXT,
        "comms",
    ),
    **_some(properties(Topic, queue_depth="For topics with neither 'queue_depth' nor 'qos'."), "queue_depth"),
    "qos": key("Quality of service", "For topics without 'qos'.", ref("qos"), "sensor_data"),
    "ttl": key("Time to live", "For routes without 'ttl'.", ref("duration"), "500ms"),
    "deadman": key("Deadman", "For all deadman timers.", mapping(_some(
        properties(
            DeadmanKeys,
            timeout="For deadman timers without 'timeout'.",
            repeat="For deadman timers without 'repeat'.",
        ),
        "timeout", "repeat",
    ))),
}))  # fmt: skip

_FRAMES = {
    "framing": key(
        "Framing",
        "How frames are told apart in the bytes. cobs, slip and hdlc have delimiters, so the next frame can be read "
        "after a bad one; hdlc frames are those of Pigweed, with its CRC-32. varint and {length: ...}: the length "
        "comes first.",
        ref("stream_framing"),
        "cobs", "slip", "hdlc", "varint", {"length": "u16le"},
    ),
    "checksum": key(
        "Checksum",
        "The checksum behind each payload, inside the frame, its low byte first; {crc16_xmodem: be}: its high byte "
        "first. Default: none.",
        ref("checksum"),
        "crc16_ccitt_false", {"crc16_xmodem": "be"},
    ),
}  # fmt: skip
_LISTENER = ref("socket")
for _key, _kind in (("accept", "tcp_server"), ("connect", "tcp_client"), ("serial", "serial_line")):
    _LISTENER = {"if": {"type": "object", "required": [_key]}, "then": ref(_kind), "else": _LISTENER}

PARTS: Schema = {
    "envelope": part(EnvelopeSettings),
    "listener": _LISTENER,
    "socket": part(Listener),
    "serial_line": part(SerialLine, **_FRAMES),
    "tcp_client": part(TcpClient, **_FRAMES),
    "tcp_server": part(TcpServer, **_FRAMES),
    "endpoint": {**part(Endpoint), "allOf": ENDPOINT},
    "state": _STATE,
    "service": {"if": CALLS, "then": part(CalledService), "else": part(Service)},
    "service_source": part(ServiceSource),
    "service_call": part(ServiceCall),
    "called_reply": part(CalledReply),
    "service_request": part(ServiceRequest),
    "service_reply": part(ServiceReply),
    "case": _CASE,
    "route": _ROUTE,
    "deadman": {
        **about(Deadman),
        **mapping({"none": _NO_DEADMAN, **properties(Deadman, obeyed=_OBEYED)}),
        **alone("none"),
    },
    "collect": part(Collect),
    "destination": _named(Destination, "an endpoint's name or a mapping with 'endpoint'"),
    "reply": _REPLY,
    "topic": _named(Topic, "a topic's name or a mapping with 'topic'"),
    "qos": _QOS,
    "gateway": {
        **about(Gateway),
        **mapping({**properties(IgnoredGateway), **_GATEWAY}),
        **alone("ignore"),
        "allOf": GATEWAY,
    },
    "transport": _TRANSPORT,
    "zenoh": part(ZenohSettings),
    "inbound": {"if": IS_CALLED, "then": ref("inbound_service"), "else": ref("inbound_topic")},
    "inbound_topic": _INBOUND,
    "inbound_service": {**part(InboundService), "required": required(InboundService)},
    "inbound_deadman": {**_INBOUND_DEADMAN, "required": ["send"]},
    "source_topic": _SOURCE_TOPIC,
    "source": _SOURCE,
    "defaults": _DEFAULTS,
}
