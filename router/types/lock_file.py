"""Reading and writing of the lock file: every field number that was ever assigned, and its field."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from router import inputs
from router.errors import Code, SourceSpan, TableError, shown_path

LOCK_NAME = "envelope.lock.json"

ENVELOPE, ONEOF = "PBEnvelope", "payload"
"""The envelope's names if neither a table nor a lock specifies them."""

BY_ONEOF = "oneof"

_FIELD = re.compile(r"(?:oneof (?P<oneof>\w+): )?(?P<type>\S.*) (?P<name>\w+)")


@dataclass(frozen=True, slots=True)
class Entry:
    """A field or enum value: number, name, and `type` as in `descriptors.declared_type`, empty for enum values.

    `oneof` is the oneof of a field, empty for none.
    """

    number: int
    name: str
    type: str = ""
    oneof: str = ""


@dataclass(frozen=True, slots=True)
class Declaration:
    """A message or an enum: the file that declares it, relative to the folder of the protos, and its members.

    `reserved` are ranges of numbers, as (first, last).
    """

    file: str
    entries: frozenset[Entry]
    reserved: frozenset[tuple[int, int]] = frozenset()


@dataclass(frozen=True, slots=True)
class Lock:
    """The content of a lock file. `max_size` is the envelope's largest encoding in bytes in the boards' firmware.

    `by` says how the envelope holds payloads (`Choice.by`), with the name of its oneof if that is "oneof".
    """

    message: str
    oneof: str
    max_size: int
    messages: Mapping[str, Declaration]
    enums: Mapping[str, Declaration]
    by: str = BY_ONEOF


def read_lock(path: Path) -> Lock | None:
    """Read a lock file; None if it does not exist. Raises TableError if it is broken."""
    span = SourceSpan(shown_path(path))
    try:
        content = json.loads(inputs.read_text(path), object_pairs_hook=_without_duplicates)
        return _parsed(content)
    except FileNotFoundError:
        return None
    except json.JSONDecodeError as error:
        span = SourceSpan(span.file, error.lineno, error.colno, error.colno + 1)
        if re.match("<{7}|={7}|>{7}", error.doc.split("\n")[error.lineno - 1]):
            hint = "keep one side; `router validate` then says how to record what the other side had"
            raise TableError.of(span, Code.BAD_FILE, "unresolved merge conflict", hint) from None
        problem = error.msg
    except (OSError, ValueError, RecursionError) as error:
        problem = str(error)
    except (LookupError, TypeError, AttributeError):
        problem = "its structure is different"
    hint = "restore the file from version control: it alone records which numbers are in use"
    raise TableError.of(span, Code.BAD_FILE, f"not a lock file: {problem}", hint)


def lock_text(lock: Lock) -> str:
    """Return the text of the file: sorted, one line per number."""
    by = {"oneof": lock.oneof} if lock.by == BY_ONEOF else {"by": lock.by}
    content = {
        "envelope": {"message": lock.message, **by, "max_size": lock.max_size},
        "messages": {
            name: _declaration(message, "fields", {str(entry.number): _field(entry) for entry in by_number(message)})
            for name, message in sorted(lock.messages.items())
        },
        "enums": {
            name: _declaration(enum, "values", _values(by_number(enum))) for name, enum in sorted(lock.enums.items())
        },
    }
    return json.dumps(content, indent=2) + "\n"


def _declaration(declared: Declaration, kind: str, members: Mapping[str, str]) -> dict[str, object]:
    """Return a declaration as JSON data. `reserved`, a list of ranges, is omitted if empty."""
    content: dict[str, object] = {"file": declared.file, kind: members}
    if declared.reserved:
        content["reserved"] = [f"{first} to {last}" for first, last in sorted(declared.reserved)]
    return content


def _field(entry: Entry) -> str:
    """Print a field: `float x`, or `oneof payload: Imu imu`."""
    return f"oneof {entry.oneof}: {entry.type} {entry.name}" if entry.oneof else f"{entry.type} {entry.name}"


def _values(entries: Iterable[Entry]) -> dict[str, str]:
    """Return the name or names of each number."""
    values: dict[str, str] = {}
    for entry in entries:
        known = values.get(str(entry.number))
        values[str(entry.number)] = f"{known} {entry.name}" if known else entry.name
    return values


def write_lock(path: Path, lock: Lock) -> None:
    """Write the file atomically. Raises TableError."""
    scratch = path.with_name(f".{path.name}.new")
    try:
        scratch.write_text(lock_text(lock), encoding="utf-8")
        scratch.replace(path)
    except OSError as error:
        scratch.unlink(missing_ok=True)
        message = f"the file cannot be written: {error.strerror}"
        raise TableError.of(SourceSpan(shown_path(path)), Code.BAD_FILE, message) from None


def short_name(name: str) -> str:
    """Return a name without its package."""
    return name.rpartition(".")[2]


def by_number(declaration: Declaration) -> list[Entry]:
    """Return the members in a reproducible order."""
    return sorted(declaration.entries, key=lambda entry: (entry.number, entry.name))


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Reject duplicate keys, which remain after a merge of two branches that assign the same number."""
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = next(key for index, (key, _) in enumerate(pairs) if key in dict(pairs[:index]))
        raise ValueError(f"the key '{twice}' occurs twice")
    return content


def _parsed(content: Any) -> Lock:
    """Parse the content. Raises ValueError, LookupError, TypeError or AttributeError if its structure differs."""
    envelope = content["envelope"]
    by = str(envelope.get("by", BY_ONEOF))
    return Lock(
        message=str(envelope["message"]),
        oneof=str(envelope["oneof"]) if by == BY_ONEOF else "",
        max_size=int(envelope["max_size"]),
        messages={name: _declared(message, "fields", _field_entries) for name, message in content["messages"].items()},
        enums={name: _declared(enum, "values", _value_entries) for name, enum in content["enums"].items()},
        by=by,
    )


def _declared(content: Any, kind: str, entries: Callable[[Mapping[str, str]], Iterator[Entry]]) -> Declaration:
    reserved = frozenset(map(_range, content.get("reserved", ())))
    return Declaration(str(content["file"]), frozenset(entries(content[kind])), reserved)


def _range(text: str) -> tuple[int, int]:
    """Parse a range: `20 to 29`."""
    first, last = text.split(" to ")
    return int(first), int(last)


def _field_entries(fields: Mapping[str, str]) -> Iterator[Entry]:
    for number, declared in fields.items():
        if (parts := _FIELD.fullmatch(declared)) is None:
            raise ValueError(f"'{number}: {declared}' is not a number, a type and a name")
        yield Entry(int(number), parts["name"], parts["type"], parts["oneof"] or "")


def _value_entries(values: Mapping[str, str]) -> Iterator[Entry]:
    for number, names in values.items():
        yield from (Entry(int(number), name) for name in names.split())
