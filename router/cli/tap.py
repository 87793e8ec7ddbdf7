"""`router tap [HOST:]PORT | --topic NAME`: what arrives on a UDP port or a ROS topic, one line each."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

from router.cli import VERBS
from router.cli.tool_options import add_wire_options, explained, load_wire, whole
from router.errors import StartError
from router.tools import UsageError

if TYPE_CHECKING:
    from router.tools.tapping import Heard, HeardMessage


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "tap",
        help=VERBS["tap"],
        description="Print each envelope that arrives on a UDP port, or each message on a ROS topic, as one line: "
        "the fields that are not default.",
    )
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("place", nargs="?", metavar="[HOST:]PORT", help="or an endpoint or listener of the table")
    where.add_argument("--topic", metavar="NAME", help="a ROS topic instead")
    parser.add_argument("--type", metavar="TYPE", help="of the topic (default: what its publishers say)")
    parser.add_argument("--count", type=whole, metavar="N", help="end after N (default: at Ctrl-C)")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--hex", action="store_true", help="with the bytes of each")
    add_wire_options(parser)


@explained
def run(args: argparse.Namespace) -> int:
    if args.type and not args.topic:
        raise UsageError("--type belongs to --topic")
    try:
        with _topic(args) if args.topic else _port(args) as hearing:
            for heard in itertools.islice(hearing, args.count):
                print(heard.json(args.hex) if args.json else heard.line(args.hex), flush=True)
    except KeyboardInterrupt:
        return 0
    return 0


@contextmanager
def _port(args: argparse.Namespace) -> Iterator[Iterator[Heard | HeardMessage]]:
    from router.tools import places
    from router.tools.tapping import listen

    wire, table = load_wire(args)
    with places.open_udp(places.listening(args.place, table), args.place) as receiver:
        host, port = receiver.getsockname()
        _say(f"listening on {host}:{port}; Ctrl-C ends it")
        yield listen(receiver, wire, places.peer_names(table))


@contextmanager
def _topic(args: argparse.Namespace) -> Iterator[Iterator[Heard | HeardMessage]]:
    try:
        from router.edges.ros_listen import TopicListener
    except ImportError as error:
        raise UsageError(f"a topic needs ROS 2, which is not installed here ({error}); run 'make setup'") from error
    from router.tools.tapping import listen_to_topic

    if args.type is None:
        _say(f"waiting for a publisher of {args.topic}; Ctrl-C ends it")
    try:
        listener = TopicListener(args.topic, args.type)
    except StartError as error:
        raise UsageError(str(error)) from error
    with closing(listener):
        _say(f"listening to {args.topic} of {listener.type_name}; Ctrl-C ends it")
        yield listen_to_topic(listener)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
