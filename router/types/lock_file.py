"""The lock file: every field number that was ever given out, and what it was given to.

Reads and writes it; knows no `.proto` file. What follows from a difference is `lock`'s business.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from router.errors import Code, Diagnostic, SourceSpan, TableError, shown_path

LOCK_NAME = "envelope.lock.json"


@dataclass(frozen=True, slots=True)
class Entry:
    """A field's or enum value's number and name; `type` as `descriptors.declared_type`, empty for enum values."""

    number: int
    name: str
    type: str = ""


@dataclass(frozen=True, slots=True)
class Declaration:
    """A message or an enum: the file that declares it, relative to the folder of the protos, and its members."""

    file: str
    entries: frozenset[Entry]


@dataclass(frozen=True, slots=True)
class Lock:
    """`max_size` is the envelope's largest encoding in bytes, which the boards were flashed with."""

    message: str
    oneof: str
    max_size: int
    messages: Mapping[str, Declaration]
    enums: Mapping[str, Declaration]


def read_lock(root: Path) -> Lock | None:
    """The lock beside the protos, None where there is no such file. Raises TableError for a broken one."""
    path = root / LOCK_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_without_duplicates)
        return _parsed(content)
    except FileNotFoundError:
        return None
    except json.JSONDecodeError as error:
        span = SourceSpan(shown_path(path), error.lineno, error.colno, error.colno + 1)
        problem = error.msg
    except (OSError, ValueError, RecursionError) as error:
        span = SourceSpan(shown_path(path))
        problem = str(error)
    hint = "take the file from version control; without it nobody knows which numbers are taken"
    raise TableError([Diagnostic(span, Code.BAD_FILE, f"not a lock file: {problem}", hint)])


def write_lock(root: Path, lock: Lock) -> None:
    """Write the lock beside the protos, all of it or nothing; sorted, one line for each number. Raises TableError."""
    content = {
        "envelope": {"message": lock.message, "oneof": lock.oneof, "max_size": lock.max_size},
        "messages": {
            name: {"file": message.file, "fields": {str(e.number): f"{e.type} {e.name}" for e in by_number(message)}}
            for name, message in sorted(lock.messages.items())
        },
        "enums": {
            name: {"file": enum.file, "values": {entry.name: entry.number for entry in by_number(enum)}}
            for name, enum in sorted(lock.enums.items())
        },
    }
    path = root / LOCK_NAME
    scratch = root / f".{LOCK_NAME}.new"
    try:
        scratch.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        scratch.replace(path)
    except OSError as error:
        scratch.unlink(missing_ok=True)
        message = f"cannot be written: {error.strerror}"
        raise TableError([Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message)]) from None


def by_number(declaration: Declaration) -> list[Entry]:
    """The members in an order that does not change from run to run."""
    return sorted(declaration.entries, key=lambda entry: (entry.number, entry.name))


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Two branches that gave out one number leave two equal keys after a merge."""
    content = dict(pairs)
    if len(content) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key '{twice}' stands there twice")
    return content


def _parsed(content: object) -> Lock:
    top = _mapping(content, "the file")
    envelope = _mapping(top.get("envelope"), "envelope")
    max_size = envelope.get("max_size")
    if not isinstance(max_size, int):
        raise ValueError("envelope.max_size is no number")
    return Lock(
        message=_text(envelope.get("message"), "envelope.message"),
        oneof=_text(envelope.get("oneof"), "envelope.oneof"),
        max_size=max_size,
        messages={
            name: Declaration(file, frozenset(_field_entries(members, name)))
            for name, file, members in _declarations(top, "messages", "fields")
        },
        enums={
            name: Declaration(file, frozenset(_value_entries(members, name)))
            for name, file, members in _declarations(top, "enums", "values")
        },
    )


def _declarations(top: Mapping[str, Any], kind: str, members: str) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    for name, content in _mapping(top.get(kind), kind).items():
        declaration = _mapping(content, name)
        yield name, _text(declaration.get("file"), f"{name}.file"), _mapping(declaration.get(members), name)


def _field_entries(fields: Mapping[str, Any], message: str) -> Iterator[Entry]:
    for number, declared in fields.items():
        type_, _, name = _text(declared, f"{message}.{number}").rpartition(" ")
        if not number.isdecimal() or not type_:
            raise ValueError(f"{message} has '{number}: {declared}' where number, type and name belong")
        yield Entry(int(number), name, type_)


def _value_entries(values: Mapping[str, Any], enum: str) -> Iterator[Entry]:
    for name, number in values.items():
        if not isinstance(number, int):
            raise ValueError(f"{enum}.{name} is no number")
        yield Entry(number, name)


def _mapping(value: object, what: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{what} is no mapping")
    return value


def _text(value: object, what: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{what} is no text")
    return value
