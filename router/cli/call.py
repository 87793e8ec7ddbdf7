"""`router call SERVICE field=value ...`: call a ROS service, and print its response and how long it took."""

from __future__ import annotations

import argparse
import json
import os
from contextlib import closing
from typing import TYPE_CHECKING

from router.cli import BAD_USAGE, NETWORK_FAULT, OK, Subparsers, add_verb
from router.cli.completion import completes, request_fields, services
from router.cli.tool_options import add_table, seconds, table_path
from router.errors import StartError, UsageError, did_you_mean, shown_path

if TYPE_CHECKING:
    from router.tools.services import TableService

PATIENCE = 10.0
"""Seconds to wait for a server, and then for its response."""

_DESCRIPTION = f"""Call a ROS service, one of the table or any other with --type, and print the fields of its response
and how long it took. For a service that a board answers, the table's router must be running.

Exit code: {OK} it responded, whatever the response says, {NETWORK_FAULT} no server, or no response, {BAD_USAGE} wrong
usage."""


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(
        subparsers,
        "call",
        _DESCRIPTION,
        "router call arm data=true -t routes/arm.yaml",
        "router call /pump/switch data=true --type std_srvs/srv/SetBool",
    )
    about = "a service of the table, or with --type the name of any service"
    completes(parser.add_argument("service", metavar="SERVICE", help=about), services)
    completes(
        parser.add_argument(
            "fields", nargs="*", metavar="FIELD=VALUE", help="of the request: data=true, pose.x=3, points[1].x=2"
        ),
        request_fields,
    )
    parser.add_argument("--type", metavar="TYPE", help="its type, such as std_srvs/srv/SetBool (default: the table's)")
    parser.add_argument(
        "--timeout",
        type=seconds,
        metavar="DURATION",
        help=f"how long to wait for a server, and then for its response (default: {PATIENCE:g}s, or a second more than "
        "the table's router waits)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object: service, type, seconds, response")
    add_table(parser)


def run(args: argparse.Namespace) -> int:
    from router.compiler.lookup import definitions_of
    from router.rehearsal.cdr import serialize
    from router.ros.environment import check_environment, ros_remedy
    from router.tools.services import halves
    from router.values.printing import one_line, ros_json, ros_tree, words
    from router.values.reading import completed, members_of

    name, type_name, longest = _service(args)
    request, response = halves(type_name)
    cdr = serialize(request, completed(request, members_of(request, args.fields)))
    patience = args.timeout or max(PATIENCE, longest + 1)
    try:
        check_environment(os.environ)
        from router.ros.calling import ServiceCaller

        caller = ServiceCaller(name, type_name, definitions_of(request) | definitions_of(response))
    except StartError as error:
        raise UsageError(*error.args) from error
    except ImportError as error:
        raise UsageError(f"a call needs ROS 2, which is not installed here ({error})", ros_remedy()) from error
    with closing(caller):
        caller.wait(patience)
        message, took = caller.call(cdr, patience)
    if args.json:
        document = {"service": caller.name, "type": type_name, "seconds": round(took, 6), "response": ros_json(message)}
        print(json.dumps(document))
    else:
        shown = one_line(words(ros_tree(message, complete=True)), "(no fields)")
        print(f"{caller.name} responded in {took * 1e3:.1f} ms: {shown}")
    return OK


def _service(args: argparse.Namespace) -> TableService:
    """Return the service that is named. Raises UsageError if its type is not known, TableError for a bad table."""
    from router.table import read_table
    from router.tools.services import TableService, services_of

    if args.type is not None:
        return TableService(args.service, args.type, 0.0)
    services = services_of(read_table(path := table_path(args)))
    if (found := services.get(args.service)) is None:
        near, how = did_you_mean(args.service, services), "for another service, add its --type"
        raise UsageError(f"{shown_path(path)} has no service '{args.service}'", f"{near}; {how}" if near else how)
    return found
