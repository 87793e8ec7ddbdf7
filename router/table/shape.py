"""The shape of a table: the JSON Schema decides, its findings are told in words.

Knows schemas/route-table.schema.json, no meaning of a key. A misspelt key is one mistake: it is reported
and then read as the key that was meant, so that nothing is found missing on its account.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from router.assets import asset
from router.errors import Code, Diagnostic, did_you_mean, nearest
from router.table.nodes import Entry, MappingNode, Node, Path, cut_off, key_at, node_at, rewritten, to_data
from router.table.sentences import NAME_FIELDS, Misfit, finding, subject

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

SCHEMA = "schemas/route-table.schema.json"


def table_schema() -> dict[str, Any]:
    """The schema as data, for whoever documents keys."""
    return _schema(SCHEMA)


@functools.lru_cache
def _schema(name: str) -> dict[str, Any]:
    schema: dict[str, Any] = json.loads(asset(name).read_text(encoding="utf-8"))
    return schema


def check_shape(root: MappingNode, findings: list[Diagnostic]) -> MappingNode:
    """The tree with misspelt keys put right and everything that has a finding marked broken."""
    tree: Node = root
    found = misfits(tree, SCHEMA)
    while unknown := [misfit for misfit in found if misfit.keyword == "additionalProperties"]:
        repairs = {}
        for misfit in unknown:
            known = list(misfit.schema["properties"])
            findings.extend(_unknown_keys(node_at(tree, misfit.path), misfit.path, known))
            repairs[misfit.path] = functools.partial(_with_known_keys, known=known)
        tree = rewritten(tree, repairs)
        found = misfits(tree, SCHEMA)
    rests = {misfit.path for misfit in found if _is_rest(tree, misfit.path)}
    found = [misfit for misfit in found if misfit.path not in rests]
    findings.extend(finding(misfit, tree) for misfit in found if not _is_broken(tree, misfit.path))
    tree = rewritten(tree, {misfit.path: _as_broken for misfit in found})
    tree = rewritten(tree, {path[:-1]: _without_rests for path in rests})
    if not isinstance(tree, MappingNode):
        raise TypeError("a table's root stays a mapping")
    return tree


def misfits(tree: Node, schema: str) -> list[Misfit]:
    """Where a tree does not fit a schema of ours, which is named by its file.

    One misfit for each value, that of its type before any other; each missing key is one of its own.
    """
    data: Any = to_data(tree)
    found = [Misfit.of(error) for error in _validator(schema).iter_errors(data)]
    found.sort(key=lambda misfit: misfit.keyword != "type")
    first = {(misfit.path, misfit.message if misfit.is_about_keys else ""): misfit for misfit in reversed(found)}
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
    if not isinstance(node, MappingNode):
        raise TypeError("only a mapping has keys")
    rests = _rests(node)
    return replace(node, entries={name: entry for name, entry in node.entries.items() if name not in rests})


def _rests(node: MappingNode) -> set[str]:
    return set(cut_off((name, entry.value) for name, entry in node.entries.items()))


def _unknown_keys(node: Node, path: Path, known: list[str]) -> Iterable[Diagnostic]:
    if not isinstance(node, MappingNode):
        raise TypeError("only a mapping has keys")
    for name, entry in node.entries.items():
        if name not in known and not entry.key.broken:
            elsewhere = "" if nearest(name, known) else _owners(name, path)
            hint = elsewhere or did_you_mean(name, known)
            yield Diagnostic(entry.key.span, Code.UNKNOWN_KEY, f"{subject(path)} has no key '{name}'", hint)


def _owners(name: str, path: Path) -> str:
    """A hint for a key that there is, but elsewhere in a table; empty where there is no such key.

    Others that are called as what stands at `path` (deadmen are of two kinds) would make no hint.
    """
    definitions = table_schema()["definitions"]
    owners = [owner for owner, schema in definitions.items() if _has(schema, name) and owner not in path[-1:]]
    return f"that is a key of: {', '.join(owners)}" if owners else ""


def _has(schema: Any, name: str) -> bool:
    return any(name in part.get("properties", ()) for part in (schema, schema.get("then", {}), schema.get("else", {})))


def _with_known_keys(node: Node, known: list[str]) -> Node:
    if not isinstance(node, MappingNode):
        raise TypeError("only a mapping has keys")
    entries: dict[str, Entry] = {}
    broken = node.broken
    for name, entry in node.entries.items():
        meant = name if name in known else nearest(name, [key for key in known if key not in node.entries])
        if meant is None or (meant != name and meant in entries):
            broken = True  # what the key was to say is lost
        else:
            entries[meant] = entry
    return replace(node, entries=entries, broken=broken)
