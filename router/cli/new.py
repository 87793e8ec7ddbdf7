"""`router new NAME --number N --board BOARD`: add a message to every file that must declare or use it."""

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

_DESCRIPTION = """Add a board's message to a checkout of the rover: its .proto file, its number in the
envelope and in the lock, the ROS message in schemas/comms, a route from the board to ROS and the basestation, and a
test of the route. Files keep their comments and layout. If anything about the message is invalid, nothing is written.
In a project of your own, write message and route by hand, then run 'router schema lock'."""
_FIELDS = """for example `dose_rate:float state:SensorState`, or one field with its unit: 'dose_rate:float # uSv/h';
types are bool, float, double, int32, int64, uint32, uint64, and enums and messages of the protos"""

_EXAMPLES = (
    "router new SensorBoardRadiationInfo --number 27 --board sensor",
    "router new ArmBoardGrip --number 28 --board arm --fields 'force:float # N'",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "new", _DESCRIPTION, *_EXAMPLES)
    parser.add_argument("name", metavar="NAME", help="name of the message, in CamelCase, beginning with the board")
    parser.add_argument("--number", type=integer, required=True, metavar="N", help="field number, never used before")
    completes(
        parser.add_argument(
            "--board", required=True, metavar="BOARD", help="its sender, an endpoint; `_board` may be omitted"
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
        print("router new: fix these errors first; nothing was written", file=sys.stderr)
        return BAD_TABLE
    site = _site(before[0])
    _check_schemas(path)
    message = new_message(args.name, args.number, args.board, args.fields, site)
    planned = changes(message, site, [checked.table for checked in before[1:] if checked.table is not None])
    written = Written(planned.texts)
    try:
        written.write(site.schema.lock, locked(site))
        after = _check(path)
        print_findings(_new_findings(before, after), sys.stderr)
    except BaseException:  # including Ctrl-C
        written.undo()
        raise
    if any(checked.has_errors for checked in after):
        written.undo()
        print("router new: the message would cause these errors; nothing was written", file=sys.stderr)
        return BAD_TABLE
    _report(message, written, planned.unrouted, site, _site(after[0]))
    return OK


def _check(table: Path) -> list[Checked]:
    """Check the table and the other tables in its folder."""
    from router.cli.validate import find_tables
    from router.compiler import check_table
    from router.compiler.lookup import Definitions

    definitions = Definitions()
    checked = check_table(table, definitions=definitions)
    if checked.table is None:  # perhaps there is not even a folder
        return [checked]
    beside = [path for path in find_tables([table.parent]) if path.resolve() != table.resolve()]
    return [checked, *(check_table(path, definitions=definitions) for path in beside)]


def _check_schemas(table: Path) -> None:
    """Check that the router's ROS messages are those beside the folder of the table. Raises UsageError."""
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


def _new_findings(before: Sequence[Checked], after: Sequence[Checked]) -> list[Diagnostic]:
    """Return the new findings, compared by message, because lines have moved."""
    known = {(finding.code, finding.message) for checked in before for finding in checked.diagnostics}
    findings = {finding: None for checked in after for finding in checked.diagnostics}
    return [finding for finding in findings if (finding.code, finding.message) not in known]


def _report(message: NewMessage, written: Written, unrouted: Sequence[Path], before: Site, after: Site) -> None:
    from router.errors import shown_path

    fields = ", ".join(f"{field.name}: {field.type}" for field in message.fields)
    print(f"{message.name} is payload case {message.case}, number {message.number}: {fields}")
    for path in written.new:
        print(f"  new      {shown_path(path)}")
    for path in written.changed:
        print(f"  changed  {shown_path(path)}")
    for path in unrouted:
        print(f"  add a route yourself in {shown_path(path)}: only you know what that table should do with it")
    if after.envelope.max_size > before.envelope.max_size:
        bounded = " that has a bound" if after.schema.unbounded(after.envelope.name) else ""
        print(f"The largest envelope{bounded} grew from {before.envelope.max_size} to {after.envelope.max_size} bytes:")
        print("flash all boards, because those that decode it need a larger buffer.")
    print("Next: `make setup` builds the ROS message; `router validate --strict` and `router test` check the table.")
