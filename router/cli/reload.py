"""`router reload`: make a running router reload its table, unless the table has errors."""

from __future__ import annotations

import argparse
import json
import sys

from router.cli import BAD_TABLE, BAD_USAGE, OK, Subparsers, add_verb
from router.cli.tool_options import add_router_options, running_url
from router.errors import TransportError

PATIENCE = 60.0
"""Timeout in seconds; compiling a large table takes about one second under heavy traffic."""

_DESCRIPTION = f"""\
Make a running router read its table again, with all files that the table names. It changes to the new table between two
datagrams: no message is lost, and unchanged parts keep running. A table with errors is rejected, and its findings are
printed. SIGHUP does the same, and logs the result.

Exit code: {OK} reloaded, {BAD_USAGE} wrong usage, {BAD_TABLE} rejected, 1 no router answers."""


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "reload", _DESCRIPTION, "router reload", "router reload -t routes/sim.yaml")
    add_router_options(parser)
    parser.add_argument("--json", action="store_true", help="the result as a JSON object: ok, text, findings")


def run(args: argparse.Namespace) -> int:
    from router.tools.running_router import post

    try:
        answer = post(running_url(args), "/-/reload", PATIENCE)
    except TransportError as error:
        if args.json:
            print(json.dumps({"ok": False, "text": error.what, "findings": []}))
        raise
    if args.json:
        print(json.dumps(answer.body))
        return OK if answer.ok else BAD_TABLE
    for finding in answer.body.get("findings", ()):
        print(finding, file=sys.stderr)
    text = answer.body.get("text", "")
    if not answer.ok:
        print(f"router reload: rejected; the old table is still running: {text}", file=sys.stderr)
        return BAD_TABLE
    print(text)
    return OK
