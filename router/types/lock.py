"""Comparison of the `.proto` files with the lock file: field numbers are permanent.

A number that changes its meaning is an error, because boards in the field keep the old one. An addition is a warning
until `router schema lock` records it.

The wire format has no names of packages and oneofs. A locked declaration that has disappeared is therefore compared
with the one of the same name in another package. A message or enum with a different name counts as another one,
whatever its content: a rename cannot be detected.
"""

from __future__ import annotations

import shlex
from collections import Counter, defaultdict
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import DescriptorProto

from router.errors import Code, Diagnostic, Located, SourceSpan, TableError, shown_path
from router.types.descriptors import declared_type
from router.types.lock_file import (
    BY_ONEOF,
    ENVELOPE,
    LOCK_NAME,
    ONEOF,
    Declaration,
    Entry,
    Lock,
    by_number,
    read_lock,
    short_name,
)
from router.types.proto_source import Part
from router.types.protobuf import Envelope, ProtoSchema


@dataclass(frozen=True, slots=True)
class Conflict:
    """An incompatible change of the wire format: its name for `router schema lock --accept`, and the finding.

    `owner` is the message or enum. `entries` are its locked members whose numbers lose their meaning.
    """

    name: str
    owner: str
    finding: Diagnostic
    entries: frozenset[Entry] = frozenset()


class LockComparison:
    """The differences between the `.proto` files and their lock file, which is read once.

    `table` names the envelope; the command that records the protos needs it if they are not enough.
    `lock` is the content of the file, or None. `conflicts` are incompatible changes, `additions` are warnings about new
    declarations, `faults` are problems with the file itself.
    """

    def __init__(self, envelope: Envelope, table: Path | None = None) -> None:
        self._schema = schema = envelope.schema
        self._envelope = envelope
        self._current = _current_lock(schema, envelope)
        self.lock: Lock | None = None
        self.faults: Sequence[Diagnostic] = ()
        self.conflicts: list[Conflict] = []
        self.additions: list[Diagnostic] = []
        try:
            self.lock = read_lock(schema.lock)
        except TableError as error:
            self.faults = error.diagnostics
        self._command = _command(schema, envelope, self.lock, table)
        if self.lock is not None:
            self._compare_with(self.lock)

    @property
    def path(self) -> Path:
        return self._schema.lock

    @property
    def unbounded(self) -> str:
        """Why the envelope has no largest encoding; "" if it has one."""
        return self._schema.unbounded(self._envelope.name)

    @property
    def max_size(self) -> int | None:
        """The envelope's largest encoding in bytes according to the lock, None without a readable lock."""
        return self.lock.max_size if self.lock is not None else None

    def findings(self, named: Located[Path] | None = None) -> list[Diagnostic]:
        """Return every difference, or the problems of the lock file itself, ordered by position.

        `named` is the lock file that the table names, if it does: then it must exist.
        """
        if self.lock is not None:
            errors = [conflict.finding for conflict in self.conflicts]
            return sorted([*errors, *self.additions], key=lambda finding: finding.span)
        if self.faults:
            return list(self.faults)
        hint = f"create it with `{self._command}`"
        if named is not None:
            what = f"there is no lock file {shown_path(self._schema.lock)}"
            return [Diagnostic(named.span, Code.BAD_FILE, what, hint)]
        message = "no lock file records the field numbers"
        return [Diagnostic(self._schema.span(self._envelope.name), Code.NOT_LOCKED, message, hint)]

    def extended(self, accepted: Collection[Conflict] = ()) -> Lock:
        """Return the lock with all additions, and without the entries that the accepted conflicts break.

        Raises TableError if the lock file is broken. The caller must have refused all other conflicts.
        """
        if self.faults:
            raise TableError(self.faults)
        if self.lock is None:
            return self._current
        dropped: dict[str, set[Entry]] = defaultdict(set)
        for conflict in accepted:
            dropped[conflict.owner] |= conflict.entries
        locked, _ = _in_new_names(self.lock, self._current)
        return replace(
            self._current,
            messages=_extended(locked.messages, self._current.messages, dropped),
            enums=_extended(locked.enums, self._current.enums, dropped),
        )

    def _compare_with(self, lock: Lock) -> None:
        schema, envelope, current = self._schema, self._envelope, self._current
        locked, names = _in_new_names(lock, current)
        for was, now in ((locked.messages, current.messages), (locked.enums, current.enums)):
            for name, declaration in now.items():
                if name in was:
                    self._compare(name, was[name], declaration)
                else:
                    self._add(schema.span(name), f"{name} is not in the lock")
        self._compare_envelopes(envelope, lock, locked, names)

    def _compare_envelopes(self, envelope: Envelope, lock: Lock, locked: Lock, names: Mapping[str, str]) -> None:
        span = self._schema.span(envelope.name)
        choice = envelope.choice
        if (names.get(lock.message, lock.message), locked.by, locked.oneof) != (envelope.name, choice.by, choice.oneof):
            was, now = _envelope_text(lock), _envelope_text(self._current)
            message = f"the lock is for the envelope {was}, not {now}"
            what = choice.oneof or choice.by
            self._refuse(envelope.name, what, span, message, "name the locked envelope in the table")
        if names:
            old = min(names)
            more = f" (and {len(names) - 1} more)" if len(names) > 1 else ""
            self._add(
                span, f"the lock records {names[old]} under its old name {old}{more}", "the wire format is the same; "
            )
        if lock.max_size != envelope.max_size and not self.conflicts:
            but = ", not counting fields without a bound" if self._schema.unbounded(envelope.name) else ""
            message = f"{envelope.name} takes up to {envelope.max_size} bytes{but}; the lock says {lock.max_size}"
            self._add(span, message, "flash the boards, then ")

    def _compare(self, owner: str, locked: Declaration, current: Declaration) -> None:
        """Compare the members of one message or enum by number, except locked ones whose number is now reserved."""
        reserved = self._schema.reserved_numbers(owner)
        live = [entry for entry in by_number(locked) if not any(entry.number in span for span in reserved)]
        moved = set()
        for entry in by_number(current):
            holders = [old for old in live if old.number == entry.number]
            if any(old.name == entry.name for old in holders):
                self._compare_types(owner, next(old for old in holders if old.name == entry.name), entry)
            elif any(old.name == entry.name for old in live):
                moved.add(entry.name)
                self._refuse_number(owner, [old for old in live if old.name == entry.name], entry, holders)
            elif holders and not any((old.number, old.name) in _names(current) for old in holders):
                self._refuse_holder(owner, holders[0], entry)
            elif any(first <= entry.number <= last for first, last in locked.reserved):
                message = f"number {entry.number} of {owner} is reserved, but used for '{entry.name}'"
                hint = "use a free number: the lock says that this one is reserved"
                self._refuse(owner, entry.name, self._span(owner, entry, Part.NUMBER), message, hint)
            else:
                self._add(self._schema.span(owner, entry.name), f"{owner}.{entry.name} is not in the lock")
        numbers = {entry.number for entry in current.entries}
        for entry in live:
            if entry.number not in numbers and entry.name not in moved:
                number = entry.number
                message = f"number {number} of {owner}, formerly '{entry.name}', is not reserved"
                hint = f"write `reserved {number};` there: the lock has {_shown(entry)}"
                self._refuse(owner, entry.name, self._schema.span(owner), message, hint, {entry})

    def _compare_types(self, owner: str, old: Entry, new: Entry) -> None:
        if (new.type, new.oneof) == (old.type, old.oneof):
            return
        differences = []
        if new.type != old.type:
            differences.append(f"is of type {new.type} instead of {old.type}")
        if new.oneof != old.oneof:
            differences.append(_move(old.oneof, new.oneof))
        message = f"{owner}.{new.name} {' and '.join(differences)}"
        back = _restore(old) if new.type != old.type else "move it back"
        hint = f"{back}, or reserve {old.number} and add a field with a free number"
        part = Part.TYPE if new.type != old.type else Part.NAME
        self._refuse(owner, new.name, self._span(owner, new, part), message, hint, {old})

    def _refuse_number(self, owner: str, olds: Sequence[Entry], new: Entry, holders: Sequence[Entry]) -> None:
        old = olds[-1]
        message = f"{owner}.{new.name} has number {new.number} instead of {old.number}"
        if new.type != old.type:
            message += f" and is of type {new.type} instead of {old.type}"
        hint = _restore(old)
        if holders:
            hint += f": {new.number} belongs to '{holders[0].name}'"
        span = self._span(owner, new, Part.NUMBER)
        self._refuse(owner, new.name, span, message, hint, {*holders, *olds})

    def _refuse_holder(self, owner: str, holder: Entry, new: Entry) -> None:
        was, now = (f"'{member.name}'" for member in (holder, new))
        if holder.type != new.type:
            was, now = (f"'{member.type} {member.name}'" for member in (holder, new))
        message = f"number {new.number} of {owner} belongs to {was}, not to {now}"
        hint = f"{_restore(holder)}, or reserve {new.number} and use a free number"
        self._refuse(owner, new.name, self._span(owner, new, Part.NUMBER), message, hint, {holder})

    def _span(self, owner: str, entry: Entry, part: Part) -> SourceSpan:
        return self._schema.sources.span(f"{owner}.{entry.name}", part)

    def _refuse(
        self, owner: str, member: str, span: SourceSpan, message: str, hint: str, entries: Iterable[Entry] = ()
    ) -> None:
        name = f"{owner}.{member}"
        hint += f"; if the change is intended, run `{self._command} --accept {name}`"
        finding = Diagnostic(span, Code.WIRE_NUMBER_CONFLICT, message, hint)
        self.conflicts.append(Conflict(name, owner, finding, frozenset(entries)))

    def _add(self, span: SourceSpan, message: str, before: str = "") -> None:
        self.additions.append(Diagnostic(span, Code.NOT_LOCKED, message, f"{before}record it with `{self._command}`"))


def _names(declared: Declaration) -> set[tuple[int, str]]:
    return {(entry.number, entry.name) for entry in declared.entries}


def _move(old: str, new: str) -> str:
    """Describe how a field moved between oneofs; an empty name is no oneof."""
    if old and new:
        return f"has moved from the oneof '{old}' to '{new}'"
    return f"has moved into the oneof '{new}'" if new else f"has moved out of the oneof '{old}'"


def _restore(old: Entry) -> str:
    return f"restore {_shown(old).replace('enum ', '')} from the lock"


def _shown(entry: Entry) -> str:
    """Print an entry as in a `.proto` file: `float ph_value = 1`, but with `enum` before the type of an enum."""
    return f"`{entry.type} {entry.name} = {entry.number}`".replace("` ", "`")


def _envelope_text(lock: Lock) -> str:
    return f"{lock.message}.{lock.oneof}" if lock.by == BY_ONEOF else f"{lock.message} (by {lock.by})"


def _command(schema: ProtoSchema, envelope: Envelope, lock: Lock | None, table: Path | None) -> str:
    """Return the command that records these protos, to be run in the router's working directory."""
    if table is not None and (envelope.label or envelope.choice.by != BY_ONEOF):
        return shlex.join(["router", "schema", "lock", "--table", shown_path(table)])
    message, oneof = (lock.message, lock.oneof) if lock is not None else (ENVELOPE, ONEOF)
    words = ["router", "schema", "lock", "--protos", shown_path(schema.root)]
    if schema.lock != schema.root / LOCK_NAME:
        words += ["--lock", shown_path(schema.lock)]
    if short_name(envelope.name) != short_name(message):
        words += ["--message", envelope.name]
    if envelope.choice.oneof != oneof:
        words += ["--oneof", envelope.choice.oneof]
    return shlex.join(words)


def _current_lock(schema: ProtoSchema, envelope: Envelope) -> Lock:
    """Return the lock that describes the `.proto` files as they are."""
    messages = {}
    for name in schema.messages:
        if (file := schema.sources.file(name)) in schema.files:
            entries = frozenset(_entries(schema.descriptor(name)))
            messages[name] = Declaration(file, entries, _reserved(schema, name))
    enums = {}
    for name, declared in schema.enums.items():
        if (file := schema.sources.file(name)) in schema.files:
            entries = frozenset(Entry(number, value) for value, number in declared.values)
            enums[name] = Declaration(file, entries, _reserved(schema, name))
    choice = envelope.choice
    return Lock(envelope.name, choice.oneof, envelope.max_size, messages, enums, choice.by)


def _entries(message: Descriptor) -> Iterator[Entry]:
    declared = DescriptorProto()
    message.CopyToProto(declared)
    optional = {field.number for field in declared.field if field.proto3_optional}  # protoc makes a oneof for each
    for field in message.fields:
        oneof = field.containing_oneof if field.number not in optional else None
        yield Entry(field.number, field.name, declared_type(field), oneof.name if oneof is not None else "")


def _reserved(schema: ProtoSchema, name: str) -> frozenset[tuple[int, int]]:
    return frozenset((numbers.start, numbers.stop - 1) for numbers in schema.reserved_numbers(name))


def _extended(
    locked: Mapping[str, Declaration], current: Mapping[str, Declaration], dropped: Mapping[str, set[Entry]]
) -> Mapping[str, Declaration]:
    extended = {**locked, **current}
    for name in locked.keys() & current.keys():
        now = current[name].entries
        named = {(entry.number, entry.name) for entry in now}
        kept = {entry for entry in locked[name].entries if (entry.number, entry.name) not in named}
        reserved = locked[name].reserved | current[name].reserved
        extended[name] = replace(current[name], entries=now | (kept - dropped.get(name, set())), reserved=reserved)
    return extended


def _in_new_names(lock: Lock, current: Lock) -> tuple[Lock, Mapping[str, str]]:
    """Return the lock with the current names of messages, enums and oneofs, and the renames from old to new.

    An envelope that has disappeared is compared with the current one despite the different name: its numbers matter.
    """
    moved = _moved(lock, current)
    names = dict(moved)
    if lock.message not in current.messages and current.message not in lock.messages:
        names.setdefault(lock.message, current.message)
    messages = _renamed(lock.messages, names)
    for name in sorted(messages.keys() & current.messages):
        if not (oneofs := _renamed_oneofs(messages[name], current.messages[name])):
            continue
        entries = {replace(entry, oneof=oneofs.get(entry.oneof, entry.oneof)) for entry in messages[name].entries}
        messages[name] = replace(messages[name], entries=frozenset(entries))
        moved |= {f"{name}.{old}": f"{name}.{new}" for old, new in oneofs.items()}
    message = names.get(lock.message, lock.message)
    oneof = moved.get(f"{message}.{lock.oneof}", "").rpartition(".")[2] or lock.oneof
    enums = _renamed(lock.enums, names)
    return replace(lock, message=message, oneof=oneof, messages=messages, enums=enums), moved


def _moved(lock: Lock, current: Lock) -> dict[str, str]:
    """Map full names that have disappeared to new ones, where only the package differs unambiguously."""
    moved: dict[str, str] = {}
    for locked, there in ((lock.messages, current.messages), (lock.enums, current.enums)):
        new = [(_without_package(name, current.messages), name) for name in there if name not in locked]
        gone = [(_without_package(name, lock.messages), name) for name in locked if name not in there]
        counts = Counter(short for short, _ in gone)
        known = dict(new)
        moved |= {name: known[short] for short, name in gone if short in known and counts[short] == 1}
    return moved


def _without_package(name: str, messages: Container[str]) -> str:
    """Return `Motor.State` for `rover.Motor.State`, if there is a message `rover.Motor`."""
    around, _, last = name.rpartition(".")
    return f"{_without_package(around, messages)}.{last}" if around in messages else last


def _renamed(declared: Mapping[str, Declaration], names: Mapping[str, str]) -> dict[str, Declaration]:
    if not names:
        return dict(declared)
    renamed: dict[str, Declaration] = {}
    for name, declaration in declared.items():
        entries = set()
        for entry in declaration.entries:
            label, space, type_ = entry.type.rpartition(" ")
            entries.add(replace(entry, type=label + space + names.get(type_, type_)))
        new = names.get(name, name)
        before = renamed[new].entries if new in renamed else frozenset()
        renamed[new] = replace(declaration, entries=before | entries)
    return renamed


def _renamed_oneofs(locked: Declaration, current: Declaration) -> dict[str, str]:
    """Map the name of a oneof that has disappeared to that of a new one with one of its members."""
    was = {entry.oneof for entry in locked.entries}
    if was == {entry.oneof for entry in current.entries}:
        return {}
    now = {entry.number: entry.oneof for entry in current.entries}
    renamed: dict[str, str] = {}
    for entry in by_number(locked):
        new = now.get(entry.number, "")
        is_gone, is_new = entry.oneof not in now.values(), new not in was
        if entry.oneof and new and is_gone and is_new and new not in renamed.values():
            renamed.setdefault(entry.oneof, new)
    return renamed
