"""Check of a table's shape against its schema, with errors as findings.

The schema contains their text: `errorMessage` ("must be ...", which editors also show) beside the keyword. A misspelt
key is reported and then read as the key that was meant, so that this key is not also reported as missing.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from functools import partial

from router.errors import Code, Diagnostic, SourceSpan, nearest
from router.table import key_hints
from router.table.addresses import BadAddressError, parse_address, parse_endpoint
from router.table.compose import resolve, truth_of
from router.table.nodes import Entry, MappingNode, Node, Path, ScalarNode, cut_off, key_at, node_at, rewritten
from router.table.reading import mapping, scalar
from router.table.schema import SCHEMA, SchemaError, keys_of, schema_errors, table_schema

_TYPES = {
    "object": "a mapping",
    "array": "a list",
    "string": "text",
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
}
_LONGEST = 60
_NAME_DEPTH = len(("endpoints", "name"))
_NAMED_PARTS = {
    "listen": ("listener", "a"),
    "endpoints": ("endpoint", "an"),
    "routes": ("route", "a"),
    "gateways": ("gateway", "a"),
}
"""Mappings whose keys are names, and the noun for an entry with its article."""
_HINTS_FOR_MISSING = {
    "source": "name who sends it: an endpoint, or {topic: NAME} for ROS; or write 'ignore: why'",
    "kind": "add `kind: board`, `kind: basestation` or `kind: tool`",
    "transport": "add it, or write 'ignore: why'",
    "version": "start with 'version: 1'",
    "message": "name the protobuf message of each datagram, as in `message: PBEnvelope`",
    "oneof": "name the oneof whose members are the payload cases, as in `oneof: payload`; "
    "or, if a datagram is itself the message, write `case: NAME` instead",
    "fields": "add the fields of one message, as in `fields: {x: x / 1000}` or `fields: auto`",
    "receive": "add the local address that receives what its client publishes: `receive: IP:PORT`",
    "directory": "add the folder for recordings, as in `directory: ../recordings`",
}
_BELONG_TOGETHER = ("envelope", "listen", "routes")
_HINT_FOR_WHOLE = "write 'envelope', 'listen' and 'routes'; or, for a table without datagrams, only 'gateways'"


def check_shape(root: MappingNode, findings: list[Diagnostic]) -> MappingNode:
    """Return the tree with misspelt keys corrected and everything that has a finding marked broken."""
    errors = schema_errors(root, SCHEMA)
    filled = {error.path: partial(_as_taken, kinds=error.limit) for error in errors if _is_filled(error, root)}
    if filled:
        root = mapping(rewritten(root, filled))
        errors = schema_errors(root, SCHEMA)
    if not errors:
        return root
    tree = _with_deep_keys(root, {error.path[:2] for error in errors}, findings)
    if tree is not root:
        errors = schema_errors(tree, SCHEMA)
    while unknown := [error for error in errors if error.keyword == "additionalProperties"]:
        repairs = {}
        empty = {error.path for error in errors if error.lacks_mapping}
        for error in unknown:
            known = list(error.schema["properties"])
            findings.extend(unknown_keys(tree, error.path, known, subject(error.path), empty))
            repairs[error.path] = partial(_with_known_keys, path=error.path, known=known)
        tree = rewritten(tree, repairs)
        errors = schema_errors(tree, SCHEMA)
    rests = {error.path for error in errors if _is_rest(tree, error.path)}
    errors = [error for error in errors if error.path not in rests]
    _explain_words(errors, tree, findings)
    implied = _consequences(errors)
    findings.extend(
        finding(error, tree) for error in errors if error not in implied and not _is_broken(tree, error.path)
    )
    tree = rewritten(tree, {error.path: _as_broken for error in errors})
    return mapping(rewritten(tree, {path[:-1]: _without_rests for path in rests}))


def _is_filled(error: SchemaError, tree: Node) -> bool:
    """Return whether the value of the wrong type comes from a variable, which has no type."""
    node = node_at(tree, error.path) if error.keyword == "type" and not error.about_name else None
    return isinstance(node, ScalarNode) and node.is_filled


def _as_taken(node: Node, kinds: str | list[str]) -> Node:
    """Return a scalar from a variable with the value that a key for `kinds` of values takes, quoted or not."""
    written = scalar(node)
    return replace(written, value=written.text if "string" in kinds else resolve(written.text))


def _explain_words(errors: list[SchemaError], tree: Node, findings: list[Diagnostic]) -> None:
    """Replace the finding for an ambiguous word, such as `yes`, that is wrong as a truth value and as text."""
    ambiguous = {earlier.span: index for index, earlier in enumerate(findings) if earlier.code is Code.AMBIGUOUS_SCALAR}
    for error in errors:
        node = None if error.about_name or error.is_about_keys else node_at(tree, error.path)
        if not isinstance(node, ScalarNode) or node.span not in ambiguous or "boolean" in str(error.limit):
            continue
        if (truth := truth_of(node.text)) is not None:
            meant = replace(error, value=truth) if error.keyword == "type" else error
            findings[ambiguous[node.span]] = finding(meant, tree)


def _with_deep_keys(tree: Node, wrong: Container[Path], findings: list[Diagnostic]) -> Node:
    """Return the tree without keys of routes, endpoints and so on that are beside these because of wrong indentation.

    `wrong` are the paths of parts with errors. Each such key is reported, and the part that it belongs to is broken.
    """
    for part, (kind, article) in _NAMED_PARTS.items():
        node = node_at(tree, (part,)) if part in mapping(tree).entries else None
        if not isinstance(node, MappingNode):
            continue
        entries: dict[str, Entry] = {}
        for name, entry in node.entries.items():
            is_key = (part, name) in wrong and name in keys_of(table_schema()["definitions"][kind])
            before = _above(entry, entries) if is_key else None
            if before is None:
                entries[name] = entry
                continue
            message, hint = f"'{name}' is a key of {article} {kind}", f"indent it further than '{before}'"
            findings.append(Diagnostic(entry.key.span, Code.UNKNOWN_KEY, message, hint))
            entries[before] = replace(entries[before], value=_as_broken(entries[before].value))
        if len(entries) < len(node.entries):
            tree = rewritten(tree, {(part,): partial(_with_entries, entries=entries)})
    return tree


def _with_entries(node: Node, entries: Mapping[str, Entry]) -> Node:
    return replace(mapping(node), entries=dict(entries))


def _above(entry: Entry, entries: Mapping[str, Entry]) -> str | None:
    """Return the name of the last of `entries` above an entry in the same file."""
    span = entry.key.span
    above = {other.key.span.line: name for name, other in entries.items() if other.key.span.file == span.file}
    return above[max(lines)] if (lines := [line for line in above if line < span.line]) else None


def _consequences(errors: list[SchemaError]) -> list[SchemaError]:
    """Return errors that are consequences of another one, which is reported.

    These are all but the first of several lists in a list, and errors below `send` or `reply` if it has several payload
    cases or one without fields.
    """
    empty = [error.path for error in errors if error.lacks_mapping and error.path[-2:-1] == ("send",)]
    groups = [path[:-1] for path in empty]
    consequences = [error for error in errors if error.path not in empty and {error.path, error.path[:-1]} & {*groups}]
    too_many = [error.path for error in errors if error.keyword == "maxProperties"]
    several = [path for path in too_many if path[-1] in ("send", "reply")]
    consequences += [error for error in errors if error.path[:-1] in several and error.path[:-1] not in groups]
    rows: dict[Path, SchemaError] = {}
    lists = [error for error in errors if error.is_list_in_list]
    consequences += [error for error in lists if rows.setdefault(error.path[:-1], error) is not error]
    return consequences


def _as_broken(node: Node) -> Node:
    return replace(node, broken=True)


def _is_broken(tree: Node, path: Path) -> bool:
    key = key_at(tree, path)
    return node_at(tree, path).broken or (key is not None and key.broken)


def _is_rest(tree: Node, path: Path) -> bool:
    """Return whether the key at `path` is the rest of an expression cut by a comma, which has its own finding."""
    siblings = node_at(tree, path[:-1]) if any(name in path[:-1] for name in key_hints.NAME_FIELDS) else None
    return isinstance(siblings, MappingNode) and path[-1] in _rests(siblings)


def _without_rests(node: Node) -> Node:
    written = mapping(node)
    rests = _rests(written)
    return replace(written, entries={name: entry for name, entry in written.entries.items() if name not in rests})


def _rests(node: MappingNode) -> set[str]:
    return set(cut_off((name, entry.value) for name, entry in node.entries.items()))


def unknown_keys(
    tree: Node, path: Path, known: list[str], owner: str, empty: Container[Path] = (), schema: str = SCHEMA
) -> Iterator[Diagnostic]:
    """Yield a finding for each key of the mapping at `path` that is not `known`. `schema` is that of the file.

    Keys after one of the paths in `empty` are not reported: they belong below it and are not indented.
    """
    said = set()
    entries = mapping(node_at(tree, path)).entries
    before: tuple[str, Entry] | None = None
    for name, entry in entries.items():
        if (*path, name) in empty:
            return
        if name in known or entry.key.broken:
            before = name, entry
            continue
        written = [key for key, other in entries.items() if other.key.span.file == entry.key.span.file]
        free = [key for key in known if key not in written]
        advice = key_hints.behind(name, entry, before) or key_hints.of_topic(name, entry, entries)
        advice = advice or key_hints.for_common_mistake(name, known)
        fitting = free if key_hints.meant(name, free) else known
        hint = advice or key_hints.for_key(name, entry.value, path, fitting, schema)
        if hint not in said:
            yield Diagnostic(entry.key.span, Code.UNKNOWN_KEY, f"{owner} has no key '{name}'", hint)
        said.add(key_hints.for_common_mistake(name, known) or None)


def _with_known_keys(node: Node, path: Path, known: list[str]) -> Node:
    written = mapping(node)
    entries: dict[str, Entry] = {}
    broken = written.broken
    for name, entry in written.entries.items():
        free = [] if key_hints.for_common_mistake(name, known) else [key for key in known if key not in written.entries]
        meant = name if name in known else key_hints.meant(name, free)
        is_part = key_hints.is_topics_of_source(name, path) and not isinstance(entry.value, ScalarNode)
        if meant is None or (meant != name and meant in entries) or is_part:
            broken = True  # the key's content is lost
        else:
            entries[meant] = entry
    if any(key_hints.of_topic(name, entry, written.entries) for name, entry in written.entries.items()):
        entries["topic"] = replace(entries["topic"], value=_as_broken(entries["topic"].value))
    if "address" in entries and any(name in written.entries for name in key_hints.ADDRESS_PARTS):
        entries["address"] = replace(entries["address"], value=_as_broken(entries["address"].value))
    return replace(written, entries=entries, broken=broken)


# Messages


def finding(error: SchemaError, tree: Node) -> Diagnostic:
    """Return the finding for any error except an unknown key of a closed mapping."""
    path, keyword = error.path, error.keyword
    key = key_at(tree, path)
    name = subject(path)
    if error.about_name:
        return _bad_name(error, key.span if key else _first_line(tree))
    span = _span_of(tree, path)
    if keyword == "required":
        return _missing_key(error, tree)
    if keyword == "type":
        what = f"{name} {_expected(error)}, not {shown(error.value)}"
        return Diagnostic(span, Code.WRONG_TYPE, what, key_hints.for_type(error, tree))
    if keyword == "pattern" and path[-1] in key_hints.ADDRESSES:
        return _bad_address(str(error.value), span, is_endpoint=path[0] == "endpoints" and path[-1] == "address")
    if keyword == "uniqueItems":
        return _repeated(error, tree)
    code = Code.UNKNOWN_QOS_VALUE if keyword == "enum" and path[-2:-1] == ("qos",) else Code.BAD_VALUE
    if keyword == "maxProperties":
        count = len(error.value) if isinstance(error.value, dict) else 0
        return Diagnostic(span, code, f"{name} has {count} keys; it {_expected(error)}")
    hint = key_hints.for_value(error)
    if keyword == "minProperties" and "errorMessage" in error.schema:
        return Diagnostic(span, code, f"{name} {_expected(error)}")
    if keyword.startswith("min") and keyword != "minimum":  # minLength, minItems, minProperties
        return Diagnostic(span, code, f"{name} must not be empty")
    return Diagnostic(span, code, f"{name} {_expected(error)}, not {shown(error.value)}", hint)


def shown(value: object) -> str:
    """Describe a value for messages."""
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
    if "enum" in schema:
        return "must be one of " + ", ".join(f"'{word}'" for word in schema["enum"])
    if error.keyword == "type":
        return "must be " + " or ".join(_TYPES[name] for name in ([limit] if isinstance(limit, str) else limit))
    if error.keyword in ("minimum", "maximum"):
        return f"must be from {schema['minimum']} to {schema['maximum']}"
    return f"must be {limit}"


def _bad_name(error: SchemaError, span: SourceSpan) -> Diagnostic:
    name = f"'{_clipped(str(error.value))}'"
    if not _is_chosen(error.path):
        return Diagnostic(span, Code.UNKNOWN_KEY, f"{name} {_expected(error)}")
    field, bracket, _ = str(error.value).partition("[")
    hint = f"fill a list as a whole: `{field}: [a, b]`" if bracket and len(error.path) > _NAME_DEPTH else ""
    return Diagnostic(span, Code.BAD_VALUE, f"the name {name} {_expected(error)}", hint)


def _is_chosen(path: Path) -> bool:
    """Return whether the key at the path is a name chosen by the table, not a key that its siblings exclude."""
    is_part = len(path) <= _NAME_DEPTH and path[:1] != ("envelope",)
    return is_part or any(key in path[_NAME_DEPTH:-1] for key in key_hints.NAME_FIELDS)


def _missing_key(error: SchemaError, tree: Node) -> Diagnostic:
    missing = error.message.split("'")[1]  # jsonschema has one error per key and names it nowhere else
    key = key_at(tree, error.path)
    span = key.span if key else _first_line(node_at(tree, error.path))
    is_whole_part = len(error.path) == _NAME_DEPTH
    is_known = is_whole_part or len(error.path) <= 1
    hint = _HINTS_FOR_MISSING.get(missing, "") if is_known else ""
    if error.path == ("record",) and {*mapping(node_at(tree, error.path)).entries} == {"last"}:
        hint += "; add `continuous: false` to save only what 'last' keeps"
    if not error.path and missing in _BELONG_TOGETHER:
        hint = _HINT_FOR_WHOLE
    if (
        (number := error.path[-1:])
        and isinstance(number[0], int)
        and number[0] > 0
        and missing in ("topic", "endpoint")
    ):
        hint = "if its keys belong to the item above, remove the '-'"
    if error.path[:1] == ("state",) and missing in ("case", "source"):
        hint = "write 'case' and 'source', or 'topic' and 'type' for what a ROS topic sets"
    if error.path[-1:] == ("deadman",) and missing == "send":
        fields = "FIELD: VALUE"
        stopping = fields if error.path[0] == "gateways" else f"CASE: {{{fields}}}"
        hint = f"add the message that stops the rover: `send: {{{stopping}}}`"
    if is_whole_part and key:
        siblings = mapping(node_at(tree, error.path[:-1])).entries
        extended = [name for name, entry in siblings.items() if entry.key.span.file != key.span.file]
        hint = f"did you mean '{near}'?" if (near := nearest(key.text, extended, key_hints.CLOSE)) else hint
    return Diagnostic(span, Code.MISSING_KEY, f"{subject(error.path)} lacks the key '{missing}'", hint)


def _bad_address(text: str, span: SourceSpan, *, is_endpoint: bool) -> Diagnostic:
    try:
        (parse_endpoint if is_endpoint else parse_address)(text)
    except BadAddressError as error:
        return Diagnostic(span, Code.BAD_ADDRESS, error.what, key_hints.as_variable(text) or error.hint)
    raise AssertionError(f"the schema rejects the address '{text}', the parser accepts it")


def _repeated(error: SchemaError, tree: Node) -> Diagnostic:
    items = error.value if isinstance(error.value, list) else []
    index = next(index for index, item in enumerate(items) if item in items[:index])
    item = items[index]
    written = f"'{_clipped(item)}'" if isinstance(item, str) else shown(item)
    what = f"{subject(error.path)} contains {written} twice"
    return Diagnostic(node_at(tree, (*error.path, index)).span, Code.BAD_VALUE, what, "remove one of the two")


def _span_of(tree: Node, path: Path) -> SourceSpan:
    """Return the span of the value if it is on one line, else that of its key."""
    node = node_at(tree, path)
    key = key_at(tree, path)
    if key is None or (isinstance(node, ScalarNode) and node.span.end_column > node.span.column):
        return _first_line(node)
    return key.span


def _first_line(node: Node) -> SourceSpan:
    """Return the span of a scalar, or of a mapping's first key."""
    if isinstance(node, MappingNode) and node.entries:
        return next(iter(node.entries.values())).key.span
    return node.span


def subject(path: Path) -> str:
    """Describe the value at a path for messages."""
    names = [step for step in path if isinstance(step, str)]
    if not names:
        return "the table"
    return f"'{names[-1]}'" if isinstance(path[-1], str) else f"an item of '{names[-1]}'"


def _clipped(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
