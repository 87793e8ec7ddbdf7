"""`router schema lock`: record the field numbers of the `.proto` files, so that none is ever reused.

It adds new numbers and rejects every other change that is not accepted by name. `router validate` reports the same
changes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from router.assets import is_installed
from router.cli import BAD_TABLE, OK, VERBS, Subparsers, add_verb
from router.cli.findings import print_findings
from router.cli.tool_options import add_table, table_path
from router.errors import Located, SourceSpan, TableError, UsageError, did_you_mean, plural, shown_path
from router.types.lock_file import ENVELOPE, ONEOF, short_name

if TYPE_CHECKING:
    from router.table.model.settings import EnvelopeSettings
    from router.types.lock import Conflict, LockComparison
    from router.types.lock_file import Lock

_DESCRIPTION = f"""Write envelope.lock.json beside the .proto files, or add their new numbers to it. A number that is
reused, or a field that is renumbered, retyped or renamed, is rejected: exit code {BAD_TABLE}, nothing written. If all
boards get new firmware, accept such a change by `--accept`; `router validate` prints the command."""
_PROTOS = "folder of .proto files, instead of a table"
_EXAMPLES = (
    "router schema lock",
    "router schema lock --protos protos",
    "router schema lock --accept Motor.rpm --accept PBEnvelope.imu_info",
)
_LOCK = "lock file (default: the table's, else envelope.lock.json in the folder)"
_ACCEPT = "an intended change, named as in the finding: Message.field, Enum.VALUE, or a whole Message"


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "schema", f"{VERBS['schema'].capitalize()}.", *_EXAMPLES)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    lock = add_verb(actions, "lock", _DESCRIPTION, *_EXAMPLES)
    add_table(lock)
    lock.add_argument("--protos", type=Path, metavar="DIR", help=_PROTOS)
    lock.add_argument("--lock", type=Path, metavar="FILE", help=_LOCK)
    lock.add_argument("--message", metavar="NAME", help=f"envelope (default: that of table or lock, else {ENVELOPE})")
    lock.add_argument("--oneof", metavar="NAME", help=f"its oneof (default: that of table or lock, else {ONEOF})")
    lock.add_argument("--accept", action="append", default=[], metavar="NAME", help=_ACCEPT)


def run(args: argparse.Namespace) -> int:
    """Write the lock file of each envelope. Raises TableError for broken `.proto` files or a broken lock file."""
    from router.types.lock_file import write_lock

    locks = [_compared(args, settings) for settings in _settings(args)]
    conflicts = [conflict for lock in locks for conflict in lock.conflicts]
    accepted = _accepted(args.accept, conflicts)
    if refused := [conflict for conflict in conflicts if conflict not in accepted]:
        print_findings(sorted((conflict.finding for conflict in refused), key=lambda finding: finding.span), sys.stdout)
        if len(conflicts) > 1:
            names = " ".join(f"--accept {conflict.name}" for conflict in conflicts)
            print(f"nothing was written; if all of these changes are intended, accept them together: {names}")
        return BAD_TABLE
    extended = [lock.extended([each for each in lock.conflicts if each in accepted]) for lock in locks]
    for lock, new in zip(locks, extended, strict=True):
        if new != lock.lock:
            write_lock(lock.path, new)
    for conflict in accepted:
        print(f"accepted: {conflict.finding.message}")
    for lock, new in zip(locks, extended, strict=True):
        print(f"{shown_path(lock.path)}: {_summary(lock.lock, new, lock.unbounded)}")
    return OK


def _compared(args: argparse.Namespace, settings: EnvelopeSettings) -> LockComparison:
    """Return the differences between the protos of an envelope and its lock file."""
    from router.types.envelopes import chosen_envelope
    from router.types.lock import LockComparison
    from router.types.lock_file import read_lock
    from router.types.protobuf import load_protos, lock_path

    path = lock_path(settings.protos, settings.lock_file)
    if is_installed(path):
        what = f"{path} belongs to the installed router: the next upgrade overwrites it"
        raise UsageError(what, "copy the protos with `router init --rover DIR`, and name the copy: --protos protos")
    settings = _with_names(settings, args, read_lock(path))
    schema = load_protos(
        settings.protos, settings.message, settings.lock_file, settings.exclude, with_others=settings.has_many
    )
    return LockComparison(chosen_envelope(schema, settings.choice), None if args.protos else table_path(args))


def _settings(args: argparse.Namespace) -> Sequence[EnvelopeSettings]:
    """Return the places of protos and lock of each envelope. Raises TableError for a broken table."""
    if args.protos and args.table:
        raise UsageError("--protos and --table both say where the messages are", "give only one")
    found = [_of_folder(args.protos)] if args.protos else _of_table(table_path(args))
    if len(found) > 1 and (args.lock or args.message or args.oneof):
        raise UsageError("the table has several envelopes", "name the folder of one: --protos DIR")
    if args.lock:
        return [replace(each, lock=Located(args.lock.absolute(), each.protos.span)) for each in found]
    return found


def _of_folder(root: Path) -> EnvelopeSettings:
    from router.table.model.settings import EnvelopeSettings

    span = SourceSpan(shown_path(root))
    return EnvelopeSettings(Located(root.absolute(), span), Located("", span))


def _of_table(path: Path) -> Sequence[EnvelopeSettings]:
    from router.compiler.envelopes import shared_lock_findings
    from router.table import load_table

    table, findings = load_table(path)
    if table is None:
        raise TableError(findings)
    if not table.envelopes:
        raise UsageError(f"{path} has no 'envelope'", "name the folder of the protos: --protos protos")
    if shared := list(shared_lock_findings(table)):
        raise TableError(shared)
    return [*table.envelopes.values()]


def _with_names(settings: EnvelopeSettings, args: argparse.Namespace, lock: Lock | None) -> EnvelopeSettings:
    """Set the names of envelope and oneof: as typed, else as in the table, else as in the lock, without package."""
    locked = (short_name(lock.message), lock.oneof) if lock is not None else (ENVELOPE, ONEOF)
    span = settings.protos.span
    settings = replace(settings, message=Located(args.message or settings.message.value or locked[0], span))
    if args.oneof is None and settings.choice:
        return settings
    if args.oneof is None and not locked[1]:
        what = "the lock file is of an envelope without a oneof"
        raise UsageError(what, "give its table: --table FILE, not --protos")
    return replace(settings, oneof=Located(args.oneof or locked[1], span), case=None)


def _accepted(names: Sequence[str], conflicts: Sequence[Conflict]) -> list[Conflict]:
    """Return the `conflicts` that `names` refer to. Raises UsageError for a name that fits none or several."""
    accepted = [conflict for name in names for conflict in _meant(name, conflicts)]
    return [conflict for conflict in conflicts if conflict in accepted]


def _meant(name: str, conflicts: Sequence[Conflict]) -> list[Conflict]:
    """Return the conflict of that name, or all conflicts of a message. `name` may omit package and enclosing messages.

    A field may also be named as in the lock. Raises UsageError.
    """
    if exact := [conflict for conflict in conflicts if name in (conflict.name, conflict.owner)]:
        return exact
    known = {full for conflict in conflicts for full in (conflict.name, conflict.owner)}
    former = {f"{conflict.owner}.{entry.name}": conflict.name for conflict in conflicts for entry in conflict.entries}
    full = sorted(known_name for known_name in known if known_name.endswith(f".{name}"))
    full = full or sorted({now for was, now in former.items() if f".{was}".endswith(f".{name}")})
    if len(full) == 1:
        return _meant(full[0], conflicts)
    if full:
        raise UsageError(f"'{name}' may be {' or '.join(full)}; nothing was written", "write its full name")
    hint = did_you_mean(name, known) or "nothing conflicts with the lock"
    raise UsageError(f"'{name}' has no change to accept; nothing was written", hint)


def _summary(old: Lock | None, new: Lock, unbounded: str) -> str:
    """Summarise the lock. `unbounded` says why there is no largest envelope; "" if there is one."""
    added = _numbers(new) - (_numbers(old) if old is not None else set())
    size = f"an envelope takes up to {new.max_size} bytes"
    if unbounded:
        size = f"an envelope has no largest size, because {unbounded}"
        size += f"; others take up to {new.max_size} bytes" if new.max_size else ""
    if old is not None and old.max_size != new.max_size:
        size += f" (it was {old.max_size}: flash the boards)"
    return f"{plural(len(new.messages), 'message')}, {plural(len(added), 'new number')}; {size}"


def _numbers(lock: Lock) -> set[tuple[str, int, str]]:
    """Return the numbers in use, regardless of the package."""
    declared = (*lock.messages.items(), *lock.enums.items())
    return {(short_name(owner), entry.number, entry.name) for owner, members in declared for entry in members.entries}
