"""The shape of a test file: schemas/table-test.schema.json decides, what does not fit is told as tables tell it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean
from router.table.compose import compose
from router.table.nodes import MappingNode, Node, is_valid, key_at, node_at
from router.table.schema import SchemaError, finding, schema_errors, subject
from router.table.source import read_source

SCHEMA = "schemas/table-test.schema.json"


def read_shape(path: Path) -> MappingNode:
    """The nodes of a test file whose shape is right. Raises TableError with every finding."""
    findings: list[Diagnostic] = []
    source = read_source(path)
    message = "a test file is a mapping with the key 'tests'"
    if not source.text.strip():
        raise TableError([Diagnostic(SourceSpan(source.file), Code.WRONG_TYPE, message)])
    root = compose(source, {}, findings)
    if not isinstance(root, MappingNode):
        raise TableError([*findings, Diagnostic(root.span, Code.WRONG_TYPE, message)])
    if not findings and is_valid(root):
        findings += _findings(root, SourceSpan(source.file))
    if findings:
        raise TableError(sorted(findings, key=lambda found: (found.span, found.message)))
    return root


def _findings(root: MappingNode, whole: SourceSpan) -> Iterator[Diagnostic]:
    found = schema_errors(root, SCHEMA)
    misspelt = {misfit.path for misfit in found if misfit.keyword == "additionalProperties"}
    for misfit in found:
        if misfit.keyword == "additionalProperties":
            yield from _unknown_keys(misfit, node_at(root, misfit.path))
        elif not misfit.path and misfit.path not in misspelt:
            yield Diagnostic(whole, Code.MISSING_KEY, "a test file has its tests under the key 'tests'")
        elif misfit.keyword == "required" and misfit.path in misspelt:
            continue  # the key that is missing may be the one that is misspelt
        elif misfit.keyword == "required":
            key = key_at(root, misfit.path)
            missing = misfit.message.split("'")[1]
            what = f"a step says what it expects: '{missing}' is missing"
            yield Diagnostic(key.span if key else node_at(root, misfit.path).span, Code.MISSING_KEY, what)
        else:
            yield finding(misfit, root)


def _unknown_keys(misfit: SchemaError, node: Node) -> Iterator[Diagnostic]:
    assert isinstance(node, MappingNode)  # noqa: S101 - only a mapping has keys
    known = list(misfit.schema["properties"])
    owner = "a test file" if not misfit.path else subject(misfit.path)
    for name, entry in node.entries.items():
        if name not in known:
            hint = did_you_mean(name, known)
            yield Diagnostic(entry.key.span, Code.UNKNOWN_KEY, f"{owner} has no key '{name}'", hint)
