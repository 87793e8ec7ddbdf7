"""Generate the pages of keys and commands from the schemas of tables and test files and the parsers of the verbs."""

from __future__ import annotations

import argparse
import importlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from router.cli import GROUPS, VERBS

Schema = Mapping[str, Any]


class Section(NamedTuple):
    """A group of keys: those at `path` in a table, declared at `schema` (a dotted path in the schema's document)."""

    heading: str
    path: str
    schema: str


TABLE = (
    Section("Envelope", "envelope", "definitions.envelope"),
    Section("ROS node", "node", "properties.node"),
    Section("HTTP", "http", "properties.http"),
    Section("Recording", "record", "properties.record"),
    Section("Foxglove", "foxglove", "properties.foxglove"),
    Section("Reload", "reload", "properties.reload"),
    Section("Defaults", "defaults", "definitions.defaults"),
    Section("Listeners", "listen.NAME", "definitions.socket"),
    Section("Serial lines", "listen.NAME", "definitions.serial_line"),
    Section("TCP clients", "listen.NAME", "definitions.tcp_client"),
    Section("TCP servers", "listen.NAME", "definitions.tcp_server"),
    Section("Framing", "listen.NAME.framing", "definitions.stream_framing.else"),
    Section("Checksum", "listen.NAME.checksum", "definitions.checksum.else"),
    Section("Endpoints", "endpoints.NAME", "definitions.endpoint"),
    Section("States", "state.NAME", "definitions.state"),
    Section("Services", "services.NAME", "definitions.service.else"),
    Section("Requests of a service", "services.NAME.request", "definitions.service_request"),
    Section("Replies to a service", "services.NAME.reply", "definitions.service_reply"),
    Section("Services that are called", "services.NAME", "definitions.service.then"),
    Section("Messages that call a service", "services.NAME.from", "definitions.service_source"),
    Section("Calls", "services.NAME.call", "definitions.service_call"),
    Section("Replies to the caller", "services.NAME.reply", "definitions.called_reply"),
    Section("Routes", "routes.CASE", "definitions.route"),
    Section("Source topics", "routes.CASE.source", "definitions.source_topic"),
    Section("Destinations", "routes.CASE.destinations", "definitions.destination.then"),
    Section("Replies", "routes.CASE.reply", "definitions.reply.then"),
    Section("Topics", "routes.CASE.topics", "definitions.topic.then"),
    Section("Quality of service", "qos", "definitions.qos.else"),
    Section("Fields", "fields", "definitions.fields.else"),
    Section("Maps", "fields.NAME", "definitions.choice"),
    Section("Each", "fields.NAME", "definitions.elements"),
    Section("Texts", "fields.NAME", "definitions.literal_text"),
    Section("Deadman", "routes.CASE.deadman", "definitions.deadman"),
    Section("Collect", "routes.CASE.collect", "definitions.collect"),
    Section("Gateways", "gateways.NAME", "definitions.gateway"),
    Section("Transport", "gateways.NAME.transport", "definitions.transport"),
    Section("Zenoh", "gateways.NAME.transport.zenoh", "definitions.zenoh"),
    Section("Patterns of topics", "gateways.NAME.topics.include", "definitions.topic_pattern.then"),
    Section("Inbound topics", "gateways.NAME.inbound", "definitions.inbound_topic"),
    Section("Deadman of an inbound topic", "gateways.NAME.inbound.deadman", "definitions.inbound_deadman"),
    Section("Inbound services", "gateways.NAME.inbound", "definitions.inbound_service"),
)
TEST = (
    Section("Tests", "tests.NAME", "definitions.test"),
    Section("Steps", "tests.NAME.steps", "definitions.step"),
    Section("Given", "given", "definitions.given"),
    Section("Expect", "expect", "definitions.expect"),
)
UNITS = {
    "address": "IP address and port",
    "endpoint_address": "IP address or host name, and port",
    "path": "path",
    "duration": "time",
    "age_limit": "time or {none: why}",
    "period": "time or `each`",
    "size": "size",
    "disk_size": "size",
    "data_rate": "bytes per second",
    "patience": "time or `never`",
    "rate": "rate",
    "topic_rate": "rate or `each`",
    "expression": "expression",
    "part_expression": "expression",
    "chosen": "expression or [text](#texts)",
    "list_expression": "expression",
    "condition": "expression",
    "locator": "locator",
    "listener": "[UDP](#listeners), [serial line](#serial-lines), [TCP client](#tcp-clients) or [server](#tcp-servers)",
    "device": "path",
    "stream_framing": "`cobs`, `slip`, `hdlc`, `varint` or [framing](#framing)",
    "checksum": "name or [checksum](#checksum)",
    "topic_pattern": "[patterns](#patterns-of-topics)",
    "constants": "fields with constants",
}
"""The kind of value that a definition of the schema stands for, in words."""
_OR_EACH = re.compile(r"\^(never|each)\$")


@dataclass(frozen=True)
class Row:
    path: str
    value: str
    meaning: str


class SchemaPage:
    """The page of one schema."""

    def __init__(self, schema: Schema, sections: tuple[Section, ...]) -> None:
        self.schema = schema
        self.sections = sections
        self.headings = {section.schema.removeprefix("definitions."): section.heading for section in sections}
        complete = schema["definitions"].get("complete", {"else": {"required": []}})
        self.of_routes = complete["else"]["required"]
        self.required = dict(self._required(schema["definitions"].get("complete", {}), "definitions.complete"))

    def lines(self) -> Iterator[str]:
        yield from self._table(self.schema, "")
        for section in self.sections:
            found = self._at(section.schema)
            outer = self._at(section.schema.removesuffix(".then").removesuffix(".else"))
            yield from ("", f"## {section.heading}", "")
            yield f"At `{section.path}`. {prose(outer.get('description', found.get('description', '')))}"
            yield ""
            if "then" not in section.schema and (examples := outer.get("examples")):
                yield from (f"For example `{section.path.rpartition('.')[2].lower()}: {flow(examples[0])}`.", "")
            yield from self._table(found, section.schema)

    def _table(self, found: Schema, name: str) -> Iterator[str]:
        yield from ("| key | value | meaning |", "|---|---|---|")
        for row in self._rows(found, name, ""):
            yield f"| `{row.path}` | {row.value} | {row.meaning} |"

    def _rows(self, found: Schema, name: str, prefix: str) -> Iterator[Row]:
        required = {*found.get("required", ()), *self.required.get(name.removesuffix(".then"), ())}
        for key, declared in found.get("properties", {}).items():
            key_schema = self._resolved(declared)
            path = f"{prefix}{key}"
            value, meaning = self._value(declared, name, key), key_schema.get("description", "")
            if "](" in value and "$ref" in declared:  # the linked section has the rest
                meaning = re.sub(r"(?<=\w\.) [A-Z].*", "", meaning)
            if key in required:
                value += "; required"
                if found is self.schema and key in self.of_routes:
                    value += ", unless the table has gateways only"
            elif "default" in key_schema:
                value += f"; by default `{flow(key_schema['default'])}`"
            yield Row(path, value, prose(meaning))
            if "$ref" not in declared and "properties" in declared and name:
                yield from self._rows(declared, "", f"{path}.")

    def _value(self, declared: Schema, name: str, key: str) -> str:
        value = self._kind(declared)
        if not name and f"properties.{key}" in self.headings:
            return f"[keys](#{slug(self.headings[f'properties.{key}'])})"
        found = self._resolved(declared)
        if (examples := found.get("examples")) and "`" not in value and "](" not in value and not found.get("default"):
            value += f", such as `{flow(examples[0])}`"
        return value.replace("|", r"\|")

    def _kind(self, declared: Schema) -> str:
        """Return the kind of a value, in words."""
        for reference in [declared, *declared.get("allOf", ())]:
            if "$ref" in reference:
                return self._definition(reference["$ref"].rpartition("/")[2])
        if "const" in declared:
            return f"`{flow(declared['const'])}`"
        if "enum" in declared:
            return ", ".join(f"`{value}`" for value in declared["enum"])
        if declared.get("if") == {"type": "array"}:
            return f"{self._kind(declared['else'])}, or a list"
        if "if" in declared and "else" in declared and "type" not in declared:
            return self._kind(declared["else"])
        if found := _OR_EACH.search(declared.get("pattern", "")):
            return f"time or `{found[1]}`"
        if "s|min|h" in declared.get("pattern", ""):
            return "time"
        if "Hz" in declared.get("pattern", ""):
            return "rate"
        kinds = declared.get("type", "value")
        return " or ".join(self._type(kind, declared) for kind in ([kinds] if isinstance(kinds, str) else kinds))

    def _type(self, kind: str, declared: Schema) -> str:
        if kind == "array":
            items = self._kind(declared["items"]) if "items" in declared else "value"
            return f"list of {items}s" if items.isalpha() else f"list of {items}"
        if kind == "object" and isinstance(of := declared.get("additionalProperties"), Mapping):
            return f"by name: {self._kind(of)}"
        if kind == "boolean":
            return "`true`, `false`"
        if kind == "integer" and "maximum" in declared:
            return f"{declared['minimum']} to {declared['maximum']}"
        return {"string": "text", "object": "mapping", "integer": "number"}.get(kind, kind)

    def _definition(self, name: str) -> str:
        if name in UNITS:
            return UNITS[name]
        for schema in (name, f"{name}.then", f"{name}.else"):
            if schema in self.headings:
                heading = self.headings[schema]
                short = "name or " if schema.endswith(".then") else ""
                return f"{short}[{heading if heading == 'Zenoh' else heading.lower()}](#{slug(heading)})"
        if name == "source":
            return "endpoint, `any`, or [source topic](#source-topics)"
        if name == "inbound":
            return "[inbound topics](#inbound-topics) and [inbound services](#inbound-services)"
        if name == "case":
            return "[route](#routes), or a list"
        return self._kind(self.schema["definitions"][name])

    def _resolved(self, declared: Schema) -> Schema:
        """Return the declaration merged with the target of its `$ref`."""
        for reference in [declared, *declared.get("allOf", ())]:
            if "$ref" in reference:
                return {**self._resolved(self._at(reference["$ref"].removeprefix("#/").replace("/", "."))), **declared}
        return declared

    def _at(self, name: str) -> Schema:
        found = self.schema
        for key in name.split("."):
            found = found[key]
        return found

    def _required(self, found: Schema, name: str) -> Iterator[tuple[str, list[str]]]:
        """The required keys of a complete table, by the path of their declaration."""
        complete = self.schema["definitions"]
        if not complete.get("complete"):
            return
        rules = complete["complete"]["properties"]
        yield "", ["version", *complete["complete"]["else"]["required"]]
        for key in ("envelope", "http", "record", "foxglove"):
            yield f"properties.{key}", rules[key]["required"]
        listener = rules["listen"]["additionalProperties"]
        tcp = listener["else"]
        yield "definitions.serial_line", [*listener["if"]["required"], *listener["then"]["required"]]
        yield "definitions.tcp_client", ["connect", *tcp["then"]["required"]]
        yield "definitions.tcp_server", ["accept", *tcp["then"]["required"]]
        yield "definitions.socket", tcp["else"]["required"]
        yield "definitions.endpoint", rules["endpoints"]["additionalProperties"]["required"]
        yield "definitions.state", rules["state"]["additionalProperties"]["required"]
        service = rules["services"]["additionalProperties"]
        for form in ("then", "else"):
            yield f"definitions.service.{form}", service[form]["required"]
        inner = {form: service[form]["properties"] for form in ("then", "else")}
        yield "definitions.service_request", inner["else"]["request"]["required"]
        yield "definitions.service_reply", inner["else"]["reply"]["required"]
        yield "definitions.service_source", inner["then"]["from"]["required"]
        yield "definitions.service_call", inner["then"]["call"]["required"]
        yield "definitions.called_reply", inner["then"]["reply"]["required"]
        route, gateway = complete["complete_route"]["else"], complete["complete_gateway"]["else"]
        yield "definitions.route", route["required"]
        yield "definitions.deadman", route["properties"]["deadman"]["else"]["required"]
        yield "definitions.collect", route["properties"]["collect"]["required"]
        yield "definitions.gateway", gateway["required"]
        yield "definitions.zenoh", gateway["properties"]["transport"]["properties"]["zenoh"]["required"]


def table_keys(schema: Schema) -> str:
    return "\n".join([*SchemaPage(schema, TABLE).lines(), ""])


def test_keys(schema: Schema) -> str:
    return "\n".join([*SchemaPage(schema, TEST).lines(), ""])


def slug(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def flow(value: object) -> str:
    """Return a value as written in a table, on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)}: {flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    return value if isinstance(value, str) else json.dumps(value)


def _key(key: str) -> str:
    return json.dumps(key) if key.startswith("/") else key


def prose(text: str) -> str:
    """Return a schema's description as Markdown for a table cell: quoted text becomes code."""
    text = re.sub(r"(?<!\w)'([^']+)'(?!\w)", r"`\1`", text)
    parts = re.split(r"(`[^`]*`)", text)
    plain = [part if part.startswith("`") else re.sub(r"([*<])", r"\\\1", part) for part in parts]
    return "".join(plain).replace("|", r"\|")


# -- commands ------------------------------------------------------------------------------------------------------


def commands() -> Iterator[str]:
    """Every verb with its options and examples, in the groups of `router`."""
    yield from ("| command | |", "|---|---|")
    for verb, summary in VERBS.items():
        yield f"| [`router {verb}`](#router-{verb}) | {summary} |"
    for group, verbs in GROUPS.items():
        for verb in verbs:
            yield from _verb(group, verb)


def _verb(group: str, verb: str) -> Iterator[str]:
    parser = argparse.ArgumentParser(prog="router")
    subparsers = parser.add_subparsers()
    importlib.import_module(f"router.cli.{verb}").add_parser(subparsers)
    yield from _parser(subparsers.choices[verb], f"## router {verb}")


def _parser(parser: argparse.ArgumentParser, heading: str) -> Iterator[str]:
    more, _, examples = (parser.epilog or "").partition("examples:\n")
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    yield from ("", heading, "", _paragraph(parser.description or ""))
    for part in more.strip().split("\n\n"):
        if part.strip():
            yield from ("", *(["```text", part, "```"] if "\n  " in part else [_paragraph(part)]))
    if not inner:
        yield from ("", "```text", *(line.strip() for line in examples.splitlines()), "```", "")
        yield from _options(parser)
    for action in inner:
        for name, each in action.choices.items():
            yield from _parser(each, f"{heading} {name}".replace("## ", "### ", 1))


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    rows = [(_name(action), _help(action, parser)) for action in parser._actions if action.dest != "help"]
    if rows:
        yield from ("| argument | |", "|---|---|", *(f"| {name} | {meaning} |" for name, meaning in rows))


def _name(action: argparse.Action) -> str:
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if action.choices is not None and action.metavar is None:
        value = "|".join(map(str, action.choices)).replace("|", r"\|")
    if not action.option_strings:
        dots = "..." if action.nargs in ("*", "+") else ""
        return f"`{value}{dots}`" if action.nargs not in ("?", "*") else f"`[{value}{dots}]`"
    values = "" if action.nargs == 0 else f" {value}..." if action.nargs in ("*", "+") else f" {value}"
    return ", ".join(f"`{option}{values}`" for option in action.option_strings)


def _help(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    formatter = argparse.HelpFormatter(parser.prog)
    return _paragraph(formatter._expand_help(action) if action.help else "")


def _paragraph(text: str) -> str:
    return prose(" ".join(text.split()))
