"""Field numbers are permanent: compares the `.proto` files with the lock file beside them.

A number that changes its meaning is an error, since boards in the field keep the old one. What is merely
new is a warning until `router schema lock` records it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from router.errors import Code, Diagnostic, Severity, TableError
from router.types.descriptors import declared_type
from router.types.lock_file import Declaration, Entry, Lock, by_number, read_lock
from router.types.proto_source import Part
from router.types.protobuf import Envelope, ProtoSchema

_TO_LOCK = "record it with `router schema lock`"


def check_lock(schema: ProtoSchema, envelope: Envelope) -> list[Diagnostic]:
    """Every difference between the `.proto` files and the lock, and what is wrong with the lock file itself.

    Ordered by place.
    """
    try:
        lock = read_lock(schema.root)
    except TableError as error:
        return list(error.diagnostics)
    span = schema.span(envelope.name)
    if lock is None:
        message = "no lock file records the field numbers"
        return [Diagnostic(span, Code.NOT_LOCKED, message, "write it with `router schema lock`")]
    current = _current_lock(schema, envelope)
    findings = [*_compared(schema, lock.messages, current.messages), *_compared(schema, lock.enums, current.enums)]
    if (lock.message, lock.oneof) != (current.message, current.oneof):
        message = f"the lock is for the envelope {lock.message}.{lock.oneof}, not {current.message}.{current.oneof}"
        findings.append(Diagnostic(span, Code.NOT_LOCKED, message, _TO_LOCK))
    elif lock.max_size != current.max_size and not any(found.severity is Severity.ERROR for found in findings):
        message = f"{envelope.name} takes up to {current.max_size} bytes, the lock says {lock.max_size}"
        findings.append(Diagnostic(span, Code.NOT_LOCKED, message, f"flash the boards, then {_TO_LOCK}"))
    return sorted(findings, key=lambda finding: finding.span)


def extended_lock(schema: ProtoSchema, envelope: Envelope) -> Lock:
    """The lock with everything added that is new. Nothing is ever taken out: a number stays given out.

    Raises TableError when the lock file is broken. For a schema without conflicts, see `check_lock`.
    """
    current = _current_lock(schema, envelope)
    lock = read_lock(schema.root)
    if lock is None:
        return current
    return replace(
        current,
        messages=_extended(lock.messages, current.messages),
        enums=_extended(lock.enums, current.enums),
    )


def _current_lock(schema: ProtoSchema, envelope: Envelope) -> Lock:
    """What the lock would be for the `.proto` files as they are."""
    messages = {}
    for name in schema.messages:
        if (file := schema.sources.file(name)) in schema.files:
            fields = schema.descriptor(name).fields
            entries = frozenset(Entry(field.number, field.name, declared_type(field)) for field in fields)
            messages[name] = Declaration(file, entries)
    enums = {}
    for name, declared in schema.enums.items():
        if (file := schema.sources.file(name)) in schema.files:
            enums[name] = Declaration(file, frozenset(Entry(number, value) for value, number in declared.values))
    return Lock(envelope.name, envelope.oneof, envelope.max_size, messages, enums)


def locked_size(schema: ProtoSchema) -> int | None:
    """The envelope's largest encoding that the lock records, None without a (readable) lock."""
    try:
        lock = read_lock(schema.root)
    except TableError:  # a finding of check_lock
        return None
    return lock.max_size if lock is not None else None


def _extended(locked: Mapping[str, Declaration], current: Mapping[str, Declaration]) -> Mapping[str, Declaration]:
    extended = {**locked, **current}
    for name in locked.keys() & current.keys():
        extended[name] = replace(current[name], entries=locked[name].entries | current[name].entries)
    return extended


def _compared(
    schema: ProtoSchema, locked: Mapping[str, Declaration], current: Mapping[str, Declaration]
) -> Iterator[Diagnostic]:
    for name, declaration in current.items():
        if name in locked:
            reserved = schema.reserved_numbers(name)
            live = [entry for entry in by_number(locked[name]) if not any(entry.number in span for span in reserved)]
            yield from _entry_findings(schema, name, live, by_number(declaration))
        else:
            yield Diagnostic(schema.span(name), Code.NOT_LOCKED, f"the lock does not know {name}", _TO_LOCK)


def _entry_findings(
    schema: ProtoSchema, owner: str, locked: Iterable[Entry], current: Iterable[Entry]
) -> Iterator[Diagnostic]:
    """Findings for the members of one message or enum; reserved numbers are no longer among `locked`."""
    was = {entry.name: entry for entry in locked}
    now = {entry.name: entry for entry in current}
    holders = {entry.number: entry for entry in was.values()}
    for entry in now.values():
        if (old := was.get(entry.name)) is not None:
            yield from _changed(schema, owner, old, entry)
        elif (holder := holders.get(entry.number)) is None or now.get(holder.name) == holder:
            message = f"the lock does not know {owner}.{entry.name}"
            yield Diagnostic(schema.span(owner, entry.name), Code.NOT_LOCKED, message, _TO_LOCK)
        else:
            message = f"number {entry.number} of {owner} belongs to '{holder.name}', not to '{entry.name}'"
            hint = f"the lock says {_shown(holder)}; call it that, or reserve the number and take a free one"
            yield _conflict(schema, owner, entry, Part.NUMBER, message, hint)
    taken = {entry.number for entry in now.values() if entry.name not in was}
    for old in was.values():
        if old.name not in now and old.number not in taken:
            message = f"{owner} has no '{old.name}' any more, and number {old.number} is free to be reused"
            hint = f"the lock says {_shown(old)}; write `reserved {old.number};` there"
            yield Diagnostic(schema.span(owner), Code.WIRE_NUMBER_CONFLICT, message, hint)


def _changed(schema: ProtoSchema, owner: str, old: Entry, new: Entry) -> Iterator[Diagnostic]:
    hint = f"the lock says {_shown(old)}; to change it, reserve {old.number} and add a field"
    if new.number != old.number:
        message = f"{owner}.{new.name} has number {new.number} instead of {old.number}"
        yield _conflict(schema, owner, new, Part.NUMBER, message, f"the lock says {_shown(old)}")
    elif new.type != old.type:
        message = f"{owner}.{new.name} is of type {new.type} instead of {old.type}"
        yield _conflict(schema, owner, new, Part.TYPE, message, hint)


def _conflict(schema: ProtoSchema, owner: str, entry: Entry, part: Part, message: str, hint: str) -> Diagnostic:
    span = schema.sources.span(f"{owner}.{entry.name}", part)
    return Diagnostic(span, Code.WIRE_NUMBER_CONFLICT, message, hint)


def _shown(entry: Entry) -> str:
    """As a `.proto` file writes it: `float ph_value = 1`."""
    return f"`{entry.type} {entry.name} = {entry.number}`".replace("` ", "`")
