"""The JSON Schema of a table, which `python docs/generate.py` writes to `schemas/`. Routers import none of this.

Keys are declared by the classes of the model. What is not about one of these keys is here: the values that fit
(`values`), the mappings around the keys (`parts`), and the rules about several keys (`rules`). An `errorMessage` is the
end of a finding's sentence; editors show it too.
"""

from __future__ import annotations

from collections.abc import Sequence

from router.table.grammar.keys import BOOLEAN, TEXT, Schema, key, mapping, part, ref
from router.table.grammar.parts import PARTS
from router.table.grammar.rules import COMPLETE
from router.table.grammar.values import VALUES
from router.table.model.settings import NodeSettings, RecordSettings, ServerSettings


def table_schema() -> Schema:
    """Return the schema of a table."""
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Route table",
        "description": "Where messages come from and where they go: endpoints, listeners and a route for each payload "
        "case; or gateways only.",
        "if": {"required": ["extends"]},
        "else": ref("complete"),
        **mapping(_KEYS),
        "definitions": {**COMPLETE, **VALUES, **PARTS},
    }


def _by_name(definition: str, reserved: Sequence[str]) -> Schema:
    """Return the schema of a mapping with names that the table chooses."""
    *others, last = (f"'{name}'" for name in reserved)
    return {
        "type": "object",
        "propertyNames": {
            "pattern": f"^(?!(?:{'|'.join(reserved)})$)[A-Za-z][A-Za-z0-9_-]*$",
            "errorMessage": "must begin with a letter and continue with letters, digits, '_' and '-'; "
            f"{', '.join(others)} and {last} are reserved",
        },
        "additionalProperties": ref(definition),
    }


_NODE = NodeSettings()
_KEYS: Schema = {
    "version": key(
        "Version", "The version of the route-table language. There is one so far: 1.", {"const": 1, "default": 1}
    ),
    "extends": key(
        "Extends",
        "The base table, relative to this file. Mappings merge key by key, everything else replaces the inherited "
        "value.",
        TEXT,
        "rover.yaml",
    ),
    "envelope": ref("envelope"),
    "envelopes": key(
        "Envelopes",
        "Instead of 'envelope', if not all peers speak the same protocol: envelopes by name. Each listener, and each "
        "endpoint that is sent to, then has the key 'envelope'. A payload case that two of them have is written "
        "NAME.CASE.",
        {"minProperties": 1, **_by_name("envelope", ("any", "ros"))},
        {
            "vision": {"message": "SSL_WrapperPacket", "oneof": "payload"},
            "referee": {"message": "R", "case": "referee"},
        },
    ),
    "node": {**part(NodeSettings), "default": {"name": _NODE.name, "namespace": _NODE.namespace}},
    "http": key(
        "HTTP",
        "Where the router answers HTTP: Prometheus scrapes /metrics, browsers open the status page at /. Without this "
        "key there is neither, and `router tap`, `top` and `reload` do not work.",
        part(
            ServerSettings,
            address=key(
                "HTTP address",
                "The local TCP address that answers HTTP. 0.0.0.0 is every network of this computer: any computer that "
                "reaches it, unless `from` excludes it, can read everything, but change nothing except saving the last "
                "minute to disk.",
                ref("address"),
                "127.0.0.1:9108",
            ),
        ),
    ),
    "record": part(
        RecordSettings,
        rotate_after=key(
            "Rotate after",
            "When to close a file and begin the next one: at this size or age, whichever comes first.",
            {},
            must="be a mapping, such as {size: 1GiB} or {age: 10min}",
        ),
    ),
    "foxglove": key(
        "Foxglove",
        "Show in Foxglove, live, the datagrams that routes take, each payload case as a channel.",
        part(
            ServerSettings,
            address=key(
                "Foxglove address",
                "The local TCP address that Foxglove connects to, by websocket.",
                ref("address"),
                "127.0.0.1:8766",
            ),
            **{"from": "Only clients in these networks may connect, as for `http`."},
        ),
    ),
    "reload": key(
        "Reload",
        "When the running router reloads its table, in addition to 'router reload' and SIGHUP.",
        mapping(
            {
                "on_change": key(
                    "On change",
                    "Reload whenever a file of the table changes. If the table has errors, the old one keeps running.",
                    {**BOOLEAN, "default": False},
                ),
            }
        ),
    ),
    "networks": key(
        "Networks",
        "Every address of the table, and of the tables that it extends, must lie in one of these networks. 127.0.0.0/8 "
        "keeps a table on this computer: an endpoint added to the base table later is then an error here, and nothing "
        "is sent to it.",
        {"type": "array", "minItems": 1, "items": ref("network")},
        ["127.0.0.0/8"],
        ["127.0.0.0/8", "::1/128"],
    ),
    "defaults": ref("defaults"),
    "listen": key(
        "Listeners",
        "The local UDP addresses that the router binds, serial lines and TCP connections, by a name that appears in "
        "metrics.",
        {"minProperties": 1, **_by_name("listener", ("any", "ros", "ephemeral"))},
    ),
    "endpoints": key(
        "Endpoints",
        "The addresses that messages come from and go to, by the name that routes use.",
        {"default": {}, **_by_name("endpoint", ("any", "ros"))},
    ),
    "state": key(
        "States",
        "Values that messages set and conditions read, such as who drives: `when: state.mode == MODE_AUTO`. By a name "
        "that appears in metrics.",
        {
            "default": {},
            "type": "object",
            "propertyNames": {
                "pattern": "^[A-Za-z][A-Za-z0-9_]*$",
                "errorMessage": "must begin with a letter and continue with letters, digits and '_'",
            },
            "additionalProperties": ref("state"),
        },
    ),
    "services": key(
        "Services",
        "ROS services that boards answer: a call becomes a message to a board, and the board's reply the response. By "
        "the name of the service in ROS, which is resolved in the node's namespace. With 'call', a ROS service that a "
        "board calls, by any name.",
        {
            "default": {},
            "type": "object",
            "propertyNames": {
                "pattern": "^(?:~/|/)?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*$",
                "errorMessage": "must be the name of a ROS service: letters, digits and '_', with '/' between parts",
            },
            "additionalProperties": ref("service"),
        },
    ),
    "routes": key(
        "Routes",
        "What happens to each payload case of the envelope, by its name in the proto. Every case has a route, a list "
        "of routes, or a reason for ignoring it.",
        {"type": "object", "additionalProperties": ref("case")},
    ),
    "gateways": key(
        "Gateways",
        "Send ROS topics to clients that speak neither ROS nor protobuf, and publish their messages to ROS; by a name "
        "that appears in metrics.",
        {"default": {}, **_by_name("gateway", ("any", "ros"))},
    ),
}
