"""`router send CASE field=value ... --to PLACE`: build any payload and send it, once or at a rate."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from typing import TYPE_CHECKING

from router.cli import Subparsers, add_verb, with_help
from router.cli.completion import cases, completes, endpoints, fields, places
from router.cli.tool_options import add_count, add_wire_options, hertz, load_wire, say, until_interrupted, whole
from router.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from router.datagrams import Wire
    from router.table.addresses import Address
    from router.table.model import RouteTable
    from router.table.model.endpoints import Endpoint, Listener
    from router.tools.link_end import LinkEnd
    from router.tools.udp import Sent
    from router.types.table_envelopes import Envelopes

_EXAMPLES = (
    "router send imu_info accel_x=1.5 state=SENSOR_OPERATING --to 127.0.0.1:5000",
    "router send imu_info -t routes/sim.yaml --to rover --from sensor_board",
    "router send imu_info --to '[fd00::1]:5000'",
    "router send detected_object bbox.x=0x10 type=OBJECT_ROCK --to basestation",
    "router send detection frame=5 geometry length=9 -t vision.yaml --to vision",
    "router send manual_drive --to rover --rate 20Hz --count 1000",
)


def add_parser(subparsers: Subparsers) -> None:
    description = """Build a payload from field=value words and send it in an envelope. To the listener of a serial line
or TCP connection, send it as the board, once the router is there: at a pty, or over TCP. To the board, send it as the
router: at the line's device, or over TCP."""
    parser = add_verb(subparsers, "send", description, *_EXAMPLES)
    completes(parser.add_argument("case", metavar="CASE", help="payload case, such as imu_info"), cases)
    completes(
        parser.add_argument(
            "fields",
            nargs="*",
            metavar="FIELD=VALUE",
            help="x=1, bbox.x=3, points[1]=2, counts[left]=4, state=NAME; envelope.seq=5 is beside the payload; a word "
            "without = is one more payload case of the same datagram",
        ),
        fields,
    )
    completes(
        parser.add_argument("--to", required=True, metavar="PLACE", help="HOST:PORT, or a name in the table"), places
    )
    completes(
        parser.add_argument("--from", dest="origin", metavar="PLACE", help="HOST[:PORT], or an endpoint in the table"),
        endpoints,
    )
    parser.add_argument("--rate", type=hertz, metavar="RATE", help="for example 20Hz (default: as fast as possible)")
    add_count(parser, "how many (default: 1, with --rate until Ctrl-C)")
    parser.add_argument("--trim", action="store_true", help="remove trailing zero bytes, as the old boards do")
    parser.add_argument("--pad", type=whole, default=0, metavar="N", help="pad with zeros to N bytes, as old boards do")
    add_wire_options(parser)


def run(args: argparse.Namespace) -> int:
    from router.datagrams import framed
    from router.tools import links, udp
    from router.tools.udp import Sent, send

    wire, table = load_wire(args, args.to)
    exact = envelope_of(wire, [args.case, *args.fields])
    data = framed(exact, args.trim, args.pad)
    count = args.count if args.count is not None else None if args.rate else 1
    if table is not None:
        _require_case(wire.envelopes, table, args)
    if table is not None and (link := links.link_of(args.to, table)) is not None:
        return _send_frames(args, link, table, data, count)
    to = udp.destination(args.to, table)
    origin = udp.origin_of(to, udp.origin(args.origin, table) if args.origin else udp.ANYWHERE)
    sent = Sent()
    # Without --count, Ctrl-C stops sending; the summary is printed all the same.
    with udp.open_udp(origin, "--from") as sender, until_interrupted():
        if (endpoint := udp.endpoint_of(args.to, table)) is not None:
            udp.aim(sender, endpoint)
        send(sender, to, data, count, args.rate, sent)
    print(_summary(_cases(args), data, str(to), sent))
    return _advise(args, table, to, sent)


def _require_case(envelopes: Envelopes, table: RouteTable, args: argparse.Namespace) -> None:
    """Raise UsageError if a listener or an endpoint has another envelope than the payload case."""
    is_named = args.to in table.endpoints or args.to in table.listeners
    around = envelopes.to(args.to) if args.to in table.endpoints else envelopes.at(args.to)
    if is_named and args.case not in around.cases:
        held = around.holding(envelopes.cases[args.case])
        hint = f"write {held[0].name}" if held else did_you_mean(args.case, around.cases)
        raise UsageError(f"'{args.to}' takes {around.name}, which has no payload case '{args.case}'", hint)


def _send_frames(args: argparse.Namespace, link: Listener, table: RouteTable, data: bytes, count: int | None) -> int:
    """Send to the router as the board at the other end of a link, or to the board as the router."""
    from router.tools import links
    from router.tools.udp import Sent

    sent = Sent()
    with closing(_end(args, link, links.boards_at(link, table))) as end, until_interrupted():
        if end.awaited:
            say(f"waiting for {end.awaited}; press Ctrl-C to stop")
        links.send(end, data, count, args.rate, sent)
    print(_summary(_cases(args), data, args.to, sent))
    return 0


def _end(args: argparse.Namespace, link: Listener, boards: Sequence[Endpoint]) -> LinkEnd:
    """Open the end of a link that sends to --to. Raises UsageError."""
    from router.tools import links

    named = {board.name: board for board in boards}
    senders = {} if args.to in named else named
    if args.origin and args.origin not in senders:
        raise UsageError(f"what is sent to '{args.to}' is not from {args.origin}", "leave out --from")
    if args.to in named:
        return links.router_ends(link, [named[args.to]])[0]
    if len(boards) > 1 and not args.origin:
        raise UsageError(f"several boards connect to '{args.to}'", f"add --from {boards[0].name}")
    return links.board_end(link, senders[args.origin or boards[0].name])


def _cases(args: argparse.Namespace) -> str:
    return " and ".join([args.case, *(word for word in args.fields if "=" not in word)])


def envelope_of(wire: Wire, words: Sequence[str]) -> bytes:
    """Return the envelope that the words describe: payload cases, each followed by its fields.

    `envelope.x=1` is beside the payload, unless that has the field. Raises UsageError.
    """
    from router.compiler.expressions.tree import ENVELOPE
    from router.values.reading import assigned, payload

    prefix = f"{ENVELOPE}."
    inside: dict[str, list[str]] = {}
    around: list[str] = []
    for word in words:
        if not inside or "=" not in word:
            if word in inside:
                raise UsageError(f"the payload case '{word}' is named twice")
            if inside and word not in wire.envelopes.cases:
                raise UsageError(f"'{word}' is neither a field with a value nor a payload case", f"write {word}=value")
            case, inside[word] = wire.case(word), []
        elif word.startswith(prefix) and case.type.field(ENVELOPE) is None:
            around.append(word.removeprefix(prefix))
        else:
            inside[case.name].append(word)
    envelope = wire.envelopes.of(next(iter(inside)))
    payloads = [(wire.case(name), payload(wire.case(name), fields)) for name, fields in inside.items()]
    return wire.encode_all(payloads, assigned(envelope.message_class(), envelope.beside, around))


def _summary(case: str, data: bytes, to: str, sent: Sent) -> str:
    if sent.count == 1:
        return f"sent {case} to {to}: {len(data)} bytes {data.hex()}"
    rate = f" in {sent.seconds:.2f} s ({sent.rate:.1f}/s)" if sent.rate else ""
    return f"sent {case} to {to} {sent.count} times{rate}: {len(data)} bytes each"


def _advise(args: argparse.Namespace, table: RouteTable | None, to: Address, sent: Sent) -> int:
    """Print on stderr why the payload may have had no effect. Return 1 if the port was closed, else 0."""
    from router.net.udp import nobody_listens

    if sent.refused:
        print(f"router send: {nobody_listens(to)}", file=sys.stderr)
        return 1
    if table is None or args.origin or args.to not in table.listeners:
        return 0
    sources = [name.value for route in table.routes if route.case.value == args.case for name in route.sources]
    if named := [name for name in sources if name in table.endpoints]:
        what = f"router send: the table accepts {args.case} only from {' or '.join(named)}"
        print(with_help(what, f"add --from {named[0]} unless this machine has its address"), file=sys.stderr)
    return 0
