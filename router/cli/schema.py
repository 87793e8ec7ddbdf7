"""`router schema lock`: record the field numbers of the `.proto` files, so that none is ever reused.

Adds what is new and refuses everything else; comparing without writing is part of `router validate`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from router.assets import asset, is_installed
from router.cli import BAD_TABLE, OK, VERBS
from router.cli.findings import plural, print_findings
from router.cli.tool_options import explained
from router.errors import Severity, SourceSpan, shown_path
from router.tools import UsageError

if TYPE_CHECKING:
    from router.types.lock_file import Lock
    from router.types.protobuf import Envelope, ProtoSchema

ENVELOPE, ONEOF = "PBEnvelope", "payload"
_DESCRIPTION = f"""Write envelope.lock.json beside the .proto files, or add to it what is new there.
A number that is reused, renumbered, retyped or renamed is refused: exit code {BAD_TABLE}, nothing written."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("schema", help=VERBS["schema"])
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    lock = actions.add_parser("lock", help="record new field numbers in the lock file", description=_DESCRIPTION)
    lock.add_argument("--protos", type=Path, metavar="DIR", help="folder of .proto files (default: the rover's)")
    lock.add_argument("--message", metavar="NAME", help=f"the envelope (default: as the lock says, else {ENVELOPE})")
    lock.add_argument("--oneof", metavar="NAME", help=f"its oneof (default: as the lock says, else {ONEOF})")


@explained
def run(args: argparse.Namespace) -> int:
    """Raises TableError for broken `.proto` files and a broken lock file."""
    from router.types.lock import check_lock, extended_lock
    from router.types.lock_file import LOCK_NAME, read_lock, write_lock
    from router.types.protobuf import load_protos

    root = args.protos or asset("protos")
    path = root / LOCK_NAME
    if is_installed(path):
        what = f"{path} belongs to the installed router, and is lost when that is upgraded"
        raise UsageError(f"{what}; copy the protos with `router init`, and name yours: --protos protos")
    schema = load_protos(root)
    old = read_lock(root)
    envelope = _envelope(schema, old, args)
    findings = check_lock(schema, envelope)
    errors = [finding for finding in findings if finding.severity is Severity.ERROR]
    if errors:
        print_findings(errors, sys.stdout)
        return BAD_TABLE
    new = extended_lock(schema, envelope)
    if new != old:
        write_lock(root, new)
    print(f"{shown_path(path)}: {_summary(old, new)}")
    return OK


def _envelope(schema: ProtoSchema, old: Lock | None, args: argparse.Namespace) -> Envelope:
    from router.table.model import EnvelopeSettings, Located
    from router.types.protobuf import find_envelope

    message = args.message or (old.message if old is not None else ENVELOPE)
    oneof = args.oneof or (old.oneof if old is not None else ONEOF)
    span = SourceSpan(shown_path(schema.root))
    return find_envelope(
        schema, EnvelopeSettings(Located(schema.root, span), Located(message, span), Located(oneof, span))
    )


def _summary(old: Lock | None, new: Lock) -> str:
    added = _count(new) - (_count(old) if old is not None else 0)
    size = f"an envelope takes up to {new.max_size} bytes"
    if old is not None and old.max_size != new.max_size:
        size += f" (it was {old.max_size}: flash the boards)"
    return f"{plural(len(new.messages), 'message')}, {plural(added, 'new number')}; {size}"


def _count(lock: Lock) -> int:
    """Numbers given out."""
    return sum(len(declared.entries) for declared in (*lock.messages.values(), *lock.enums.values()))
