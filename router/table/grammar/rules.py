"""The rules about several keys of one mapping, and the keys that are required."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from router.table.addresses import LEARNED
from router.table.build import DEFAULT_FORMATS
from router.table.grammar.keys import Schema, key, ref, required
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.gateways import Transport, ZenohSettings
from router.table.model.routes import Collect
from router.table.model.services import (
    CalledReply,
    CalledService,
    Service,
    ServiceCall,
    ServiceReply,
    ServiceRequest,
    ServiceSource,
)
from router.table.model.settings import RecordSettings
from router.table.model.state import State


def without(names: str, message: str) -> Schema:
    """Return the schema of a mapping that has none of the keys `names`, a pattern. `message` is about one of them."""
    return {"propertyNames": {"pattern": f"^(?!(?:{names})$)", "errorMessage": message}}


def alone(name: str) -> Schema:
    """Return the rule that a key has no other keys beside it."""
    others = {"pattern": f"^{name}$", "errorMessage": f"is not allowed with '{name}'"}
    return {"if": {"required": [name]}, "then": {"propertyNames": others}}


def _has(**values: Schema) -> Schema:
    """Return the schema of a mapping that has these keys, with such values."""
    return {"required": [*values], "properties": values}


def _over(transport: str) -> Schema:
    """Return the schema of a gateway with this transport."""
    return _has(transport={"type": "object", "required": [transport], "maxProperties": 1})


def _each(schema: Schema) -> Schema:
    return {"additionalProperties": schema}


CALLS: Schema = {"type": "object", "required": ["call"]}
"""A service that an endpoint calls."""
IS_CALLED: Schema = {"type": "object", "required": ["service"]}
"""A service that clients of a gateway call."""

# -- required keys

_IS_JSON: Schema = {"anyOf": [
    _has(format={"enum": ["json", "json_lines"]}),
    {**_over("websocket"), "not": {"required": ["format"]}},
]}  # fmt: skip
_ENVELOPE: Schema = {
    "required": ["message"],
    "if": {"required": ["case"]},
    "then": without("oneof|cases", "is not allowed with 'case': with it, the datagram itself is the message"),
    "else": {
        **without("payload", "needs 'case', the field that names the message"),
        "if": {"required": ["cases"]},
        "then": without("oneof", "is not allowed with 'cases': either says which fields are payload cases"),
        "else": {"required": ["oneof"]},
    },
}
COMPLETE: Schema = {
    "complete": {
        "$comment": "The keys that are required once a table is merged with all that it extends. Lists replace, so the "
        "items of a list must be complete.",
        "required": ["version"],
        "if": {
            "required": ["gateways"],
            "properties": {"gateways": {"minProperties": 1}, "listen": False, "routes": False},
        },
        "else": {
            "required": ["listen", "routes"],
            "if": {"required": ["envelopes"]},
            "then": without("envelope", "is not allowed with 'envelopes'"),
            "else": {"required": ["envelope"]},
        },
        "properties": {
            "envelope": _ENVELOPE,
            "envelopes": _each(_ENVELOPE),
            "http": {"required": ["address"]},
            "record": {"required": required(RecordSettings)},
            "foxglove": {"required": ["address"]},
            "listen": _each(
                {
                    "if": {"required": ["serial"]},
                    "then": {"required": ["baud", "framing"]},
                    "else": {
                        "if": {"anyOf": [{"required": ["connect"]}, {"required": ["accept"]}]},
                        "then": {"required": ["framing"]},
                        "else": {"required": required(Listener)},
                    },
                }
            ),
            "endpoints": _each(
                {
                    "required": required(Endpoint),
                    "if": {"anyOf": [{"required": ["group"]}, {"required": ["broadcast"]}, {"required": ["listener"]}]},
                    "else": {"required": ["address"]},
                }
            ),
            "state": _each(
                {
                    "required": required(State),
                    "if": {"required": ["topic"]},
                    "then": {"required": ["type"]},
                    "else": {"required": ["case", "source"]},
                }
            ),
            "services": _each(
                {
                    "if": CALLS,
                    "then": {
                        "required": ["from", "call", "reply", *required(CalledService)],
                        "properties": {
                            "from": {"required": required(ServiceSource)},
                            "call": {"required": required(ServiceCall)},
                            "reply": {"required": required(CalledReply)},
                        },
                    },
                    "else": {
                        "required": [*required(Service), "request", "reply"],
                        "properties": {
                            "request": {"required": required(ServiceRequest)},
                            "reply": {"required": required(ServiceReply)},
                        },
                    },
                }
            ),
            "routes": _each(ref("complete_route")),
            "gateways": _each(ref("complete_gateway")),
        },
    },
    "complete_route": {
        "if": {"required": ["ignore"]},
        "else": {
            "required": ["source"],
            "properties": {
                "deadman": {"if": {"required": ["none"]}, "else": {"required": ["send"]}},
                "collect": {"required": required(Collect)},
            },
        },
    },
    "complete_gateway": {
        "if": {"required": ["ignore"]},
        "else": {
            "required": ["transport"],
            "properties": {"transport": {"properties": {"zenoh": {"required": required(ZenohSettings)}}}},
            "allOf": [
                {
                    "if": {"allOf": [_over("udp"), _has(inbound={"type": "array", "minItems": 1})]},
                    "then": {"required": ["receive"]},
                },
                {
                    "if": _has(format={"const": "gateway_v2"}),
                    "else": without(
                        "max_datagram",
                        "limits the datagrams of 'format: gateway_v2'; other formats have one packet per datagram",
                    ),
                },
                {
                    "if": _IS_JSON,
                    "then": without("compression", "is for packets; the 'format' here is JSON documents"),
                },
            ],
        },
    },
}

# -- of targets and routes

LIMIT: Schema = {
    "if": {"required": ["max_rate"]},
    "else": without("on_limit", "needs 'max_rate', which is missing here"),
}
ROUTE: Sequence[Schema] = [
    {
        "if": {"required": ["topic"]},
        "then": without("topics", "is not allowed with 'topic'; write all topics under 'topics'"),
    },
    {
        "if": _has(source={"anyOf": [{"type": "object"}, {"type": "array", "contains": {"type": "object"}}]}),
        "then": {"allOf": [
            without("collect", "joins datagrams; it is not allowed if the source is a topic"),
            without("order", "drops datagrams that were overtaken; it is not allowed if the source is a topic"),
            without("reply", "answers datagrams; it is not allowed if the source is a topic, which has no sender"),
            without("topics?", "publishes, but messages from a topic go to 'destinations'"),
        ]},
        "else": {"allOf": [
            without("fields", "belongs in a topic here; a route has it only if its source is a topic"),
            without("for_each", "belongs in a topic here; a route has it only if its source is a topic"),
        ]},
    },
]  # fmt: skip

STATE: Sequence[Schema] = [
    {
        "if": {"required": ["topic"]},
        "then": without("case|source", "is for a state that datagrams set; it is not allowed with 'topic'"),
        "else": without("type|queue_depth|qos", "is for a state that a topic sets; it needs 'topic', which is missing"),
    },
]

# -- of endpoints

ENDPOINT: Sequence[Schema] = [
    {
        "if": {"required": ["group"]},
        "then": without("address|broadcast", "is not allowed with 'group'; an endpoint has one destination"),
        "else": without("interface|hops", "needs 'group', which is missing here"),
    },
    {
        "if": {"required": ["broadcast"]},
        "then": without("address", "is not allowed with 'broadcast'; an endpoint has one destination"),
    },
    {
        "if": _has(address={"anyOf": [{"enum": [LEARNED.host]}, ref("variable")]}),
        "else": without("networks", "needs 'address: learned': an address that is written is in one network"),
    },
]

# -- of gateways

_NO_RECEIVE = without(
    "receive", "is the local address of a udp gateway; over other transports clients send on their connection"
)
_NO_CLIENTS = without(
    "max_clients|max_clients_per_host|from", "limits connections, so it is allowed with tcp and websocket only"
)
_PACKETS = {"gateway_v1": "one packet per message, with a binary header"}
_FORMATS: Mapping[str, Mapping[str, str]] = {
    "udp": {**_PACKETS, "gateway_v2": "packets in batches"},
    "tcp": {**_PACKETS, "json_lines": "one document per line"},
    "websocket": {"json": "documents", **_PACKETS},
    "zenoh": {**_PACKETS, "json": "documents"},
}
_LIMITS = {"udp": [_NO_CLIENTS], "tcp": [_NO_RECEIVE], "websocket": [_NO_RECEIVE], "zenoh": [_NO_RECEIVE, _NO_CLIENTS]}


def _of_transport(name: str, formats: Mapping[str, str]) -> Schema:
    """Return the rule for gateways with a transport: which formats fit, and which keys do not."""
    default = DEFAULT_FORMATS[Transport(name)].value
    meanings = "; ".join(f"{word}: {meaning}" for word, meaning in formats.items())
    chosen = key(
        "Format", f"The format that clients read. {meanings}.", {"default": default, "enum": [*formats]},
        must=f"be {' or '.join(map(repr, formats))} over {name}",
    )  # fmt: skip
    return {"if": _over(name), "then": {"allOf": [{"properties": {"format": chosen}}, *_LIMITS[name]]}}


GATEWAY: Sequence[Schema] = [_of_transport(name, formats) for name, formats in _FORMATS.items()]
