"""Typed values from nodes that fit the schema.

A TypeError means that the schema and its reader disagree, which is a bug in the router. `InvalidValueError` is a
mistake in the table: a value of the right shape that is invalid.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from router.errors import Code, FindingError, Located, SourceSpan
from router.table.addresses import BadAddressError
from router.table.nodes import EACH, MAP, TEXT, MappingNode, Node, ScalarNode, SequenceNode

V = TypeVar("V")
R = TypeVar("R")


class InvalidValueError(FindingError):
    """An invalid value that the schema cannot detect."""


def parsed(parse: Callable[[V], R], written: Located[V]) -> R:
    """Parse a value. Raises InvalidValueError at its position if `parse` raises ValueError."""
    try:
        return parse(written.value)
    except BadAddressError as error:
        raise InvalidValueError(written.span, Code.BAD_ADDRESS, error.what, error.hint) from error
    except ValueError as error:
        raise InvalidValueError(written.span, Code.BAD_VALUE, str(error)) from error


def mapping(node: Node | None) -> MappingNode:
    if not isinstance(node, MappingNode):
        raise TypeError(f"a mapping, not {node!r}")
    return node


def is_choice(node: Node) -> bool:
    """Return whether a node is a choice, `{map: fix_quality, ...}`."""
    return isinstance(node, MappingNode) and isinstance(node.get(MAP), ScalarNode)


def is_elements(node: Node) -> bool:
    """Return whether a field is filled with `{each: LIST, fields: FIELDS}`."""
    return isinstance(node, MappingNode) and isinstance(node.get(EACH), ScalarNode)


def is_text(node: Node) -> bool:
    """Return whether a node is `{text: imu_link}`."""
    return isinstance(node, MappingNode) and [*node.entries] == [TEXT] and isinstance(node.get(TEXT), ScalarNode)


def scalar(node: Node | None) -> ScalarNode:
    if not isinstance(node, ScalarNode):
        raise TypeError(f"a scalar, not {node!r}")
    return node


def sequence(node: Node | None) -> SequenceNode:
    if not isinstance(node, SequenceNode):
        raise TypeError(f"a sequence, not {node!r}")
    return node


def located(node: Node | None) -> Located[str]:
    """Return the text of a scalar as written."""
    written = scalar(node)
    return Located(written.text, written.span)


def beside(text: str, span: SourceSpan) -> Path:
    """Make a path absolute, relative to the file that names it."""
    return Path(span.file).absolute().parent / text


def whole(node: Node | None) -> int:
    """Return a whole number; YAML's 10.0 and 1e1 are also whole."""
    number = scalar(node)
    if isinstance(number.value, bool) or not isinstance(number.value, (int, float)):
        raise TypeError(f"a whole number, not {number.value!r}")
    return int(number.value)


def optional_text(settings: MappingNode, key: str) -> Located[str] | None:
    node = settings.get(key)
    return located(node) if node else None


def integer(settings: MappingNode, key: str) -> Located[int] | None:
    """Return an optional whole number."""
    node = settings.get(key)
    return Located(whole(node), node.span) if node else None


def boolean(settings: MappingNode, key: str) -> bool:
    """Return a boolean, by default False."""
    node = settings.get(key)
    return node is not None and scalar(node).value is True
