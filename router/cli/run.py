"""`router run [TABLE] [--ros-args ...]`: compile the table, open everything, route until a signal arrives.

The ROS parameter `routes_path` can also name the table.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from router import NO_CACHE, inputs
from router.cli import BAD_TABLE, BAD_USAGE, NOT_NOW, OK, Subparsers, add_verb
from router.cli.findings import is_coloured
from router.cli.tool_options import add_table, good_table, table_path
from router.errors import UsageError
from router.log import LEVELS as LOG_LEVELS
from router.log import configure_log, logger

if TYPE_CHECKING:
    from router.app import Router
    from router.app.image_saver import ImageSaver
    from router.compiler.compiled_table import CompiledTable
    from router.startup_image.head_start import HeadStartAttempt
    from router.table.addresses import Address
    from router.table.model.gateways import Gateway

_DESCRIPTION = f"""Run a route table until SIGINT or SIGTERM. SIGHUP reloads the table (see 'router reload'). SIGUSR1
saves the last datagrams, if the table keeps them ('record').

Exit code: {OK} stopped, {BAD_USAGE} wrong usage, {BAD_TABLE} the table or the environment must be corrected,
{NOT_NOW} something cannot be opened now, for example a port that another process has; a later start may succeed."""
_PARAMETERS = """The ROS parameter routes_path also chooses the table. Any other parameter sets the table's variable of
that name in upper case, and overrides the environment."""
_ENDING = frozenset({signal.SIGINT, signal.SIGTERM})
_EXAMPLES = (
    "router run",
    "router run routes/sim.yaml",
    "router run --ros-args -p routes_path:=routes/legacy.yaml -p listen_port:=5001",
)


def add_parser(subparsers: Subparsers) -> None:
    parser = add_verb(subparsers, "run", _DESCRIPTION, *_EXAMPLES, more=_PARAMETERS)
    add_table(parser, is_subject=True)
    parser.add_argument(
        "--log-level", choices=LOG_LEVELS, default="info", help="lowest level that is logged (default: %(default)s)"
    )
    parser.add_argument(
        NO_CACHE,
        action="store_true",
        help="compile the table before routing starts; keep no program for the next start",
    )
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], metavar="ARG", help="all further arguments are for ROS"
    )


def run(args: argparse.Namespace) -> int:
    from router.app.image_saver import ImageSaver
    from router.compiler.check import uncollected
    from router.compiler.metrics import Counters
    from router.ros.arguments import ROUTES_PATH, Variables, ros_parameters, table_variables, without_effect
    from router.startup_image.head_start import ATTEMPTS

    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGUSR1})  # for callers other than `router.main`
    configure_log(args.log_level, coloured=is_coloured(sys.stderr))
    attempt = ATTEMPTS[0] if ATTEMPTS else None
    head_start = attempt.head_start if attempt is not None else None
    if attempt is not None:
        _log(attempt)
    with uncollected():  # until the router has started
        with inputs.noted() as selection:
            parameters = ros_parameters(args.ros_args)
            environ = Variables(table_variables(parameters), inputs.ENVIRONMENT)
            table = _table(args, ROUTES_PATH, parameters.get(ROUTES_PATH))
        counters = Counters.of(head_start.image.image.series, head_start.image.image.counters) if head_start else None
        with inputs.recording(selection) as read:
            program = good_table(table, environ, counters=counters)[1]  # only this, so that a reload can free the rest
        _warn_of(without_effect(args.ros_args, program, environ.names_read))
        saver = None
        if attempt is not None:
            saver = ImageSaver(selection, read, head_start.inputs if head_start is not None else None)
        if not signal.sigpending() & _ENDING:  # held back since the head start began
            route(program, args.ros_args, environ, attempt, saver)
    return OK


def _log(attempt: HeadStartAttempt) -> None:
    """Log the head start, or why a kept program is not used."""
    from router.startup_image.store import CHANGED

    if attempt.head_start is not None:
        listening = [*attempt.head_start.listening]
        logger.info("forwarding with the kept program while the table is compiled", listening=listening)
    elif attempt.why:
        log = logger.info if attempt.why.endswith(CHANGED) else logger.warning
        log("the kept program is not used: the table is compiled first", why=attempt.why)


def _table(args: argparse.Namespace, name: str, parameter: str | None) -> Path:
    """Return the path of the table. `parameter`, the ROS parameter `name`, may name it. Raises UsageError.

    The parameter is relative to the working directory, like TABLE.
    """
    if not parameter:
        return table_path(args)
    typed: Path | None = args.subject or args.table
    if typed is not None and inputs.real_path(table_path(args)) != inputs.real_path(parameter):
        raise UsageError(f"TABLE is {typed}, {name} is {parameter}", "name one table")
    return typed or Path(parameter)


def route(
    program: CompiledTable,
    ros_args: Sequence[str],
    environ: Mapping[str, str],
    attempt: HeadStartAttempt | None = None,
    saver: ImageSaver | None = None,
    started: Callable[[], None] = lambda: None,
) -> None:
    """Run a program until SIGINT or SIGTERM, after the head start of `attempt`. Calls `started` once it runs.

    Raises StartError.
    """
    from router.app import Router, tune_interpreter
    from router.app.process import supervised
    from router.tools.udp import reachable  # before the router runs: then, there may be no free descriptor

    signal.pthread_sigmask(signal.SIG_BLOCK, {*_ENDING, signal.SIGHUP, signal.SIGUSR1})
    head_start = attempt.head_start if attempt is not None else None
    is_refused = attempt is not None and bool(attempt.why)
    router = Router(program, ["--ros-args", *ros_args], environ, head_start, saver, is_refused=is_refused)
    if attempt is not None:
        attempt.pass_on()
    with router:
        tune_interpreter()
        _show_places(router, reachable)
        started()
        with supervised(router.feed_watchdog):
            _serve_signals(router, _ENDING)
        for number in _ENDING:
            signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)


def _show_places(router: Router, reachable: Callable[[Address], Address]) -> None:
    """Log the addresses of pages and gateways: on a terminal one per line, elsewhere as one record."""
    places = dict(_places(router, reachable))
    if places and not sys.stderr.isatty():
        logger.info("where to look", **places)
    elif places:
        width = max(map(len, places))
        logger.info("\n".join(["where to look:", *(f"  {name:{width}}  {place}" for name, place in places.items())]))


def _places(router: Router, reachable: Callable[[Address], Address]) -> Iterator[tuple[str, str]]:
    table = router.program.table
    if router.metrics_address is not None:
        yield "status page", f"http://{reachable(router.metrics_address)}/"
    for name, gateway in table.gateways.items():
        yield f"gateway {name}", _place(gateway, reachable)
    if table.foxglove is not None:
        yield "Foxglove", f"ws://{reachable(table.foxglove.address.value)}"


def _place(gateway: Gateway, reachable: Callable[[Address], Address]) -> str:
    from router.table.model.gateways import Transport

    if gateway.zenoh is not None:
        return f"zenoh://{gateway.zenoh.key.value}"
    assert gateway.address is not None  # noqa: S101 - only Zenoh has none
    scheme = {Transport.WEBSOCKET: "http", Transport.TCP: "tcp"}.get(gateway.transport.value, "udp")
    return f"{scheme}://{reachable(gateway.address.value)}{'/' if scheme == 'http' else ''}"


def _serve_signals(router: Router, ending: Collection[signal.Signals]) -> None:
    """Handle signals one after the other until one of `ending` arrives, which no reload delays."""
    from router.threads import DaemonThread

    reloads = DaemonThread("reload")  # a reload may be stuck, if files are on another computer
    while True:
        last = signal.sigpending() & set(ending)  # sigwait alone would return SIGHUP first each time
        match signal.sigwait(last or {*ending, signal.SIGHUP, signal.SIGUSR1}):
            case signal.SIGHUP if reloads.has_waiting():
                pass  # the one that waits will read the files
            case signal.SIGHUP:
                try:
                    reloads.submit(router.reload)
                except (RuntimeError, MemoryError):  # no thread can be started
                    router.reload()
            case signal.SIGUSR1:
                router.save_recording("signal")
            case _:
                return


def _warn_of(unread: Iterable[tuple[str, str]]) -> None:
    for argument, remedy in unread:
        logger.warning("a ROS argument has no effect", argument=argument, remedy=remedy)
