"""The shape of a table: checked by the JSON Schema, with errors as findings in words.

The schema carries the words: `errorMessage` ("must be ...", which editors show as well) beside the keyword. A misspelt
key is one mistake: it is reported and then read as the key that was meant, so that nothing is found missing on its
account.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from router.assets import asset
from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, nearest
from router.table.addresses import BadAddressError, parse_address
from router.table.nodes import Entry, MappingNode, Node, Path, ScalarNode, cut_off, key_at, node_at, rewritten, to_data
from router.table.reading import mapping
from router.table.units import meant_quantity

if TYPE_CHECKING:
    from jsonschema import ValidationError
    from jsonschema.protocols import Validator

SCHEMA = "schemas/route-table.schema.json"
_TYPES = {
    "object": "a mapping",
    "array": "a list",
    "string": "text",
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
}
_LONGEST = 60
_ADDRESSES = ("address", "udp", "tcp", "websocket", "receive")
"""Keys under which an address stands."""
_NAME_DEPTH = len(("endpoints", "name"))
_HINTS_FOR_MISSING = {
    "source": "or say 'ignore: why'",
    "transport": "or say 'ignore: why'",
    "receive": "what its client publishes has to arrive somewhere",
}
_BELONG_TOGETHER = ("envelope", "listen", "routes")
_HINT_FOR_WHOLE = "'envelope', 'listen' and 'routes' belong together; a table with 'gateways' only needs none of them"
NAME_FIELDS = ("fields", "send")
"""Keys under which the names of fields stand, each with an expression."""


@dataclass(frozen=True, slots=True)
class SchemaError:
    """What of jsonschema's error is used: `value` at `path` fails `keyword: limit` of `schema`.

    With `about_name` the value is the name of the last key of the path.
    """

    path: Path
    keyword: str
    limit: Any
    value: object
    schema: Mapping[str, Any]
    message: str
    about_name: bool

    @classmethod
    def of(cls, raised: ValidationError) -> SchemaError:
        about_name = "propertyNames" in raised.absolute_schema_path
        path: Path = tuple(raised.absolute_path)
        if about_name:
            path = (*path, str(raised.instance))
        schema = raised.schema if isinstance(raised.schema, Mapping) else {}
        keyword, limit = str(raised.validator), raised.validator_value
        return cls(path, keyword, limit, raised.instance, schema, raised.message, about_name)

    @property
    def is_about_keys(self) -> bool:
        """The mapping is one, but some of its keys are missing or too many."""
        return self.keyword in ("required", "additionalProperties")


def table_schema() -> dict[str, Any]:
    """The schema as data."""
    return _schema(SCHEMA)


@functools.lru_cache
def _schema(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads(asset(name).read_text(encoding="utf-8"))
    return schema


def check_shape(root: MappingNode, findings: list[Diagnostic]) -> MappingNode:
    """The tree with misspelt keys put right and everything that has a finding marked broken."""
    tree: Node = root
    found = schema_errors(tree, SCHEMA)
    while unknown := [error for error in found if error.keyword == "additionalProperties"]:
        repairs = {}
        for error in unknown:
            known = list(error.schema["properties"])
            findings.extend(_unknown_keys(node_at(tree, error.path), error.path, known))
            repairs[error.path] = functools.partial(_with_known_keys, known=known)
        tree = rewritten(tree, repairs)
        found = schema_errors(tree, SCHEMA)
    rests = {error.path for error in found if _is_rest(tree, error.path)}
    found = [error for error in found if error.path not in rests]
    findings.extend(finding(error, tree) for error in found if not _is_broken(tree, error.path))
    tree = rewritten(tree, {error.path: _as_broken for error in found})
    return mapping(rewritten(tree, {path[:-1]: _without_rests for path in rests}))


def schema_errors(tree: Node, schema: str) -> list[SchemaError]:
    """Where a tree does not fit a schema of ours, which is named by its file.

    One error for each value, that of its type before any other; each missing key is one of its own.
    """
    data: Any = to_data(tree)
    found = [SchemaError.of(error) for error in _validator(schema).iter_errors(data)]
    found.sort(key=lambda error: error.keyword != "type")
    first = {(error.path, error.message if error.is_about_keys else ""): error for error in reversed(found)}
    return list(first.values())


@functools.lru_cache
def _validator(schema: str) -> Validator:
    from jsonschema import Draft7Validator, validators  # takes as long to import as everything else of `validate`

    with_exact_end: type[Validator] = validators.extend(Draft7Validator, {"pattern": _pattern})  # type: ignore[no-untyped-call]
    return with_exact_end(_schema(schema))


def _pattern(validator: Validator, pattern: str, instance: object, schema: object) -> Iterator[Exception]:
    """JSON Schema's `$` is the very end of the text; Python's would let a line end follow."""
    from jsonschema import ValidationError

    exact = pattern[:-1] + r"\Z" if pattern.endswith("$") else pattern
    if isinstance(instance, str) and not re.search(exact, instance):
        yield ValidationError(f"{instance!r} does not match {pattern!r}")


def _as_broken(node: Node) -> Node:
    return replace(node, broken=True)


def _is_broken(tree: Node, path: Path) -> bool:
    key = key_at(tree, path)
    return node_at(tree, path).broken or (key is not None and key.broken)


def _is_rest(tree: Node, path: Path) -> bool:
    """There is no value because there is no key: a comma cut it off an expression, which will have a finding."""
    siblings = node_at(tree, path[:-1]) if any(name in path[:-1] for name in NAME_FIELDS) else None
    return isinstance(siblings, MappingNode) and path[-1] in _rests(siblings)


def _without_rests(node: Node) -> Node:
    written = mapping(node)
    rests = _rests(written)
    return replace(written, entries={name: entry for name, entry in written.entries.items() if name not in rests})


def _rests(node: MappingNode) -> set[str]:
    return set(cut_off((name, entry.value) for name, entry in node.entries.items()))


_ELSEWHERE = {
    "topic": ("name",),
    "type": ("msg", "message", "msg_type", "message_type"),
    "queue_depth": ("queue", "queue_size", "depth"),
    "source": ("src", "from", "sender"),
    "destinations": ("dst", "dest", "target", "targets"),
    "address": ("ip", "host", "port"),
    "fields": ("map", "mapping"),
    "when": ("if", "condition", "filter"),
    "max_rate": ("rate", "hz", "frequency", "throttle"),
    "http": ("metrics", "prometheus"),
    "endpoints": ("boards", "devices", "hosts"),
    "kind": ("type",),
}
"""Keys, and what people who know other programs call them."""


def _meant(name: str, known: Iterable[str]) -> str | None:
    """The key among `known` that a misspelt one stands for."""
    known = list(known)
    return nearest(name, known) or next((key for key in known if name in _ELSEWHERE.get(key, ())), None)


def _unknown_keys(node: Node, path: Path, known: list[str]) -> Iterable[Diagnostic]:
    for name, entry in mapping(node).entries.items():
        if name not in known and not entry.key.broken:
            if ":" in name:
                hint = "a space is missing after ':'"
            elif meant := _meant(name, known):
                hint = f"did you mean '{meant}'?"
            else:
                hint = _owners(name, path) or did_you_mean(name, known)
            yield Diagnostic(entry.key.span, Code.UNKNOWN_KEY, f"{subject(path)} has no key '{name}'", hint)


def _owners(name: str, path: Path) -> str:
    """A hint for a key that there is, but elsewhere in a table; empty where there is no such key.

    Others that are called as what stands at `path` (deadmen are of two kinds) would make no hint.
    """
    definitions = table_schema()["definitions"]
    others = {*path[-1:], "defaults"}
    owners = [owner for owner, schema in definitions.items() if _has(schema, name) and owner not in others]
    return f"that is a key of: {', '.join(owners)}" if owners else ""


def _has(schema: Any, name: str) -> bool:
    return any(name in part.get("properties", ()) for part in (schema, schema.get("then", {}), schema.get("else", {})))


def _with_known_keys(node: Node, known: list[str]) -> Node:
    written = mapping(node)
    entries: dict[str, Entry] = {}
    broken = written.broken
    for name, entry in written.entries.items():
        meant = name if name in known else _meant(name, (key for key in known if key not in written.entries))
        if meant is None or (meant != name and meant in entries):
            broken = True  # what the key was to say is lost
        else:
            entries[meant] = entry
    return replace(written, entries=entries, broken=broken)


# Messages


def finding(error: SchemaError, tree: Node) -> Diagnostic:
    """The finding for anything but an unknown key of a closed mapping."""
    path, keyword = error.path, error.keyword
    key = key_at(tree, path)
    name = subject(path)
    if error.about_name:
        return _bad_name(error, key.span if key else _first_line(tree))
    span = _blamed(tree, path)
    if keyword == "required":
        return _missing_key(error, tree)
    if keyword == "type":
        return Diagnostic(span, Code.WRONG_TYPE, f"{name} {_expected(error)}, not {shown(error.value)}", _remedy(error))
    if keyword == "pattern" and path[-1] in _ADDRESSES:
        return _bad_address(str(error.value), span)
    if keyword == "uniqueItems":
        return _repeated(error, tree)
    code = Code.UNKNOWN_QOS_VALUE if keyword == "enum" and path[-2:-1] == ("qos",) else Code.BAD_VALUE
    if keyword == "maxProperties":
        return Diagnostic(span, code, f"{name} {_expected(error)}, and no other beside it")
    near = nearest(str(error.value), error.limit) if keyword == "enum" else None
    hint = f"did you mean '{near}'?" if near else ""
    if isinstance(error.value, str) and keyword == "pattern":
        hint = meant_quantity(error.value, lambda each: bool(re.search(error.limit, each)))
    if keyword == "minProperties" and "errorMessage" in error.schema:
        return Diagnostic(span, code, f"{name} {_expected(error)}")
    if keyword.startswith("min") and keyword != "minimum":  # minLength, minItems, minProperties
        return Diagnostic(span, code, f"{name} must not be empty")
    return Diagnostic(span, code, f"{name} {_expected(error)}, not {shown(error.value)}", hint)


def _remedy(error: SchemaError) -> str:
    """What to do about a value of the wrong type, where that is clear."""
    name, value = str(error.path[-1]) if error.path else "", error.value
    is_glued = isinstance(value, str) and "object" in error.limit and re.match(r"\w+:\S", value)
    if is_glued or (value is None and ":" in name):
        return "a space is missing after ':'"
    if value is None and any(key in error.path for key in NAME_FIELDS):
        return "a field that is left out keeps its default"
    if value is None and "object" in error.limit:
        return "indent what belongs to it further than it"
    if isinstance(value, str) and error.path[:1] in (("listen",), ("endpoints",)):
        return f"write `{name}: {{address: {value}}}`"
    if error.path[:-1] == ("routes",) and name in table_schema()["definitions"]["route"]["properties"]:
        return f"'{name}' is a key of a route: indent it further than the payload case that it is for"
    return ""


def shown(value: object) -> str:
    """A value as messages name it."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return f"the number {_clipped(str(value))}"
    if isinstance(value, str):
        return f"the text '{_clipped(value)}'"
    return "a mapping" if isinstance(value, dict) else "a list"


def _expected(error: SchemaError) -> str:
    schema, limit = error.schema, error.limit
    if "errorMessage" in schema:
        return str(schema["errorMessage"])
    if error.keyword == "type":
        return "must be " + " or ".join(_TYPES[name] for name in ([limit] if isinstance(limit, str) else limit))
    if error.keyword == "enum":
        return "must be one of " + ", ".join(f"'{word}'" for word in limit)
    if error.keyword in ("minimum", "maximum"):
        return f"must be from {schema['minimum']} to {schema['maximum']}"
    return f"must be {limit}"


def _bad_name(error: SchemaError, span: SourceSpan) -> Diagnostic:
    name = f"'{_clipped(str(error.value))}'"
    if not _is_chosen(error.path):
        return Diagnostic(span, Code.UNKNOWN_KEY, f"{name} {_expected(error)}")
    return Diagnostic(span, Code.BAD_VALUE, f"the name {name} {_expected(error)}")


def _is_chosen(path: Path) -> bool:
    """The key at the path is a name that a person gave, not one of the keys that others of their mapping rule out."""
    return len(path) <= _NAME_DEPTH or any(key in path[_NAME_DEPTH:-1] for key in NAME_FIELDS)


def _missing_key(error: SchemaError, tree: Node) -> Diagnostic:
    missing = error.message.split("'")[1]  # jsonschema has one error for each key and names it nowhere else
    key = key_at(tree, error.path)
    span = key.span if key else _first_line(node_at(tree, error.path))
    is_whole_part = len(error.path) == _NAME_DEPTH
    hint = _HINTS_FOR_MISSING.get(missing, "") if is_whole_part else ""
    if not error.path and missing in _BELONG_TOGETHER:
        hint = _HINT_FOR_WHOLE
    return Diagnostic(span, Code.MISSING_KEY, f"{subject(error.path)} lacks the key '{missing}'", hint)


def _bad_address(text: str, span: SourceSpan) -> Diagnostic:
    try:
        parse_address(text)
    except BadAddressError as error:
        return Diagnostic(span, Code.BAD_ADDRESS, error.what, error.hint)
    raise AssertionError(f"the schema refuses the address '{text}', parse_address takes it")


def _repeated(error: SchemaError, tree: Node) -> Diagnostic:
    items = error.value if isinstance(error.value, list) else []
    index = next(index for index, item in enumerate(items) if item in items[:index])
    what = f"{shown(items[index])} stands in {subject(error.path)} twice"
    return Diagnostic(node_at(tree, (*error.path, index)).span, Code.BAD_VALUE, what)


def _blamed(tree: Node, path: Path) -> SourceSpan:
    """The value if it is a word on a line, else the key that it stands under."""
    node = node_at(tree, path)
    key = key_at(tree, path)
    if key is None or (isinstance(node, ScalarNode) and node.span.end_column > node.span.column):
        return _first_line(node)
    return key.span


def _first_line(node: Node) -> SourceSpan:
    """The span of a scalar, or of a collection's first key."""
    if isinstance(node, MappingNode) and node.entries:
        return next(iter(node.entries.values())).key.span
    return node.span


def subject(path: Path) -> str:
    """What stands at a path, as messages name it."""
    names = [step for step in path if isinstance(step, str)]
    if not names:
        return "the table"
    return f"'{names[-1]}'" if isinstance(path[-1], str) else f"an item of '{names[-1]}'"


def _clipped(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
