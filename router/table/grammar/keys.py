"""Schemas of the keys that a class of the model declares, with what editors show about them.

A field is a key if a docstring follows it, or if its value is a part of the table that is described with its class.
The docstrings are read from the source, so they cost a running router nothing. The first paragraph is the description.
Others are for readers of the source, except for lines such as these:

    Title: Largest rate     if it is not the name of the key
    Example: 30 Hz          in YAML; there may be several
    Error: must say why     the end of the finding about a value that does not fit
"""

from __future__ import annotations

import ast
import enum
import inspect
import re
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from itertools import pairwise
from typing import Any

import yaml

from router.errors import SourceSpan
from router.table.addresses import IPNetwork
from router.table.keys import Key, Listed, OneOf, Range, Shape, keys_of
from router.table.model.expressions import Expression, FieldMap
from router.table.model.gateways import GatewayFormat, InboundDeadman, TopicRate
from router.table.model.routes import Collect, Deadman, Payload
from router.table.model.services import CalledReply, ServiceCall, ServiceReply, ServiceRequest, ServiceSource
from router.table.model.targets import Qos, Reply

Schema = dict[str, Any]

TEXT: Schema = {"type": "string", "minLength": 1}
BOOLEAN: Schema = {"type": "boolean"}
REASON: Schema = {"type": "string", "pattern": r"\S"}
_INLINE: Mapping[object, Schema] = {
    str: TEXT,
    bool: BOOLEAN,
    SourceSpan: BOOLEAN,
    GatewayFormat: {"type": "string"},  # which ones fit depends on the transport
    "at_start": {"type": "string", "enum": ["send", "silent"]},
    "reason": REASON,
}
_DEFINED: Mapping[object, str] = {
    Expression: "part_expression",
    FieldMap: "fields",
    IPNetwork: "network",
    Payload: "payloads",
    TopicRate: "topic_rates",
}
"""Types of values, and their definitions if these are named differently."""
_DESCRIBED = (
    *(Collect, Deadman, FieldMap, InboundDeadman, Qos, Reply),
    *(CalledReply, ServiceCall, ServiceReply, ServiceRequest, ServiceSource),
)
"""Types that are described with their class, for all their keys."""
_AS_MAPPING = (Payload, TopicRate)
"""Types of items of lists that a table writes as one mapping."""
_LABEL = re.compile(r"^(Title|Example|Error): ((?:.|\n(?!\n|\w+: ))*)", re.MULTILINE)


def ref(name: str) -> Schema:
    return {"$ref": f"#/definitions/{name}"}


def key(title: str, description: str, value: Schema, *examples: object, must: str = "") -> Schema:
    """Return the schema of a key that no class declares, or of a value that has a description."""
    shown: Schema = {"title": title, "description": description}
    shown |= {"examples": [*examples]} if examples else {}
    shown |= {"errorMessage": f"must {must}"} if must else {}
    return _shown(shown, value)


def about(model: type) -> Schema:
    """Return what the docstring of a class says."""
    return {"title": _titled(_words(model)), **_documented(inspect.getdoc(model) or "")}


def mapping(keys: Schema, **more: Any) -> Schema:
    """Return the schema of a mapping that has no other keys."""
    return {"type": "object", "additionalProperties": False, "properties": keys, **more}


def part(model: type, **given: Any) -> Schema:
    """Return the schema of a mapping with the keys of a class."""
    return mapping(properties(model, **given), **about(model))


def properties(model: type, **given: Any) -> Schema:
    """Return the schemas of the keys of a class.

    `given` has other descriptions, or whole schemas, for some. A dot in the name of a key separates it from the mapping
    around it, which is given without its keys.
    """
    docs = _docs(model)
    schemas: Schema = {}
    own_first = sorted(keys_of(model), key=lambda key: key.attribute not in model.__annotations__)
    for declared in own_first:
        outer, _, name = declared.name.rpartition(".")
        text, other = docs.get(declared.attribute), given.get(declared.name)
        if isinstance(other, dict):
            schemas[name] = other
        elif text is None and declared.type not in _DESCRIBED:
            continue
        elif outer:
            schemas.setdefault(outer, mapping({}, **given[outer]))["properties"][name] = _property(declared, name, text)
        else:
            schemas[name] = _property(declared, name, text, other)
    return schemas


def _property(key: Key, name: str, text: str | None, other: str | None = None) -> Schema:
    """Return the schema of a key with what its docstring says, or with another description."""
    if text is None:
        return _value(key)
    shown = {"title": _titled(name), **_documented(text), **_default(key)}
    return _shown({**shown, "description": other} if other else shown, _value(key))


def required(model: type) -> list[str]:
    """Return the names of the documented keys of a class that have no default."""
    docs = _docs(model)
    bare = {field.name for field in fields(model) if field.default is MISSING and field.default_factory is MISSING}
    return [key.name for key in keys_of(model) if key.attribute in bare and key.attribute in docs]


def _words(model: type) -> str:
    """Return the name of a class as that of a definition: `inbound_deadman`."""
    return "_".join(re.findall("[A-Z][a-z]+", model.__name__.removesuffix("Settings"))).lower()


def _titled(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _shown(shown: Schema, value: Schema) -> Schema:
    """Return the schema of a value with what editors show. Keywords beside a reference would be ignored."""
    return {**shown, **({"allOf": [value]} if "$ref" in value else value), **shown}


def _documented(text: str) -> Schema:
    """Return what a docstring says: the description, and what the lines with labels add."""
    text = inspect.cleandoc(text)
    shown: Schema = {"description": " ".join(text.partition("\n\n")[0].split())}
    for label, lines in _LABEL.findall(text):
        said = " ".join(lines.split())
        if label == "Example":
            shown.setdefault("examples", []).append(yaml.safe_load(said))
        else:
            shown["title" if label == "Title" else "errorMessage"] = said
    return shown


def _docs(model: type) -> dict[str, str]:
    """Return the docstrings of the fields of a class, also of those that it inherits, by name."""
    docs: dict[str, str] = {}
    for owner in filter(is_dataclass, reversed(model.__mro__)):
        for declared in ast.parse(inspect.getsource(owner)).body:
            for field, text in pairwise(getattr(declared, "body", ())):
                if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                    docs[ast.unparse(field.target)] = ast.literal_eval(text.value)
    return docs


def _value(key: Key) -> Schema:
    item = _item(key)
    listed = key.mark(Listed) or Listed()
    if not key.is_list or key.type in _AS_MAPPING:
        return item
    limits: Schema = {"minItems": listed.least} if listed.least else {}
    limits |= {"uniqueItems": True} if listed.unique else {}
    if listed.alone:
        return {"if": {"type": "array"}, "then": {**limits, "items": item}, "else": item}
    return {"type": "array", **limits, "items": item}


def _item(key: Key) -> Schema:
    """Return the schema of a key's value, or of an item of its list."""
    if numbers := key.mark(Range):
        return {"if": ref("variable"), "else": {"type": "integer", "minimum": numbers.least, "maximum": numbers.most}}
    if words := key.mark(OneOf):
        return {"type": "string", "enum": words.split()}
    kind = key.mark(Shape) or (key.quantity.shape if key.quantity else key.type)
    if kind in _INLINE:
        return _INLINE[kind]
    if isinstance(kind, str):
        return ref(kind)
    if kind in _DEFINED:
        return ref(_DEFINED[kind])
    if issubclass(kind, enum.Enum):
        return {"type": "string", "enum": [word.value for word in kind]}
    return ref(_words(kind))


def _default(key: Key) -> Schema:
    """Return the default, unless it cannot be written in a table."""
    default, numbers = key.default, key.mark(Range)
    if key.is_list:
        can_be_empty = default == () and not (key.mark(Listed) or Listed()).least
        return {"default": {} if key.type in _AS_MAPPING else []} if can_be_empty else {}
    if key.type is SourceSpan:
        return {"default": False}
    if default is None or (numbers and default < numbers.least):
        return {}
    is_plain = isinstance(default, int) and key.quantity is None
    return {"default": default if is_plain else key.text(default).replace(" ", "")}
