"""`router new NAME --number N --board BOARD`: a message of its own, in every file that has to know of it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import BAD_TABLE, OK, Subparsers, add_verb
from router.cli.completion import completes, senders
from router.cli.findings import print_findings
from router.cli.tool_options import add_table, integer, table_path

if TYPE_CHECKING:
    from router.compiler import Checked
    from router.errors import Diagnostic
    from router.tools.new_message import NewMessage, Site
    from router.tools.new_message_files import Written

_DESCRIPTION = """Add a message of a board to a checkout of the rover: its .proto file, its number in
the envelope and in the lock, the ROS message in schemas/comms, a route from the board to ROS and the basestation, and a
test of it. Files keep their comments and their layout. What cannot be is refused, and then nothing is written. A table
of your own, elsewhere, needs no such command: write message and route, then run 'router schema lock'."""
_FIELDS = """such as `dose_rate:float state:SensorState`, or, with its unit, a single 'dose_rate:float # uSv/h'; types
are bool, float, double, int32, int64, uint32, uint64, and enums and messages of the protos"""

_EXAMPLES = (
    "router new SensorBoardRadiationInfo --number 27 --board sensor",
    "router new ArmBoardGrip --number 28 --board arm --fields 'force:float # N'",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "new", _DESCRIPTION, *_EXAMPLES)
    parser.add_argument("name", metavar="NAME", help="of the message: its board, then what it is, as one word each")
    parser.add_argument("--number", type=integer, required=True, metavar="N", help="in the envelope, never used before")
    completes(
        parser.add_argument(
            "--board", required=True, metavar="BOARD", help="endpoint that sends it, `_board` may be missing"
        ),
        senders,
    )
    parser.add_argument("--fields", nargs="+", default=(), metavar="FIELD", help=_FIELDS)
    add_table(parser)


def run(args: argparse.Namespace) -> int:
    from router.tools.new_message import new_message
    from router.tools.new_message_files import Written, changes, locked

    path = table_path(args)
    before = _check(path)
    errors = [finding for checked in before for finding in checked.diagnostics if checked.has_errors]
    if errors:
        print_findings(errors, sys.stderr)
        print("router new: repair that first; nothing was written", file=sys.stderr)
        return BAD_TABLE
    site = _site(before[0])
    _check_schemas(path)
    message = new_message(args.name, args.number, args.board, args.fields, site)
    planned = changes(message, site, [checked.table for checked in before[1:] if checked.table is not None])
    written = Written(planned.texts)
    try:
        written.write(site.schema.lock, locked(site))
        after = _check(path)
        print_findings(_news(before, after), sys.stderr)
    except BaseException:  # Ctrl-C, too
        written.undo()
        raise
    if any(checked.has_errors for checked in after):
        written.undo()
        print("router new: the message would be wrong like this; nothing was written", file=sys.stderr)
        return BAD_TABLE
    _report(message, written, planned.unrouted, site, _site(after[0]))
    return OK


def _check(table: Path) -> list[Checked]:
    """Check the table, and those beside it."""
    from router.cli.validate import find_tables
    from router.compiler import check_table
    from router.compiler.lookup import Definitions

    definitions = Definitions()
    checked = check_table(table, definitions=definitions)
    if checked.table is None:  # there may be no folder either
        return [checked]
    beside = [path for path in find_tables([table.parent]) if path.resolve() != table.resolve()]
    return [checked, *(check_table(path, definitions=definitions) for path in beside)]


def _check_schemas(table: Path) -> None:
    """Raises UsageError unless the router's ROS messages are those beside the folder of the table."""
    from router.assets import asset, is_installed
    from router.errors import UsageError, shown_path

    schemas = asset("schemas")
    if is_installed(schemas) or table.resolve().parent.parent != schemas.resolve().parent:
        what = f"the ROS messages of this router ({shown_path(schemas)}) do not belong to {shown_path(table)}"
        raise UsageError(
            what, "use the router of that table's checkout, or write by hand what docs/guides/add-a-message.md lists"
        )


def _site(checked: Checked) -> Site:
    from router.assets import asset
    from router.tools.new_message import site_of

    return site_of(checked, asset("schemas") / "comms" / "msg")


def _news(before: Sequence[Checked], after: Sequence[Checked]) -> list[Diagnostic]:
    """Findings that are new, compared by message, since lines have moved."""
    known = {(finding.code, finding.message) for checked in before for finding in checked.diagnostics}
    found = {finding: None for checked in after for finding in checked.diagnostics}
    return [finding for finding in found if (finding.code, finding.message) not in known]


def _report(message: NewMessage, written: Written, unrouted: Sequence[Path], before: Site, after: Site) -> None:
    from router.errors import shown_path

    fields = ", ".join(f"{field.name}: {field.type}" for field in message.fields)
    print(f"{message.name} is payload case {message.case}, number {message.number}: {fields}")
    for path in written.new:
        print(f"  new      {shown_path(path)}")
    for path in written.changed:
        print(f"  changed  {shown_path(path)}")
    for path in unrouted:
        print(f"  route it yourself in {shown_path(path)}: what that does with it nobody but you knows")
    if after.envelope.max_size > before.envelope.max_size:
        bounded = " that has a bound" if after.schema.unbounded(after.envelope.name) else ""
        print(f"The largest envelope{bounded} grew from {before.envelope.max_size} to {after.envelope.max_size} bytes:")
        print("flash all boards, because those that decode it have to have room for that.")
    print("Next: `make setup` builds the ROS message; `router validate --strict` and `router test` prove the table.")
