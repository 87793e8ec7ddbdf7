"""Hints for keys and values that do not fit the schema: common mistakes and their meaning."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping

from router.errors import did_you_mean, nearest
from router.table.compose import resolve
from router.table.nodes import (
    MAP,
    REASONS,
    SAY_WHY,
    Entry,
    MappingNode,
    Node,
    Path,
    ScalarNode,
    node_at,
    to_data,
)
from router.table.schema import SCHEMA, SchemaError, keys_of, matches, table_schema
from router.table.source import in_braces
from router.table.units import EACH, PERIOD, TOPIC_RATE, meant_quantity

NAME_FIELDS = ("fields", "send", "reply")
"""Keys whose mappings contain field names, each with an expression."""
_ELSEWHERE = {
    "topic": ("name", "ros"),
    "endpoint": ("name", "to", "destination"),
    "package": ("pkg", "msgs"),
    "type": ("msg", "message", "msg_type", "message_type"),
    "queue_depth": ("queue", "queue_size", "depth"),
    "source": ("src", "from", "sender"),
    "destinations": ("dst", "dest", "target", "targets", "to"),
    "fields": ("map", "mapping"),
    "when": ("if", "condition", "filter"),
    "max_rate": ("rate", "hz", "frequency", "throttle"),
    "publish_period": ("period", "rate", "interval"),
    "ttl": ("max_age", "lifetime"),
    "deadman": ("watchdog", "failsafe"),
    "send": ("payload", "message", "command"),
    "none": ("ignore", "reason"),
    "http": ("metrics", "prometheus"),
    "endpoints": ("boards", "devices", "hosts", "nodes"),
    "include": ("whitelist", "allow", "only"),
    "exclude": ("blacklist", "deny"),
    "extends": ("include", "includes", "import", "imports", "base"),
    "kind": ("type",),
    "websocket": ("ws", "websockets"),
    "framing": ("frame",),
    "regex": ("pattern", "re"),
    "directory": ("path", "folder", "dir", "file"),
    "protos": ("proto_path", "path", "folder", "directory"),
    "rotate_after": ("rotate", "rotation", "split"),
    "retention": ("size", "max_size", "keep"),
    # of tests
    "given": ("when", "input"),
    "expect": ("then", "output"),
    "times": ("count", "repeat"),
    "from": ("source", "sender"),
    "case": ("payload", "type"),
    "published": ("topic", "topics", "publishes"),
    "sent": ("destination", "destinations", "forwarded"),
}
"""Our keys, with their names in other programs."""
ADDRESSES = ("address", "udp", "tcp", "websocket", "receive")
"""Keys whose value is an address."""
ADDRESS_PARTS = ("ip", "host", "port")
_COMMON_MISTAKES = (
    ("address", ADDRESS_PARTS, "write the IP address and port together: `address: 192.168.0.30:8`"),
    ("ignore", ("enabled", "enable", "disabled", "active"), "to disable it, write only `ignore: why`"),
    ("endpoint", ("topic", "topics"), "write a ROS topic as a key of the route: `topic: NAME`"),
    ("queue_depth", ("endpoint",), "name an endpoint directly: `source: NAME`"),
    ("qos", ("latched", "latch", "transient_local"), "write `qos: {durability: transient_local}`"),
    ("qos", ("reliable", "best_effort"), "write `qos: {reliability: best_effort}` or `reliable`"),
    ("websocket", ("type", "kind", "address", "port"), "write its kind and address, such as {websocket: 0.0.0.0:8765}"),
    ("package", ("timeout", "repeat"), "write `deadman: {timeout: 500ms, repeat: 100ms}`"),
    ("repeat", ("send", "at_start"), "set it in each deadman"),
    ("obeyed", ("within",), "move it into 'obeyed': `obeyed: {CASE: CONDITION, within: 2s}`"),
    ("transport", ("address", "port"), "write it in 'transport': `transport: {websocket: 0.0.0.0:8765}`"),
    ("record", ("directory", "continuous", "last", "rotate_after", "retention"), "move it into 'record'"),
    ("rotate_after", ("size", "age"), "move it into 'rotate_after'"),
    ("http", ("address",), "move it into the part that it is the address of: 'http', 'foxglove' or a listener"),
    ("at", ("wait", "sleep", "delay", "after"), "write the time since the start of the test: `at: 500ms`"),
    ("extends", ("description", "name", "title"), "write descriptions as comments: `# ...`"),
    ("source", ("description", "comment", "note"), "write descriptions as comments: `# ...`"),
)
"""A known key, keys that people write beside it by mistake, and the hint for them."""
CLOSE = 0.7
"""Similarity required of a suggested key: `schema_period` is not suggested for `period`."""
_SAME = 0.85
"""Similarity required if the misspelt key is a key elsewhere: `max_rate` may be misplaced, not `max_datagram`."""


def meant(name: str, known: Iterable[str]) -> str | None:
    """Return the key among `known` that a misspelt one stands for, or None."""
    known = list(known)
    if ":" in name or for_common_mistake(name, known):
        return None
    elsewhere = next((key for key in known if name in _ELSEWHERE.get(key, ())), None)
    return elsewhere or nearest(name, known, _SAME if _is_key(name) else CLOSE)


def _is_key(name: str) -> bool:
    """Return whether a table has such a key anywhere."""
    return any(name in keys_of(schema) for schema in (table_schema(), *table_schema()["definitions"].values()))


def for_common_mistake(name: str, known: Iterable[str]) -> str:
    return next((hint for key, names, hint in _COMMON_MISTAKES if key in known and name in names), "")


def behind(name: str, entry: Entry, before: tuple[str, Entry] | None) -> str:
    """Return a hint for a key that continues the text before it, or that may belong to the fields above it."""
    if before is None:
        return ""
    key, written = before[0], before[1].value
    is_nothing = isinstance(entry.value, ScalarNode) and entry.value.value is None
    if is_nothing and isinstance(written, ScalarNode) and key in REASONS:
        return f"quote text that contains ',': `{key}: \"{written.text}, {name}\"`"
    is_below = entry.key.span.line > before[1].key.span.line and not is_nothing
    if key in NAME_FIELDS and isinstance(written, MappingNode) and is_below:
        return f"if it is a key of '{key}', indent it like the others"
    return ""


def of_topic(name: str, entry: Entry, entries: Mapping[str, Entry]) -> str:
    """Return a hint for a key of a topic, such as `type`, that is beside `topic: NAME` of a route; empty without."""
    topic = entries.get("topic")
    keys = keys_of(table_schema()["definitions"]["topic"]) - keys_of(table_schema()["definitions"]["route"])
    if name not in keys or topic is None or not isinstance(topic.value, ScalarNode) or "source" not in entries:
        return ""
    value = _in_flow(to_data(entry.value)) or "..."
    return f"move it into 'topic': `topic: {{topic: {topic.value.text}, {name}: {value}}}`"


_NAMED = {"topics": "topic", "destinations": "endpoint"}
"""Lists of mappings that people write as one mapping, and the key that names an item."""


def for_key(name: str, value: Node, path: Path, known: list[str], schema: str = SCHEMA) -> str:
    """Return a hint for an unknown key, with this value, of the mapping at `path`; `schema` is that of the file."""
    if words := for_common_mistake(name, known):
        return words
    if is_topics_of_source(name, path):
        return _topics_of_source(value)
    if ":" in name:
        return f"write `{': '.join(name.split(':', 1))}`, with a space after ':'"
    if key := meant(name, known):
        return f"did you mean '{key}'?"
    if path[-1:] == ("deadman",) and "send" in known and isinstance(value, MappingNode):
        return f"put a payload case under 'send': `send: {{{name}: ...}}`"
    if schema == SCHEMA and (owners := _owners(name, path)):
        return owners
    if path[:1] == ("routes",) and (key := _NAMED.get(str(path[-1]))):
        is_listed = isinstance(value, ScalarNode) and value.value is None
        return f"write a list: [{name}, ...]" if is_listed else f"write a list: [{{{key}: {name}, ...}}]"
    return did_you_mean(name, known, CLOSE)


def is_topics_of_source(name: str, path: Path) -> bool:
    """Return whether a key of the mapping at `path` is `topics` in a source, which has one topic."""
    return name == "topics" and [step for step in path if isinstance(step, str)][-1:] == ["source"]


def _topics_of_source(value: Node) -> str:
    written = to_data(value)
    if isinstance(written, dict):
        written = _in_flow(written.get("topic")) or "NAME"
        return f"write the keys of 'topics' directly under 'source': `source: {{topic: {written}, ...}}`"
    if isinstance(written, list):
        names = [item.get("topic") if isinstance(item, dict) else item for item in written]
        rest = ", ..." if any(isinstance(item, dict) and len(item) > 1 for item in written) else ""
        return f"write a list of topics: `source: [{_each(names, 'topic', rest)}]`"
    return f"write `topic: {_in_flow(written) or 'NAME'}`"


def _each(names: Iterable[object], key: str, rest: str = "") -> str:
    """Return a mapping for each name, as written inside brackets."""
    return ", ".join(f"{{{key}: {_in_flow(name) or 'NAME'}{rest}}}" for name in names)


def _owners(name: str, path: Path) -> str:
    """Return a hint for a key that belongs elsewhere in a table; empty if there is no such key.

    Skips definitions of the same name as the one at `path`: there are two kinds of deadmen; and values with `each`.
    """
    definitions = table_schema()["definitions"]
    others = (*map(str, path[-1:]), "defaults")
    owners = [
        owner
        for owner, schema in definitions.items()
        if name in keys_of(schema) and not owner.endswith(others) and not owner.startswith(("complete", "elements"))
    ]
    if path and path[0] == "listen" and any(_NAMES[owner] == _NAMES["socket"] for owner in owners):
        return "remove it: listeners with 'address', 'serial', 'connect' and 'accept' have different keys"
    if path[:1] != ("services",):
        owners = [owner for owner in owners if not owner.startswith(("service", "called"))]
    elif "service" in owners:
        return "remove it: a service that a board answers and one with 'call' have different keys"
    if path[-2:-1] == ("inbound",) and not _INBOUND.isdisjoint(owners):
        if "inbound_deadman" not in owners:
            return "remove it: an item of 'inbound' with 'topic' and one with 'service' have different keys"
        owners = [owner for owner in owners if owner not in _INBOUND]
    near = [owner for owner in owners if owner in _OF_PART.get(str(path[0]) if path else "", ())] or owners
    named = [*dict.fromkeys(_NAMES[owner] for owner in near)]
    named += ["the top level"] if name in keys_of(table_schema()) else []
    return f"move it to {', or to '.join(named)}" if named else ""


_INBOUND = {"inbound_topic", "inbound_service"}
_OF_PART = {
    "routes": ("route", "destination", "topic"),
    "services": ("service", "service_request", "service_reply"),
    "gateways": (
        "gateway",
        "inbound_topic",
        "inbound_service",
        "transport",
        "zenoh",
        "topic_pattern",
        "inbound_deadman",
    ),
}
"""Definitions where a key belongs that is misplaced in this part of a table."""
_NAMES = {
    "route": "the route",
    "destination": "an item of 'destinations'",
    "topic": "an item of 'topics'",
    "reply": "'reply'",
    "source_topic": "a topic in 'source'",
    "collect": "'collect'",
    "deadman": "'deadman'",
    "age_limit": "'ttl'",
    "fields": "'fields'",
    "choice": "a map of values",
    "literal_text": "the value of a field",
    "qos": "'qos'",
    "state": "a state",
    "service": "a service",
    "service_request": "the 'request' of a service",
    "service_reply": "the 'reply' of a service",
    "service_source": "'from'",
    "service_call": "'call'",
    "called_reply": "the 'reply' of a service",
    **dict.fromkeys(("socket", "serial_line", "tcp_client", "tcp_server"), "a listener"),
    "stream_framing": "'framing' of a serial line or TCP connection",
    "checksum": "'checksum' of a serial line or TCP connection",
    "endpoint": "an endpoint",
    "envelope": "an envelope",
    "gateway": "a gateway",
    "transport": "'transport'",
    "zenoh": "'zenoh'",
    "topic_pattern": "an item of 'include' or 'exclude'",
    **dict.fromkeys(_INBOUND, "an item of 'inbound'"),
    "inbound_deadman": "the 'deadman' of an item of 'inbound'",
}
"""Definitions with keys, and how a hint names them."""


def for_value(error: SchemaError) -> str:
    """Return a hint with the value that was meant, if that is clear."""
    value = str(error.value)
    if error.keyword == "pattern":
        pattern = error.limit
        is_unset = error.path[-1] in _OPTIONAL and value in ("none", "never", "unlimited", "no", "off")
        if is_unset:
            takes_reason = error.path[-1] == "ttl" and error.path[0] != "defaults"
            return "write `ttl: {none: why}`" if takes_reason else f"leave '{error.path[-1]}' out"
        return as_variable(value) or _locator(value, error) or _meant_quantity(value, pattern)
    if error.keyword == "maximum" and matches(EACH, str(error.schema.get("pattern", "never"))):
        return _MOST_OFTEN[1]
    if error.keyword == "const" and value == str(error.limit):
        return f"write it without quotes: {value}"
    if error.path == ("version",):
        return f"write `version: {error.limit}`: this router knows no other"
    return _for_word(error, value) if error.keyword == "enum" else ""


def _for_word(error: SchemaError, value: str) -> str:
    """Return a hint for a text that is none of the words that a key takes."""
    if error.path[-1] in ("qos", "profile") and (key := _QOS_WORDS.get(value)):
        return f"write `qos: {{{key}}}`"
    if near := nearest(value, error.limit):
        return f"did you mean '{near}'?"
    if error.path[-1] == "kind":
        return KINDS
    if error.path[-1] == "fields":
        return _AUTO if value in ("*", "all") else _for_fields([value])
    return ""


KINDS = "a `board` is a microcontroller, a `basestation` or a `tool` an ordinary computer"


def _locator(value: str, error: SchemaError) -> str:
    """Return a hint for an address in place of a Zenoh locator."""
    is_meant = "zenoh" in error.path and re.fullmatch(r"[\w.-]+:\d+", value) and matches(f"tcp/{value}", error.limit)
    return f"did you mean 'tcp/{value}'?" if is_meant else ""


def _meant_quantity(text: str, pattern: str) -> str:
    if not (meant := meant_quantity(text, lambda quantity: matches(quantity, pattern))) or not matches(EACH, pattern):
        return meant
    supported = meant_quantity(text, lambda quantity: matches(quantity, pattern) and _is_supported(quantity))
    return supported or _MOST_OFTEN[matches("1 Hz", pattern)]


def _is_supported(often: str) -> bool:
    """Return whether gateways can send that often."""
    try:
        (TOPIC_RATE if often.endswith("Hz") else PERIOD).parse(often)
    except ValueError:
        return False
    return True


_MOST_OFTEN = (
    f"write at least '1ms', or '{EACH}' for every message",
    f"write at most '1000 Hz', or '{EACH}' for every message",
)
"""What to write in place of a period and of a rate that gateways do not support."""
_OPTIONAL = ("ttl", "age", "max_rate")
"""Limits that do not apply if the key is missing."""
_QOS_WORDS = {
    "reliable": "reliability: reliable",
    "best_effort": "reliability: best_effort",
    "transient_local": "durability: transient_local",
    "latched": "durability: transient_local",
    "keep_all": "history: keep_all",
}
"""Words that are not a profile, and the setting that they stand for."""
_LOCAL = "{{address: {0}}}"
_INSTEAD: Mapping[Path, str] = {
    ("listen",): "{{rover: {{address: {0}}}}}",
    ("listen", "*"): _LOCAL,
    ("http",): _LOCAL,
    ("foxglove",): _LOCAL,
    ("endpoints", "*"): "{{address: {0}, kind: board}}",
    ("gateways", "*", "transport", "zenoh"): "{{key: {0}}}",
    ("node",): "{{name: {0}}}",
    ("envelope",): "{{message: {0}, oneof: payload}}",
    ("record",): "{{directory: {0}}}",
    ("defaults", "deadman"): "{{timeout: {0}}}",
    ("routes", "*", "deadman"): "{{timeout: {0}, send: {{CASE: {{FIELD: VALUE}}}}}}",
    ("gateways", "*", "topics"): "{{include: [{0}]}}",
    ("gateways", "*", "inbound", "*"): "{{topic: {0}, type: TYPE}}",
}
"""Mappings that people write as a single value, and what to write instead."""

_WORDS: Mapping[tuple[Path, str], str] = {
    (("reload",), "on_change"): "write `reload: {on_change: true}`",
    (("routes", "*", "deadman"), "none"): "write `deadman: {none: why}`",
    (("gateways", "*", "topics"), "*"): "leave 'topics' out to send every topic",
    (("gateways", "*", "topics"), "all"): "leave 'topics' out to send every topic",
    (("gateways", "*", "transport"), "udp"): "write `transport: {udp: IP:PORT}`",
    (("gateways", "*", "transport"), "tcp"): "write `transport: {tcp: 0.0.0.0:8600}`",
    (("gateways", "*", "transport"), "websocket"): "write `transport: {websocket: 0.0.0.0:8765}`",
    (("gateways", "*", "transport"), "zenoh"): "write `transport: {zenoh: {key: NAME}}`",
}
"""Words that people write in place of a mapping, and the hint for them."""
_ON: Mapping[Path, str] = {
    ("record",): "{directory: ../recordings}",
    ("http",): "{address: 127.0.0.1:9108}",
    ("foxglove",): "{address: 127.0.0.1:8765}",
    ("reload",): "{on_change: true}",
}
"""Parts of the table that people turn on by `true`, and what to write instead."""
_AUTO = "write `fields: auto`"
_ADD_SPACE = "add a space after ':'"
_BY_NAME: tuple[Path, ...] = (("listen",), ("endpoints",), ("routes",), ("gateways",))
"""Mappings whose keys are names that the table chooses."""


def for_type(error: SchemaError, tree: Node) -> str:
    """Return a hint for a value of the wrong type, if the remedy is clear."""
    name, value = str(error.path[-1]) if error.path else "", error.value
    if value is None:
        return _for_nothing(error, tree, name)
    if isinstance(value, str) and "object" in error.limit and re.match(r"\w+:[^\s/]", value):
        return _ADD_SPACE
    if error.path[:-1] == ("routes",):
        return f"write `{name}: {{ignore: why}}`" if value in (False, "ignore", "none") else ""
    if name in REASONS:
        return SAY_WHY.format(name)
    if said := next(
        (hint for (pattern, word), hint in _WORDS.items() if word == value and _is_at(error.path, pattern)), ""
    ):
        return said
    if error.is_list_in_list:
        rows = to_data(node_at(tree, error.path[:-1]))
        count = sum(len(row) if isinstance(row, list) else 1 for row in rows) if isinstance(rows, list) else 0
        return f"write one list of {count} values, row by row"
    return _written_otherwise(error, name, value)


def _for_nothing(error: SchemaError, tree: Node, name: str) -> str:
    first, _, rest = name.partition(" ")
    if ":" in name:
        return _ADD_SPACE
    if rest:
        return f"write `{first.rstrip('=')}: {rest.lstrip('= ')}`, with a ':'"
    if "object" in error.limit:
        is_case = error.path[:-1] == ("routes",)
        return "indent its keys below it" + (", or write {ignore: why}" if is_case else "")
    siblings = node_at(tree, error.path[:-1])
    if isinstance(siblings, MappingNode) and (number := _decimal(siblings, name)):
        return f"write decimal numbers with a point: {number}"
    if isinstance(siblings, MappingNode) and MAP in siblings.entries:
        return f"add its value: `{name}: VALUE`"
    return "remove it: an omitted field keeps its default" if any(key in error.path for key in NAME_FIELDS) else ""


def _decimal(siblings: MappingNode, name: str) -> str:
    """Return `1.5` for `{x: y + 1,5}`, where `name` is the part after the ','; empty for anything else."""
    names = list(siblings.entries)
    before = siblings.get(names[names.index(name) - 1]) if names.index(name) else None
    whole = re.search(r"(?<![\w.])\d+$", before.text) if isinstance(before, ScalarNode) else None
    decimals = re.match(r"\d+(?![\w.])", name)
    return f"{whole[0]}.{decimals[0]}" if whole and decimals else ""


def _written_otherwise(error: SchemaError, name: str, value: object) -> str:
    """Return a hint with the value in the form that its key takes."""
    if isinstance(value, str) and (hint := _for_text(error, name, value)):
        return hint
    if isinstance(value, bool):
        return _for_truth(error.path, value)
    if hint := _for_collection(error, value) or _with_unit(error, value):
        return hint
    if _is_at(error.path[-3:], ("deadman", "send", "*")):
        return _case_or_field(name, value)
    if (written := _in_flow(value)) is None:
        return ""
    if instead := next((text for pattern, text in _INSTEAD.items() if _is_at(error.path, pattern)), ""):
        if isinstance(value, list) and "[" not in instead:
            return ""
        text = instead.format(f"IP:{written}" if isinstance(value, int) and "address: {0}" in instead else written)
        key = "NAME" if name == "address" else name
        return f"write `{text}`" if isinstance(error.path[-1], int) else f"write `{key}: {text}`"
    if error.limit == "array":
        is_address = "zenoh" in error.path and re.fullmatch(r"[\w.-]+:\d+", written)
        return f"write `{name}: [{'tcp/' if is_address else ''}{written}]`"
    return _as_text(error, name, value, written) if error.limit == "string" else ""


def _for_text(error: SchemaError, name: str, value: str) -> str:
    """Return a hint for a text where a number, a truth value or a mapping is needed."""
    if _is_of(error.limit, resolve(value)):
        return f"write it without quotes: {value}"
    if name == "send":
        case = _in_flow(value)
        return f"write `send: {{{case}: {{FIELD: VALUE}}}}`, or `send: {{{case}: {{}}}}` for defaults"
    return as_variable(value)


def _as_text(error: SchemaError, name: str, value: object, written: str) -> str:
    """Return a hint for a value where text is needed."""
    if isinstance(value, int) and name in ADDRESSES:
        return f"write `{name}: IP:{written}`"
    takes_any = not error.schema.keys() & {"errorMessage", "enum"} and not isinstance(value, list)
    return f'quote it: "{written}"' if takes_any else ""


def _for_truth(path: Path, value: bool) -> str:
    if _is_at(path[-3:], ("deadman", "send", "*")):
        return _case_or_field(str(path[-1]), value)
    if path in _ON:
        return f"write `{path[0]}: {_ON[path]}`" if value else f"leave '{path[0]}' out"
    if path[-1:] == ("deadman",) and path[:1] == ("routes",) and not value:
        return "write `deadman: {none: why}`"
    return _AUTO if value and path[-1:] == ("fields",) else ""


def _case_or_field(name: str, value: object) -> str:
    """Return a hint for a value under `send` of a deadman that has a payload case or a field, but not both."""
    if (scalars := _in_flow(value)) is None:
        return ""
    written = f"[{scalars}]" if isinstance(value, list) else scalars
    case, dot, field = name.partition(".")
    if dot:
        return f"write `{case}: {{{field}: {written}}}`"
    as_case, as_field = f"`{name}: {{FIELD: {written}}}`", f"`CASE: {{{name}: {written}}}`"
    return f"if '{name}' is a payload case, write {as_case}; if it is a field, {as_field}"


def _is_of(kinds: str | list[str], value: object) -> bool:
    if isinstance(value, bool):
        return kinds == "boolean"
    return isinstance(value, (int, float)) and ("number" in kinds or "integer" in kinds)


def _for_collection(error: SchemaError, value: object) -> str:
    if isinstance(value, dict) and isinstance(error.path[-1], int) and {*NAME_FIELDS} & {*error.path}:
        return "write each element as one expression, for a value or a whole message: [a, b]"
    if isinstance(value, dict) and error.limit == "array":
        return f"start each item with '-', or write `{error.path[-1]}: [{{...}}]`"
    if not isinstance(value, list):
        return ""
    if error.path in _BY_NAME:
        return "remove each '-'" if value and all(map(_is_named, value)) else "replace each '-' with a name and ':'"
    name = str(error.path[-1])
    if name in _NAMED.values() and error.limit == "string":
        return f"write a list of mappings: [{_each(value, name)}]"
    if name == "topic":
        return f"write `topics: [{_in_flow(value) or '...'}]`"
    if name == "rates":
        return f"write each topic with its rate, as in `rates: {{{_in_flow(value[:1]) or 'TOPIC'}: 50 Hz}}`"
    return _for_fields(value) if name == "fields" else ""


def _is_named(item: object) -> bool:
    return isinstance(item, dict) and len(item) == 1 and isinstance(next(iter(item.values())), (dict, list))


def _with_unit(error: SchemaError, value: object) -> str:
    """Return a hint for a number without its unit."""
    pattern = str(error.schema.get("pattern", ""))
    if not pattern or not isinstance(value, (int, float)) or matches(str(value), pattern):
        return ""
    written = [quantity for unit in ("ms", "s", "B", "B/s") if matches(quantity := f"{value}{unit}", pattern)]
    return " or ".join((f"write `{written[0]}`", *(f"`{quantity}`" for quantity in written[1:]))) if written else ""


def _for_fields(items: list[object]) -> str:
    """Return a hint for `fields` written as a list."""
    if items == ["auto"]:
        return _AUTO
    first, rest = items[0] if items else None, ", ..." * (len(items) > 1)
    if isinstance(first, dict) and len(first) == 1:
        [(field, expression)] = first.items()
        return f"remove each '-', as in `fields: {{{field}: {_in_flow(expression) or 'EXPRESSION'}{rest}}}`"
    written = _ASSIGNMENT.fullmatch(first) if isinstance(first, str) else None
    field, expression = written.groups() if written else ("FIELD", None)
    return f"write each field with its expression, as in `fields: {{{field}: {expression or 'EXPRESSION'}{rest}}}`"


_ASSIGNMENT = re.compile(r"([\w.]+)(?:\s*[=:]\s*(\S.*))?")
"""A field's name, perhaps with an expression."""


def _is_at(path: Path, pattern: Path) -> bool:
    return len(path) == len(pattern) and all(one in ("*", step) for one, step in zip(pattern, path, strict=True))


def _in_flow(value: object) -> str | None:
    """Return a scalar, or the scalars of a list, as written inside brackets; None for anything else."""
    if isinstance(value, list):
        items = [_in_flow(item) for item in value]
        return None if None in items or not items else ", ".join(item for item in items if item)
    if isinstance(value, str):
        return value if re.fullmatch(r"[\w./][\w./:* -]*", value) else json.dumps(value)
    return json.dumps(value) if isinstance(value, (bool, int, float)) else None


def as_variable(text: str) -> str:
    """Return a hint for a variable that is written as in a shell; empty for anything else."""
    return f'write "{in_braces(text)}"' if in_braces(text) != text else ""
