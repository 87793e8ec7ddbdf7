"""A new message in ROS: the `.msg` file whose fields `fields: auto` fills by their names.

An enum is a message of its own where there is one, else a uint8 with its values as constants, as elsewhere in `comms`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from router.errors import UsageError
from router.tools.new_message_layout import aligned
from router.tools.new_message_model import SCALARS, NewField, NewMessage, Site

_LARGEST_CONSTANT = 255


def msg_text(message: NewMessage, site: Site) -> str:
    """Raises UsageError for a field whose type has no ROS message, and can be none of ROS's own."""
    lines = [f"# {message.title}.", ""]
    for name in dict.fromkeys(field.type for field in message.fields):
        if constants := list(_constants(name, site)):
            lines += [*constants, ""]
    rows = [(f"{_ros_type(field, site)} {field.name}", _comment(field, site)) for field in message.fields]
    return "\n".join([*lines, *aligned(rows, "#")]) + "\n"


def _short(name: str) -> str:
    return name.rpartition(".")[2]


def _has_message(name: str, site: Site) -> bool:
    return Path(site.messages, f"{_short(name)}.msg").exists()


def _ros_type(field: NewField, site: Site) -> str:
    if field.type in SCALARS:
        return SCALARS[field.type]
    if _has_message(field.type, site):
        return _short(field.type)
    if field.type in site.schema.enums:
        return "uint8"
    raise UsageError(f"'{field.name}' needs {site.messages.name}/{_short(field.type)}.msg; declare that first")


def _constants(name: str, site: Site) -> Iterator[str]:
    if name not in site.schema.enums or _has_message(name, site):
        return
    for value, number in site.schema.enums[name].values:
        if not 0 <= number <= _LARGEST_CONSTANT:
            raise UsageError(f"{name}.{value} is {number}, which is no uint8; write the .msg file by hand")
        yield f"uint8 {value}={number}"


def _comment(field: NewField, site: Site) -> str:
    if field.comment or field.type not in site.schema.enums or _has_message(field.type, site):
        return field.comment
    words = {value.partition("_")[0] for value, _ in site.schema.enums[field.type].values}
    return f"{words.pop()}_*" if len(words) == 1 else ""
