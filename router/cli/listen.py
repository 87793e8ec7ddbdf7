"""`router listen HOST:PORT`: what a gateway sends, one line each. The reference client of the gateway's formats."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from router.cli import VERBS
from router.cli.tool_options import say, whole
from router.errors import TransportError, UsageError

if TYPE_CHECKING:
    from router.tools.gateway_messages import Heard

FORMATS = ("gateway_v1", "json_lines")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "listen",
        help=VERBS["listen"],
        description="Print each message and schema that a gateway sends as one line. Compressed and batched "
        "packets are understood. How many there were is said at the end.",
        epilog="Places: [udp://][HOST:]PORT receives on this address of this machine; tcp://HOST:PORT and "
        "ws://HOST:PORT connect to a gateway, again and again; zenoh://KEY?connect=tcp/10.0.0.1:7447 has the key "
        "of a gateway, and further listen=LOCATOR and mode=peer|client|router.",
    )
    parser.add_argument("place", metavar="PLACE", help="[HOST:]PORT, or tcp://, ws:// or zenoh:// (see below)")
    parser.add_argument("--format", choices=FORMATS, help="of tcp:// (default: what the first bytes say)")
    parser.add_argument("--ask", metavar="HOST:PORT", help="udp: ask this `receive` address of a gateway for schemas")
    parser.add_argument(
        "--topic", action="append", metavar="GLOB", help="only such topics, as /loki_1/**; several are possible"
    )
    parser.add_argument("--count", type=whole, metavar="N", help="end after N messages (default: at Ctrl-C)")
    parser.add_argument("--for", dest="seconds", type=_seconds, metavar="DURATION", help="end after this time: 10s")
    parser.add_argument("--json", action="store_true", help="one JSON object per line, data as it is received")
    parser.add_argument("--record", type=Path, metavar="FILE", help="append the same JSON lines to this file")


def _seconds(text: str) -> float:
    from router.table.units import parse_duration

    try:
        return parse_duration(text) / 1e9
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def run(args: argparse.Namespace) -> int:
    from router.table.model import GatewayFormat
    from router.tools.gateway_client import GatewayClient, topic_filter
    from router.tools.gateway_messages import Message
    from router.tools.gateway_sources import open_source, remote

    client = GatewayClient(topic_filter(args.topic or ()))
    form = GatewayFormat(args.format) if args.format else None
    gateway = remote(args.ask) if args.ask else None
    show = _printer(args.json)
    with _recorder(args.record) as record, closing(open_source(args.place, form, gateway, say)) as source:
        say(f"listening: {source.place}; Ctrl-C ends it")
        rest = args.count
        try:
            for heard in client.hear(source, args.seconds or math.inf):
                record(heard)
                show(heard)
                if rest and isinstance(heard, Message):
                    rest -= 1
                    if not rest:
                        break
        except KeyboardInterrupt:
            pass
        finally:
            say(str(client.tally(source)))
    return 0


@contextmanager
def _recorder(path: Path | None) -> Iterator[Callable[[Heard], None]]:
    """A function that appends a line to the file, unbuffered."""
    from router.tools.gateway_messages import json_line

    if path is None:
        yield lambda _: None
        return
    if path == Path("-"):
        raise UsageError("--record takes a file; --json prints the same")
    try:
        file = path.open("ab", buffering=0)
    except OSError as error:
        raise UsageError(f"--record {path}: {error.strerror}") from error

    def record(heard: Heard) -> None:
        try:
            file.write(f"{json_line(heard)}\n".encode())
        except OSError as error:
            raise TransportError(f"--record {path}: {error.strerror}") from error

    with file:
        yield record


def _printer(as_json: bool) -> Callable[[Heard], None]:
    """A function that prints; on a terminal with colours and lines cut to its width."""
    from router.tools.gateway_messages import json_line, pieces

    if as_json:
        return lambda heard: print(json_line(heard), flush=True)
    if not sys.stdout.isatty():
        return lambda heard: print(" ".join(text for text, _ in pieces(heard)), flush=True)
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)

    def show(heard: Heard) -> None:
        line = Text(" ").join(Text(text, style) for text, style in pieces(heard))
        console.print(line, no_wrap=True, overflow="ellipsis", crop=True)

    return show
