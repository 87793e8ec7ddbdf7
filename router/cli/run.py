"""`router run [TABLE] [--ros-args ...]`: compile the table, open everything, route until a signal.

The ROS parameter `routes_path` may name the table instead of TABLE.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import yaml

from router.app import Router, tune_interpreter
from router.app.process import supervised
from router.cli import BAD_TABLE, BAD_USAGE, DEFAULT_TABLE, OK, VERBS
from router.cli.findings import is_coloured, print_findings
from router.compiler import check_table
from router.errors import StartError, UsageError
from router.log import LEVELS as LOG_LEVELS
from router.log import configure_log

_DESCRIPTION = f"""Route as a table says, until SIGINT or SIGTERM. SIGHUP: read the table again (see 'router reload').
SIGUSR1: save the last datagrams, where the table keeps them ('record').
Exit code: {OK} stopped, {BAD_USAGE} wrong usage, {BAD_TABLE} the table has errors or what it names cannot be opened."""

_EPILOG = """\
The ROS parameter routes_path chooses the table in place of TABLE. Any other is a variable of the table in lower case,
and wins over the environment:
  router run --ros-args -p routes_path:=routes/legacy.yaml -p listen_port:=5001 -p dst_ip:=127.0.0.1
"""

_ROUTES_PATH = "routes_path"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "run",
        help=VERBS["run"],
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("table", type=Path, nargs="?", metavar="TABLE", help=f"route table (default: {DEFAULT_TABLE})")
    parser.add_argument(
        "--log-level", choices=LOG_LEVELS, default="info", help="least that is logged (default: %(default)s)"
    )
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], metavar="ARG", help="everything from here on is for ROS"
    )


def run(args: argparse.Namespace) -> int:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP, signal.SIGUSR1})  # for callers other than `router.main`
    configure_log(args.log_level, coloured=is_coloured(sys.stderr))
    parameters = ros_parameters(args.ros_args)
    named = parameters.get(_ROUTES_PATH)  # relative to the working directory, as TABLE
    if args.table and named and args.table.resolve() != Path(named).resolve():
        raise UsageError(f"TABLE is {args.table}, {_ROUTES_PATH} is {named}; name one table")
    table = args.table or Path(named or DEFAULT_TABLE)
    environ = {**os.environ, **table_variables(parameters)}
    checked = check_table(table, environ)
    print_findings(checked.diagnostics, sys.stderr)
    if checked.program is None:
        return BAD_TABLE
    ending = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    with Router(checked.program, ["--ros-args", *args.ros_args], environ) as router:
        tune_interpreter()
        del checked  # so that a reload can free it
        with supervised(router.progress, router.feed_watchdog):
            _serve_signals(router, ending)
        for number in ending:
            signal.signal(number, signal.SIG_DFL)  # a second signal ends the process at once
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ending)
    return OK


def _serve_signals(router: Router, ending: Collection[signal.Signals]) -> None:
    """Handle signals one after the other until one of `ending` comes."""
    while True:
        last = signal.sigpending() & set(ending)  # sigwait alone would prefer SIGHUP, however often it comes
        match signal.sigwait(last or {*ending, signal.SIGHUP, signal.SIGUSR1}):
            case signal.SIGHUP:
                router.reload()
            case signal.SIGUSR1:
                router.save_recording("signal")
            case _:
                return


def ros_parameters(ros_args: Sequence[str]) -> dict[str, str]:
    """Parse `["-p", "listen_port:=5001"]` to `{"listen_port": "5001"}`, also `--params-file`, which `ros2 launch` uses.

    The last value wins, as in ROS. Node names of parameters are ignored. Raises StartError.
    """
    parameters: dict[str, str] = {}
    for option, word in pairwise(ros_args):
        name, assigned, value = word.partition(":=")
        if option in ("-p", "--param") and assigned:
            parameters[name.rpartition(":")[2]] = value.strip("'\"")
        elif option == "--params-file":
            parameters.update((name, str(value)) for name, value in _parameters(_read_yaml(Path(word))))
    return parameters


def table_variables(parameters: Mapping[str, str]) -> dict[str, str]:
    """The table's variables that ROS parameters set: `listen_port` is `${LISTEN_PORT}`."""
    return {name.upper(): value for name, value in parameters.items() if name != _ROUTES_PATH}


def _read_yaml(path: Path) -> object:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise StartError(f"the parameter file {path} cannot be read: {error}") from error


def _parameters(tree: object) -> Iterator[tuple[str, object]]:
    """Yield the parameters of all nodes, in any depth of namespaces."""
    for key, value in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters" and isinstance(value, dict):
            yield from ((str(name), member) for name, member in value.items())
        else:
            yield from _parameters(value)
