"""`router tap [HOST:]PORT`: decode the envelopes that arrive on a port, one line each."""

from __future__ import annotations

import argparse
import itertools
import sys

from router.cli import VERBS
from router.cli.tool_options import add_wire_options, explained, load_wire, whole


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "tap",
        help=VERBS["tap"],
        description="Bind a UDP port and print each arriving envelope as one line: the fields that are not default.",
    )
    parser.add_argument("place", metavar="[HOST:]PORT", help="or an endpoint or listener of the table")
    parser.add_argument("--count", type=whole, metavar="N", help="end after N datagrams (default: at Ctrl-C)")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--hex", action="store_true", help="with each datagram's bytes")
    add_wire_options(parser)


@explained
def run(args: argparse.Namespace) -> int:
    from router.tools import places
    from router.tools.tapping import listen

    wire, table = load_wire(args)
    with places.open_udp(places.listening(args.place, table), args.place) as receiver:
        host, port = receiver.getsockname()
        print(f"listening on {host}:{port}; Ctrl-C ends it", file=sys.stderr)
        try:
            for heard in itertools.islice(listen(receiver, wire, places.peer_names(table)), args.count):
                print(heard.json(args.hex) if args.json else heard.line(args.hex), flush=True)
        except KeyboardInterrupt:
            return 0
    return 0
