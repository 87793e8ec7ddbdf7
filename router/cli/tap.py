"""`router tap [CASE...]`: what a running router receives; with PLACE or `--topic NAME`, a UDP port or a ROS topic."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING

from router.cli import VERBS
from router.cli.tool_options import add_url_option, add_wire_options, load_wire, running_url, say, whole
from router.errors import StartError, UsageError, nearest
from router.ros.environment import check_environment, ros_remedy

if TYPE_CHECKING:
    from router.engine.wire import Wire
    from router.table.model import RouteTable
    from router.tools.tap import TappedDatagram, TappedMessage

_DESCRIPTION = """\
Print what a running router receives, before it routes it, one line for each datagram: the fields that are not default.
The router is asked where the table's 'http.address' says, on this computer; it does not wait for this terminal, and
says how many datagrams were too many for it. With a port, or the name of an endpoint or listener, it is that UDP port
instead, which must be free: no router then has part in it.
"""

_EPILOG = """\
examples:
  router tap imu_info gps_info --table routes/sim.yaml
  router tap --from arm_board
  router tap imu_info --where 'accel_z < 0 or not is_calibrated'
  router tap 9000
  router tap --topic imu_data
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "tap",
        help=VERBS["tap"],
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="CASE",
        help="of a running router only these payload cases (default: all); or one [HOST:]PORT, endpoint or listener",
    )
    parser.add_argument(
        "--from",
        dest="sources",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="only from this endpoint or IP address; several are possible",
    )
    parser.add_argument(
        "--where", metavar="EXPR", help="only what this expression of the table's language holds for: 'satellites < 4'"
    )
    add_url_option(parser)
    parser.add_argument("--topic", metavar="NAME", help="a ROS topic instead")
    parser.add_argument("--type", metavar="TYPE", help="of the topic (default: what its publishers say)")
    parser.add_argument("--count", type=whole, metavar="N", help="end after N messages (default: at Ctrl-C)")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument("--hex", action="store_true", help="with the bytes of each")
    add_wire_options(parser)


def run(args: argparse.Namespace) -> int:
    if args.type and not args.topic:
        raise UsageError("--type belongs to --topic")
    if args.topic and args.words:
        raise UsageError(f"either --topic {args.topic} or '{args.words[0]}'")
    try:
        if args.topic:
            with _topic(args) as messages:
                _print(([message] for message in messages), args)
        else:
            _tap_datagrams(args)
    except KeyboardInterrupt:
        return 0
    return 0


def _tap_datagrams(args: argparse.Namespace) -> None:
    wire, table = load_wire(args)
    if not args.words or all(word in wire.envelope.cases for word in args.words) or len(args.words) > 1:
        _running(args, wire, table)
        return
    word, names = args.words[0], (*table.endpoints, *table.listeners) if table else ()
    if nearest(word, (*wire.envelope.cases, *names)) in set(wire.envelope.cases).difference(names):
        wire.case(word)  # which says which one was meant
    if args.sources or args.where or args.url:
        raise UsageError("--from, --where and --url belong to a running router")
    with _port(args, wire, table) as datagrams:
        _print(([datagram] for datagram in datagrams), args)


def _print(batches: Iterable[Sequence[TappedDatagram | TappedMessage]], args: argparse.Namespace) -> None:
    """A batch is written at once: a system call for each line would cost more than the line."""
    left = args.count
    for batch in batches:
        shown = batch[:left]
        if shown:
            lines = (each.json(args.hex) if args.json else each.line(args.hex) for each in shown)
            print("\n".join(lines), flush=True)
        if left is not None and (left := left - len(shown)) == 0:
            return


def _running(args: argparse.Namespace, wire: Wire, table: RouteTable | None) -> None:
    from router.threads import background_threads
    from router.tools.running_router import tap
    from router.tools.tap import Condition, RunningTap
    from router.tools.udp import peer_names

    cases = [wire.case(word) for word in args.words]
    condition = Condition(args.where, cases or list(wire.envelope.cases.values())) if args.where else None
    if args.url is None and table is None:
        raise UsageError("--table or --url says which running router")
    url = running_url(args)
    taken = RunningTap(wire, peer_names(table), args.words, condition)
    wanted = args.words or (sorted(condition.cases) if condition else [])
    # The router goes before whatever runs on its computer to watch it.
    with background_threads(), tap(url, wanted, args.sources) as batches:
        say(f"tapping the router at {url}; Ctrl-C ends it")
        try:
            _print(taken.take(batches), args)
        finally:
            if taken.missed:
                say(f"{taken.missed} datagrams were too many for this terminal; the router routed them all the same")
            if condition is not None and condition.failure:
                say(f"where --where fails nothing is shown: {condition.failure}")


@contextmanager
def _port(args: argparse.Namespace, wire: Wire, table: RouteTable | None) -> Iterator[Iterator[TappedDatagram]]:
    from router.tools import udp
    from router.tools.tap import listen

    place = args.words[0]
    with udp.open_udp(udp.listening(place, table), place) as receiver:
        host, port = receiver.getsockname()
        say(f"listening on {host}:{port}; Ctrl-C ends it")
        yield listen(receiver, wire, udp.peer_names(table))


@contextmanager
def _topic(args: argparse.Namespace) -> Iterator[Iterator[TappedMessage]]:
    try:
        check_environment(os.environ)
        from router.ros.topics import TopicListener
    except StartError as error:
        raise UsageError(str(error)) from error
    except ImportError as error:
        raise UsageError(f"a topic needs ROS 2, which is not installed here ({error}); {ros_remedy()}") from error
    from router.tools.tap import listen_to_topic

    if args.type is None:
        say(f"waiting for a publisher of {args.topic}; Ctrl-C ends it")
    try:
        listener = TopicListener(args.topic, args.type)
    except StartError as error:
        raise UsageError(str(error)) from error
    with closing(listener):
        say(f"listening to {args.topic} of {listener.type_name}; Ctrl-C ends it")
        yield listen_to_topic(listener)
