"""One jsonschema error as one finding: the code, the place to blame, a sentence in a human's words.

The schema carries the words: `errorMessage` ("must be ...", which editors show as well) beside the keyword.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from router.errors import Code, Diagnostic, SourceSpan, nearest
from router.table.address import BadAddressError, parse_address
from router.table.nodes import MappingNode, Node, Path, ScalarNode, key_at, node_at

if TYPE_CHECKING:
    from jsonschema import ValidationError

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
class Misfit:
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
    def of(cls, error: ValidationError) -> Misfit:
        about_name = "propertyNames" in error.absolute_schema_path
        path: Path = tuple(error.absolute_path)
        if about_name:
            path = (*path, str(error.instance))
        schema = error.schema if isinstance(error.schema, Mapping) else {}
        return cls(path, str(error.validator), error.validator_value, error.instance, schema, error.message, about_name)

    @property
    def is_about_keys(self) -> bool:
        """The mapping is one, but some of its keys are missing or too many."""
        return self.keyword in ("required", "additionalProperties")


def finding(misfit: Misfit, tree: Node) -> Diagnostic:
    """The finding for anything but an unknown key of a closed mapping."""
    path, keyword = misfit.path, misfit.keyword
    key = key_at(tree, path)
    name = subject(path)
    if misfit.about_name:
        return _bad_name(misfit, key.span if key else _first_line(tree))
    span = _blamed(tree, path)
    if keyword == "required":
        return _missing_key(misfit, tree)
    if keyword == "type":
        return Diagnostic(span, Code.WRONG_TYPE, f"{name} {_expected(misfit)}, not {shown(misfit.value)}")
    if keyword == "pattern" and path[-1] in _ADDRESSES:
        return _bad_address(str(misfit.value), span)
    if keyword == "uniqueItems":
        return _repeated(misfit, tree)
    code = Code.UNKNOWN_QOS_VALUE if keyword == "enum" and path[-2:-1] == ("qos",) else Code.BAD_VALUE
    if keyword == "maxProperties":
        return Diagnostic(span, code, f"{name} {_expected(misfit)}, and no other beside it")
    near = nearest(str(misfit.value), misfit.limit) if keyword == "enum" else None
    hint = f"did you mean '{near}'?" if near else ""
    if keyword.startswith("min") and keyword != "minimum":  # minLength, minItems, minProperties
        return Diagnostic(span, code, f"{name} must not be empty")
    return Diagnostic(span, code, f"{name} {_expected(misfit)}, not {shown(misfit.value)}", hint)


def shown(value: object) -> str:
    """How a sentence speaks of a value."""
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return f"the number {_clipped(str(value))}"
    if isinstance(value, str):
        return f"the text '{_clipped(value)}'"
    return "a mapping" if isinstance(value, dict) else "a list"


def _expected(misfit: Misfit) -> str:
    schema, limit = misfit.schema, misfit.limit
    if "errorMessage" in schema:
        return str(schema["errorMessage"])
    if misfit.keyword == "type":
        return "must be " + " or ".join(_TYPES[name] for name in ([limit] if isinstance(limit, str) else limit))
    if misfit.keyword == "enum":
        return "must be one of " + ", ".join(f"'{word}'" for word in limit)
    if misfit.keyword in ("minimum", "maximum"):
        return f"must be from {schema['minimum']} to {schema['maximum']}"
    return f"must be {limit}"


def _bad_name(misfit: Misfit, span: SourceSpan) -> Diagnostic:
    name = f"'{_clipped(str(misfit.value))}'"
    if not _is_chosen(misfit.path):
        return Diagnostic(span, Code.UNKNOWN_KEY, f"{name} {_expected(misfit)}")
    return Diagnostic(span, Code.BAD_VALUE, f"the name {name} {_expected(misfit)}")


def _is_chosen(path: Path) -> bool:
    """The key at the path is a name that a person gave, not one of the keys that others of their mapping rule out."""
    return len(path) <= _NAME_DEPTH or any(key in path[_NAME_DEPTH:-1] for key in NAME_FIELDS)


def _missing_key(misfit: Misfit, tree: Node) -> Diagnostic:
    missing = misfit.message.split("'")[1]  # jsonschema has one error for each key and names it nowhere else
    key = key_at(tree, misfit.path)
    span = key.span if key else _first_line(node_at(tree, misfit.path))
    is_whole_part = len(misfit.path) == _NAME_DEPTH
    hint = _HINTS_FOR_MISSING.get(missing, "") if is_whole_part else ""
    if not misfit.path and missing in _BELONG_TOGETHER:
        hint = _HINT_FOR_WHOLE
    return Diagnostic(span, Code.MISSING_KEY, f"{subject(misfit.path)} lacks the key '{missing}'", hint)


def _bad_address(text: str, span: SourceSpan) -> Diagnostic:
    try:
        parse_address(text)
    except BadAddressError as error:
        return Diagnostic(span, Code.BAD_ADDRESS, error.what, error.hint)
    raise AssertionError(f"the schema refuses the address '{text}', parse_address takes it")


def _repeated(misfit: Misfit, tree: Node) -> Diagnostic:
    items = misfit.value if isinstance(misfit.value, list) else []
    index = next(index for index, item in enumerate(items) if item in items[:index])
    what = f"{shown(items[index])} stands in {subject(misfit.path)} twice"
    return Diagnostic(node_at(tree, (*misfit.path, index)).span, Code.BAD_VALUE, what)


def _blamed(tree: Node, path: Path) -> SourceSpan:
    """The value if it is a word on a line, else the key that it stands under."""
    node = node_at(tree, path)
    key = key_at(tree, path)
    if key is None or (isinstance(node, ScalarNode) and node.span.end_column > node.span.column):
        return _first_line(node)
    return key.span


def _first_line(node: Node) -> SourceSpan:
    """A collection's first key or item stands for it."""
    if isinstance(node, MappingNode) and node.entries:
        return next(iter(node.entries.values())).key.span
    return node.span


def subject(path: Path) -> str:
    """How a sentence names what stands at a path."""
    names = [step for step in path if isinstance(step, str)]
    if not names:
        return "the table"
    return f"'{names[-1]}'" if isinstance(path[-1], str) else f"an item of '{names[-1]}'"


def _clipped(text: str) -> str:
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
