"""The values that fit, by name: the kinds of numbers, texts and expressions of a table."""

from __future__ import annotations

from collections.abc import Mapping

from router.table.grammar.keys import BOOLEAN, REASON, TEXT, Schema, about, key, mapping, ref
from router.table.model.expressions import FieldMap
from router.table.model.serial import LENGTHS, ChecksumKind
from router.table.units import BYTES, DISK_BYTES, NANOSECONDS

_VARIABLE = r"\$\{"
"""A variable is filled in before anything is checked; editors see the text as it is written.

It is an alternative of a pattern rather than an `if`: the branches of an `if` in a definition are shared by all keys,
and editors show another key's title.
"""
_OCTET = "(?:25[0-5]|2[0-4][0-9]|1[0-9]{2}|[1-9]?[0-9])"
_HOST = rf"(?:{_OCTET}\.){{3}}{_OCTET}"
_GROUP = rf"(?:22[4-9]|23[0-9])(?:\.{_OCTET}){{3}}"
_INTERFACE = r"(?!\.{1,2}$)[A-Za-z0-9_.-]{1,15}"
_IPV6 = "[0-9A-Fa-f]*(?::[0-9A-Fa-f]*){2,8}(?:[0-9]+(?:\\.[0-9]+){3})?"
"""An IPv6 address, and some text that is none: that is left to the parser."""
_LOCAL_IPV6 = rf"{_IPV6}(?:%[A-Za-z0-9_.-]{{1,15}})?"
_LABEL = "[A-Za-z0-9](?:[A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_PORT = "(?:[1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
_NUMBER = r"[0-9]+(?:\.[0-9]+)?"
_POSITIVE = rf"(?=[0-9.]*[1-9]){_NUMBER}"
_TIME = f"{_POSITIVE} ?(?:{'|'.join(NANOSECONDS)})"
_NAME = "[A-Za-z_][A-Za-z0-9_]*"
_CHECKSUMS = [kind.value for kind in ChecksumKind]
_KEY_PART = r"(?!@)[^/*$#?\s]+"
_SCALAR = ["string", "number", "boolean"]
_FIELDS: Schema = {"propertyNames": ref("field_path"), "additionalProperties": ref("field_value")}
_CHOICE_OR_FIELDS: Schema = {
    "if": {"required": ["map"], "properties": {"map": {"type": _SCALAR}}},
    "then": ref("choice"),
    "else": ref("nested_fields"),
}
_MUST_BE_CHOSEN = "must be an expression, or text as {text: WORD}"


def one_of(kind: str, then: Schema, otherwise: Schema) -> Schema:
    """Return a schema for values of a type, and one for others."""
    return {"if": {"type": kind}, "then": then, "else": otherwise}


def expression(*kinds: str, must_be: str = "an expression") -> Schema:
    return {"type": kinds[0] if len(kinds) == 1 else [*kinds], "minLength": 1, "errorMessage": f"must be {must_be}"}


def _text(pattern: str, must: str, *examples: str) -> Schema:
    """Return the schema of a text that fits a pattern, or contains a variable."""
    shown = {"examples": [*examples]} if examples else {}
    return {"type": "string", "pattern": f"{_VARIABLE}|{pattern}", "errorMessage": f"must {must}", **shown}


def _size(units: Mapping[str, int], *examples: str) -> Schema:
    such = " or ".join(f"'{example}'" for example in examples)
    return _text(f"^{_NUMBER} ?(?:{'|'.join(units)})$", f"be a size with its unit, such as {such}", *examples)


def _rate(pattern: str, most: int, must_be: str) -> Schema:
    limits = {"exclusiveMinimum": 0, "maximum": most, "pattern": f"{_VARIABLE}|{pattern}"}
    return {"type": ["number", "string"], **limits, "errorMessage": f"must be {must_be}"}


def _text_or(otherwise: Schema) -> Schema:
    """Return the schema of literal text, or of something else."""
    return {"if": {"type": "object", "required": ["text"]}, "then": ref("literal_text"), "else": otherwise}


VALUES: Schema = {
    "variable": {"type": "string", "pattern": _VARIABLE},
    "address": _text(
        rf"^(?:{_HOST}|\[{_LOCAL_IPV6}\]):{_PORT}$",
        "be an IP address and a port, such as '192.168.0.30:8' or '[fd00::30]:8'",
    ),
    "endpoint_address": _text(
        rf"^(?:(?:{_HOST}|\[{_LOCAL_IPV6}\]|(?:{_LABEL}\.)*(?=[A-Za-z]){_LABEL}):{_PORT}|{_HOST}|{_LOCAL_IPV6}|learned)$",
        "be an IP address or a host name, and a port, such as '192.168.0.30:8' or '[fd00::30]:8', or 'learned'",
    ),
    "device": _text(r"^/\S+$", "be the path of a device, such as '/dev/serial/by-id/usb-board-if00'"),
    "stream_framing": {
        "description": "A framing that is not only a name.",
        "type": ["string", "object"],
        "errorMessage": "must be cobs, slip, hdlc, varint, or a mapping such as {length: u16le}",
        **one_of("string", {"enum": ["cobs", "slip", "hdlc", "varint"]}, mapping({
            "length": key(
                "Length", "The length of each frame, as an unsigned number before it.",
                {"type": "string", "enum": [*LENGTHS]}, "u16le",
            ),
            "hdlc": key(
                "HDLC address", "The address of the frames; frames with another one are bad frames.",
                {"type": "integer", "minimum": 0, "maximum": 127}, 1,
            ),
        }, minProperties=1, maxProperties=1)),
    },
    "checksum": {
        "description": "A checksum whose high byte comes first.",
        "type": ["string", "object"],
        "errorMessage": f"must be one of {', '.join(_CHECKSUMS)}, or a mapping such as {{crc32: be}}",
        **one_of("string", {"enum": _CHECKSUMS}, mapping(
            {name: key(name, "Its high byte comes first.", {"const": "be"}) for name in _CHECKSUMS},
            minProperties=1, maxProperties=1,
        )),
    },
    "network": _text(
        f"^(?:{_HOST}/(?:3[0-2]|[12]?[0-9])|{_IPV6}/(?:1[01][0-9]|12[0-8]|[1-9]?[0-9]))$",
        "be a network, such as '127.0.0.0/8' or 'fd00::/8'",
    ),
    "group": _text(
        f"^(?:{_GROUP}|[Ff]{{2}}{_IPV6})$",
        "be a multicast group, from 224.0.0.0 to 239.255.255.255 or in ff00::/8, such as '224.5.23.2'",
    ),
    "interface": _text(f"^{_INTERFACE}$", "be the name of a network interface, such as 'wlan0'"),
    "path": {
        **TEXT,
        "pattern": r"^(?!~(?:/|$))(?!.*\$\(?[A-Za-z_])",
        "errorMessage": "must be a path, with variables as ${NAME}",
    },
    "node_name": _text(f"^{_NAME}$", "begin with a letter or '_' and continue with letters, digits and '_'"),
    "namespace": _text(
        f"^(?:/|(?:/{_NAME})+)$", "begin with '/' and have letters, digits and '_' between its slashes"
    ),
    "service_name": _text(
        f"^(?:~/|/)?{_NAME}(?:/{_NAME})*$",
        "be the name of a ROS service: letters, digits and '_', with '/' between parts",
    ),
    "locator": _text(r"^[a-z][a-z0-9_-]*/\S+$", "be a Zenoh locator, such as 'tcp/192.168.0.10:7447'"),
    "key_prefix": _text(
        f"^{_KEY_PART}(?:/{_KEY_PART})*$",
        "be names joined by '/', such as 'rovers/rover_1', without '*', '$', '#', '?' or a leading '@'",
    ),
    "zenoh_config": expression("string", "object", must_be="a mapping, or the path of a Zenoh configuration file"),
    "duration": _text(
        f"^{_TIME}$", "be a duration above zero with its unit, such as '500ms' or '1.5 s'", "500ms", "2s"
    ),
    "patience": _text(f"^never$|^{_TIME}$", "be a time with its unit, such as '5s', or 'never'"),
    "period": _text(f"^each$|^{_TIME}$", "be a time with its unit, such as '500ms', or 'each'", "500ms", "each"),
    "age_limit": one_of(
        "object",
        mapping({"none": key(
            "None", "Why messages of any age may leave.", REASON, "it stops the rover at any age",
            must="be a text that says why messages of any age may leave",
        )}, required=["none"]),
        ref("duration"),
    ),
    "size": _size(BYTES, "4MiB", "64kB"),
    "disk_size": _size(DISK_BYTES, "256MiB", "4GiB"),
    "data_rate": _text(
        f"^{_POSITIVE} ?(?:{'|'.join(BYTES)})/s$",
        "be bytes per second above zero with their unit, such as '500kB/s' or '1 MiB/s'",
    ),
    "rate": _rate(f"^{_NUMBER} ?Hz$", 1_000_000, "a rate above zero, such as '30 Hz' or 0.5"),
    "topic_rates": {"type": "object", "additionalProperties": ref("topic_rate")},
    "topic_rate": key(
        "Rate", "How often a matching topic is sent: a rate, or 'each' for every message.",
        _rate(f"^(?:each|{_NUMBER} ?Hz)$", 1000, "a rate above zero and up to 1000 Hz, such as '50 Hz', or 'each'"),
        "50 Hz", "each",
    ),
    "topic_pattern": key(
        "Pattern",
        "A glob over absolute topic names ('*' within a part, '**' for any number of parts, '?' for one character), or "
        "{regex: ...} for the whole name.",
        {"type": ["string", "object"], "minLength": 1, "if": {"type": "object"}, "then": mapping({"regex": key(
            "Regular expression", "A Python regular expression that must match the whole of an absolute name.", TEXT,
            "/imu/(front|rear)",
        )}, required=["regex"])},
        "/rover/**", "/imu/*",
        must="be a glob such as '/rover/**', or {regex: ...}",
    ),
    "condition": {"type": ["string", "boolean"], "errorMessage": "must be an expression"},
    "constant": expression("string", "number", "boolean", must_be="a constant"),
    "part_expression": expression("string", "number", must_be="an expression over the message"),
    "list_expression": expression(
        "string", must_be='an expression that gives a list, such as detections or "[left, right]"'
    ),
    "expression": key(
        "Expression", "The value of a field: an expression over the source message, or a list of them.",
        {"type": [*_SCALAR, "array"], "items": _text_or({"type": _SCALAR, "errorMessage": _MUST_BE_CHOSEN})},
        "accel_x", "radians(gyro_x)", "'imu_link'",
        must="be an expression or a list of expressions",
    ),
    "field_path": {
        "pattern": rf"^{_NAME}(?:\.{_NAME})*$",
        "errorMessage": "must be a field's name, or several with '.' between them",
    },
    "field_value": one_of("object", {
        "if": {"required": ["each"], "properties": {"each": {"type": _SCALAR}}},
        "then": ref("elements"),
        "else": _CHOICE_OR_FIELDS,
    }, one_of("array", ref("list"), ref("expression"))),
    "list": key(
        "List", "The elements of a list: an expression each, or the fields of a message.",
        {"type": "array", "items": one_of("object", _CHOICE_OR_FIELDS, {
            "type": _SCALAR, "errorMessage": "must be an expression, or the fields of a message",
        })},
        ["gyro_x", "gyro_y"], [{"id": 3, "forward": "linear.x"}, {"id": 4}],
    ),
    "elements": key("Each", "Fills a list of messages with one message for each of another list.", mapping({
        "each": key(
            "Each", "The list of messages: a field, or an expression.",
            {"type": _SCALAR, "minLength": 1}, "robots_blue",
        ),
        "fields": key(
            "Fields",
            "The fields of one message. Names are fields of the message in the other list; `item` is that message, and "
            "`message` the source message.",
            {"allOf": [ref("fields")]}, {"x": "x / 1000"},
        ),
    }, required=["each", "fields"])),
    "nested_fields": key(
        "Fields", "The fields of a nested message, each with its expression.",
        {"type": "object", "minProperties": 1, **_FIELDS},
    ),
    "fields": {
        **about(FieldMap),
        "type": ["string", "object"],
        "default": "auto",
        **one_of("string", {"enum": ["auto"], "errorMessage": about(FieldMap)["errorMessage"]}, {
            **_FIELDS,
            "properties": {"auto": key(
                "Auto", "Fields of the same name on both sides are copied unless they are listed here.",
                {**BOOLEAN, "default": False},
            )},
        }),
    },
    "constants": key(
        "Constants",
        "The payload's fields, each with a constant expression, because there is no message to read values from.",
        {"type": "object", **_FIELDS},
        must="be a mapping of its fields to constants, or {} for their defaults",
    ),
    "beside": {
        "type": "object",
        "minProperties": 1,
        **_FIELDS,
        "errorMessage": "must be a mapping of the envelope's fields, such as {seq: sequence, robot: 3}",
    },
    "payloads": {
        "type": "object",
        "minProperties": 1,
        "additionalProperties": ref("constants"),
        "errorMessage": "must be a payload case with its fields, such as {manual_brake: {brake: true}}",
    },
    "choice": key("Map", "Chooses a value by another one: each entry is a possible value and its result.", {
        "type": "object",
        "minProperties": 2,
        "additionalProperties": ref("chosen"),
        "properties": {
            "map": key(
                "Map", "The expression whose value chooses, such as a field with an enum.",
                {"type": _SCALAR, "minLength": 1}, "fix_quality",
            ),
            "else": key(
                "Else",
                "The result for every other value, including numbers that the enum does not name. Without it all "
                "values must be listed.",
                ref("chosen"), 0, {"text": "unknown"},
            ),
        },
    }, must="list values and their results, in addition to 'map'"),
    "chosen": key("Chosen value", "The result for a value: an expression, or `{text: WORD}`.", _text_or({
        "type": [*_SCALAR, "array"], "errorMessage": _MUST_BE_CHOSEN, "allOf": [ref("expression")],
    })),
    "literal_text": key("Text", "Literal text, without extra quotes.", mapping(
        {"text": key("Text", "The text, without extra quotes.", {"type": "string"}, "imu_link")}, required=["text"],
    )),
}  # fmt: skip
