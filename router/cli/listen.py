"""`router listen PLACE`: print what a gateway sends, what arrives at a UDP port, or what a ROS topic carries.

It does not use a running router. For gateways it is the reference client of their formats.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import Subparsers, add_verb
from router.cli.completion import completes, listened, topics
from router.cli.tool_options import (
    add_count,
    add_for,
    add_wire_options,
    load_wire,
    print_batches,
    say,
    until_interrupted,
)
from router.errors import StartError, TransportError, UsageError

if TYPE_CHECKING:
    from router.datagrams import Wire
    from router.table.model import RouteTable
    from router.table.model.endpoints import Listener
    from router.tools.gateway_client import Received

FORMATS = ("gateway_v1", "json_lines")
GATEWAYS = ("udp", "tcp", "ws", "zenoh")
_BELONGS_TO = {
    "topics": ("--topic", GATEWAYS),
    "record": ("--record", GATEWAYS),
    "format": ("--format", ("tcp",)),
    "ask": ("--ask", ("udp",)),
    "hex": ("--hex", ("envelope", "topic")),
    "type": ("--type", ("topic",)),
}
"""Options that only some places have."""

_DESCRIPTION = """Listen at a place and print one line per message, until Ctrl-C. From a gateway, print each message and
schema, also of compressed and batched packets, and the counts at the end. At a UDP port, print the payloads of
envelopes; the port must be free, so a router on this computer cannot be listening at it."""
_PLACES = """places:
  udp://[HOST:]PORT     what a gateway sends to this address of this computer
  tcp://HOST:PORT       a gateway's TCP server; reconnects
  ws://HOST:PORT        a gateway's websocket server; reconnects
  zenoh://KEY           a gateway's key; ?connect=tcp/10.0.0.1:7447, also
                        listen=LOCATOR and mode=peer|client|router; or
                        ?config=FILE of Zenoh, for example for TLS
  envelope://[HOST:]PORT    envelopes, as boards and basestation get them
  envelope://NAME       the same at the address of an endpoint or listener; for
                        the board of a serial line, at a pty in its place;
                        over TCP, it connects or accepts as the named one does
  topic://NAME          a ROS topic"""
_EXAMPLES = (
    "router listen udp://8502 --ask 127.0.0.1:8500",
    "router listen ws://127.0.0.1:28765 --topic '/imu/*' --for 10s",
    "router listen envelope://9000 --count 100 --json",
    "router listen envelope://basestation -t routes/sim.yaml",
    "router listen topic://imu_data",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "listen", _DESCRIPTION, *_EXAMPLES, more=_PLACES)
    completes(
        parser.add_argument("place", metavar="PLACE", help="udp://, tcp://, ws://, zenoh://, envelope:// or topic://"),
        listened,
    )
    add_count(parser)
    add_for(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object per line, with the data as received")
    parser.add_argument("--hex", action="store_true", help="envelopes and ROS: also print the bytes")
    parser.add_argument("--type", metavar="TYPE", help="ROS: the topic's type (default: that of its publishers)")
    about = "gateways: only matching topics, for example /loki_1/**; may be repeated"
    completes(parser.add_argument("--topic", dest="topics", action="append", metavar="GLOB", help=about), topics)
    parser.add_argument("--record", type=Path, metavar="FILE", help="gateways: also append JSON lines to this file")
    parser.add_argument("--format", choices=FORMATS, help="tcp: framing (default: detected from the first bytes)")
    parser.add_argument("--ask", metavar="HOST:PORT", help="udp: request schemas from this gateway's 'receive' address")
    add_wire_options(parser)


def run(args: argparse.Namespace) -> int:
    scheme, separator, rest = args.place.partition("://")
    if not separator:
        forms = f"topic://{scheme.removeprefix('/')} (a topic)"
        if scheme.rpartition(":")[2].isdecimal():
            forms = f"envelope://{scheme} (envelopes), or udp://, tcp:// or ws://{scheme} (a gateway)"
        elif not scheme.startswith("/"):
            forms += f" or envelope://{scheme} (what an endpoint receives)"
        raise UsageError(f"'{scheme}' has no scheme", f"write {forms}")
    for name, (option, schemes) in _BELONGS_TO.items():
        if getattr(args, name) and scheme not in schemes:
            raise UsageError(f"{option} works only with {', '.join(f'{scheme}://' for scheme in schemes)}")
    if scheme == "envelope":
        _listen_to_port(rest, args)
    elif scheme == "topic":
        _listen_to_topic(rest, args)
    elif scheme in GATEWAYS:
        _listen_to_gateway(args)
    else:
        places = ", ".join(f"{scheme}://" for scheme in (*GATEWAYS, "envelope", "topic"))
        raise UsageError(f"there is no scheme '{scheme}://'", f"the schemes are {places}")
    return 0


def _listen_to_gateway(args: argparse.Namespace) -> None:
    from router.table.model.gateways import GatewayFormat
    from router.tools.gateway_client import GatewayClient, Message, topic_filter
    from router.tools.gateway_sources import open_source
    from router.tools.udp import destination

    client = GatewayClient(topic_filter(args.topics or ()))
    form = GatewayFormat(args.format) if args.format else None
    gateway = destination(args.ask, None) if args.ask else None
    show = _printer(args.json)
    with _recorder(args.record) as record, closing(open_source(args.place, form, gateway, say)) as source:
        say(f"listening: {source.place}; press Ctrl-C to stop")
        rest = args.count
        try:
            with until_interrupted():
                for received in client.receive(source, args.seconds or math.inf):
                    record(received)
                    show(received)
                    if rest and isinstance(received, Message):
                        rest -= 1
                        if not rest:
                            break
        finally:
            say(str(client.tally(source)))


def _listen_to_port(place: str, args: argparse.Namespace) -> None:
    from router.tools import links, udp
    from router.tools.tap import listen

    wire, table = load_wire(args, place)
    if table is not None and (link := links.link_of(place, table)) is not None:
        _listen_to_link(link, table, wire, args, place)
        return
    address = udp.listening(place, table)
    envelope = wire.envelopes.first if table is None else udp.received_at(address, table, wire.envelopes)
    with udp.open_udp(address, place, udp.endpoint_of(place, table)) as receiver:
        say(f"listening on {udp.address_of(receiver)}; press Ctrl-C to stop")
        with until_interrupted():
            print_batches(listen(receiver, wire, envelope, udp.peer_names(table)), args)


def _listen_to_link(link: Listener, table: RouteTable, wire: Wire, args: argparse.Namespace, place: str) -> None:
    from router.tools import links

    boards = links.boards_at(link, table)
    is_board = place != link.name
    with ExitStack() as opened:
        ends = [links.board_end(link, table.endpoints[place])] if is_board else links.router_ends(link, boards)
        for end in ends:
            opened.enter_context(closing(end))
        say(f"listening {ends[0].where}; press Ctrl-C to stop")
        peers = [link.name] if is_board else [board.name for board in boards]
        with until_interrupted():
            print_batches(links.listen([*zip(ends, peers, strict=True)], wire, wire.envelopes.at(link.name)), args)


def _listen_to_topic(topic: str, args: argparse.Namespace) -> None:
    if not topic:
        raise UsageError("topic:// lacks a name", "write topic://imu_data")
    from router.ros.environment import check_environment, ros_remedy

    try:
        check_environment(os.environ)
        from router.ros.topics import TopicListener
    except StartError as error:
        raise UsageError(*error.args) from error
    except ImportError as error:
        raise UsageError(f"a topic needs ROS 2, which is not installed here ({error})", ros_remedy()) from error
    from router.tools.tap import listen_to_topic

    begun = time.monotonic()
    with until_interrupted():
        if args.type is None:
            say(f"waiting for a publisher of {topic}; press Ctrl-C to stop")
        try:
            listener = TopicListener(topic, args.type, patience=args.seconds or math.inf)
        except StartError as error:
            raise UsageError(*error.args) from error
        with closing(listener):
            say(f"listening to {topic} of {listener.type_name}; press Ctrl-C to stop")
            print_batches(listen_to_topic(listener), args, time.monotonic() - begun)


@contextmanager
def _recorder(path: Path | None) -> Iterator[Callable[[Received], None]]:
    """Yield a function that appends a line to the file, unbuffered. Raises UsageError."""
    from router.tools.gateway_client import json_line

    if path is None:
        yield lambda _: None
        return
    if path == Path("-"):
        raise UsageError("--record needs a file", "use --json to print the same lines")
    try:
        file = path.open("ab", buffering=0)
    except OSError as error:
        raise UsageError(f"--record {path}: {error.strerror}") from error

    def record(received: Received) -> None:
        try:
            file.write(f"{json_line(received)}\n".encode())
        except OSError as error:
            raise TransportError(f"--record {path}: {error.strerror}") from error

    with file:
        yield record


def _printer(as_json: bool) -> Callable[[Received], None]:
    """Return a function that prints one line: on a terminal, in colour and cut to its width."""
    from router.tools.gateway_client import json_line, pieces

    if as_json:
        return lambda received: print(json_line(received), flush=True)
    if not sys.stdout.isatty():
        return lambda received: print(" ".join(text for text, _ in pieces(received)), flush=True)
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)

    def show(received: Received) -> None:
        line = Text(" ").join(Text(text, style) for text, style in pieces(received))
        console.print(line, no_wrap=True, overflow="ellipsis", crop=True)

    return show
