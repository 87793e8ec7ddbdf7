"""Typed values out of nodes that the schema has found sound.

A TypeError from here says that the schema and the builder disagree, which is our bug. `UnsoundError` is the
table's fault: a value of the right shape that means nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from router.errors import Code, Diagnostic
from router.table.model import Located
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.table.units import parse_duration

V = TypeVar("V")
R = TypeVar("R")


class UnsoundError(Exception):
    """Carries the finding for a value that the schema cannot judge."""

    def __init__(self, diagnostic: Diagnostic) -> None:
        super().__init__(str(diagnostic))
        self.diagnostic = diagnostic

    @classmethod
    def guard(cls, parse: Callable[[V], R], written: Located[V]) -> R:
        """`parse` of the value; its ValueError becomes a bad value at the value's place."""
        try:
            return parse(written.value)
        except ValueError as error:
            raise cls(Diagnostic(written.span, Code.BAD_VALUE, str(error))) from error


def mapping(node: Node | None) -> MappingNode:
    if not isinstance(node, MappingNode):
        raise TypeError(f"a mapping, not {node!r}")
    return node


def scalar(node: Node | None) -> ScalarNode:
    if not isinstance(node, ScalarNode):
        raise TypeError(f"a scalar, not {node!r}")
    return node


def items(settings: MappingNode, key: str) -> tuple[Node, ...]:
    """The members of an optional sequence."""
    node = settings.get(key)
    if node is None:
        return ()
    if not isinstance(node, SequenceNode):
        raise TypeError(f"a sequence, not {node!r}")
    return node.items


def located(node: Node | None) -> Located[str]:
    """A scalar's text as it was written."""
    found = scalar(node)
    return Located(found.text, found.span)


def beside(written: Located[str]) -> Located[Path]:
    """A path relative to the file that names it, made absolute."""
    return Located(Path(written.span.file).absolute().parent / written.value, written.span)


def text(settings: MappingNode, key: str) -> Located[str]:
    return located(settings.get(key))


def optional_text(settings: MappingNode, key: str) -> Located[str] | None:
    return text(settings, key) if settings.get(key) else None


def text_or(settings: MappingNode, key: str, default: str) -> str:
    return text(settings, key).value if settings.get(key) else default


def integer(settings: MappingNode, key: str) -> Located[int] | None:
    """An optional whole number; YAML's 10.0 and 1e1 are whole as well."""
    node = settings.get(key)
    if node is None:
        return None
    found = scalar(node)
    if isinstance(found.value, bool) or not isinstance(found.value, (int, float)):
        raise TypeError(f"a whole number, not {found.value!r}")
    return Located(int(found.value), found.span)


def number_or_text(node: Node | None) -> Located[str | float]:
    """A rate, say: `0.5` or `0.5 Hz`."""
    found = scalar(node)
    if found.value is None or isinstance(found.value, bool):
        raise TypeError(f"a number or text, not {found.value!r}")
    return Located(found.value, found.span)


def boolean(settings: MappingNode, key: str) -> bool:
    """A truth value that is false unless it is given."""
    node = settings.get(key)
    return node is not None and scalar(node).value is True


def duration(settings: MappingNode, key: str) -> Located[int] | None:
    """An optional duration in ns."""
    return needed_duration(settings, key) if settings.get(key) else None


def needed_duration(settings: MappingNode, key: str) -> Located[int]:
    """A duration in ns."""
    written = text(settings, key)
    return Located(UnsoundError.guard(parse_duration, written), written.span)
