"""A new message in the tests of its table: given it from its board, the basestation and ROS get it unchanged.

Adds lines to the text; what stands there stays as it is. Runs nothing.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

from router.rehearsal.shape import read_shape
from router.table.nodes import MappingNode, Node, ScalarNode, SequenceNode
from router.tools.new_message_layout import WIDEST, stanza_at, with_stanza_after
from router.tools.new_message_model import SCALARS, NewMessage, Site
from router.tools.new_message_tables import told_endpoints
from router.types.model import Bool, Enum, Float, MessageType, Type


def with_test(path: Path, text: str, message: NewMessage, site: Site) -> str:
    """The test file at `path` with one more test, below the last one of that board. Raises TableError."""
    tests = read_shape(path).get("tests")
    lines = text.split("\n")
    entries = tests.entries.values() if isinstance(tests, MappingNode) else ()
    of_board = [entry for entry in entries if message.board in _senders(entry.value)]
    last = max((entry.key.span.line for entry in of_board or entries), default=len(lines))
    section = "" if of_board else message.board_words
    return with_stanza_after(lines, stanza_at(lines, last - 1), _test(message, site), section)


def _senders(node: Node) -> Iterator[str]:
    """Everything that a test names as `from`."""
    if isinstance(node, SequenceNode):
        for item in node.items:
            yield from _senders(item)
    elif isinstance(node, MappingNode):
        for key, entry in node.entries.items():
            if key == "from" and isinstance(entry.value, ScalarNode):
                yield entry.value.text
            yield from _senders(entry.value)


def _test(message: NewMessage, site: Site) -> Iterator[str]:
    told = told_endpoints(message, site.table)
    subject = message.case.replace("_", " ")
    yield f"{subject} reaches {'the operator and ROS as it is' if told else 'ROS as the operator sent it'}:"
    yield "  given:"
    yield f"    case: {message.case}"
    yield f"    from: {message.board}"
    fields = _flow({field.name: _sample(field.type, place, site) for place, field in enumerate(message.fields)})
    yield from _wrapped(f"    fields: {fields}", " " * 13)
    yield "  expect:"
    if told:
        yield f"    sent: {told[0] if len(told) == 1 else '[' + ', '.join(told) + ']'}"
    yield f"    published: {{{message.case}: unchanged}}"


def _wrapped(text: str, indent: str) -> Iterator[str]:
    """On several lines if it is long; a name and its value stay on one."""
    together = text.replace(": ", ":\0")
    for line in textwrap.wrap(
        together, WIDEST - 2, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    ):
        yield line.replace("\0", " ")


def _flow(values: Mapping[str, str]) -> str:
    return f"{{{', '.join(f'{name}: {value}' for name, value in values.items())}}}"


def _sample(type_name: str, place: int, site: Site) -> str:
    """A value that no field has by default, and mostly another one for each."""
    if type_name in SCALARS:
        return _scalar(type_name == "bool", type_name in ("float", "double"), place)
    if type_name in site.schema.enums:
        return _value(site.schema.enums[type_name], place, site)
    return _value(site.schema.messages[type_name], place, site)


def _value(type_: Type, place: int, site: Site) -> str:
    if isinstance(type_, Enum):
        return next((name for name, number in type_.values if number), type_.values[0][0])
    if isinstance(type_, MessageType):
        fields = ((index, field) for index, field in enumerate(type_.fields, place))
        return _flow({field.name: _value(field.type, index, site) for index, field in fields})
    return _scalar(isinstance(type_, Bool), isinstance(type_, Float), place)


def _scalar(is_bool: bool, is_float: bool, place: int) -> str:
    if is_bool:
        return "true"
    return f"{place + 1}.5" if is_float else str(place + 1)
