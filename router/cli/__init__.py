"""The command line: which verbs there are. A verb's module is imported once the verb is chosen.

A verb's module offers `add_parser(subparsers)` and `run(args) -> int`.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from router.errors import RouterError, TableError, TransportError, UsageError
from router.ros.environment import ADDRESS_SPACE, address_space

OK = 0
NETWORK_FAULT = 1
BAD_USAGE = 2
BAD_TABLE = 78
"""EX_CONFIG: systemd is told not to restart into it."""
INTERRUPTED = 130
BROKEN_PIPE = 141

DEFAULT_TABLE = Path("routes/rover.yaml")

VERBS = {
    "init": "copy the example tables, their protos and their ROS messages into a folder",
    "run": "run a route table between UDP and ROS 2",
    "validate": "say what is wrong with route tables",
    "explain": "show what a route does, field by field, with its code, and what a gateway sends",
    "graph": "draw what a table routes",
    "test": "prove what tables do, without network or ROS",
    "send": "send envelopes with payloads of your choice",
    "tap": "show what a running router receives, or what arrives on a UDP port or a ROS topic",
    "top": "watch a running router",
    "listen": "show what a gateway sends",
    "record": "record what a running router receives",
    "replay": "send a recording again, or run it through two tables",
    "reload": "have a running router take its changed table",
    "sim": "play the boards and the basestation",
    "doctor": "look for what keeps a router from working here",
    "new": "add a message: proto, lock, ROS message, route and test",
    "schema": "keep the field numbers of the wire types",
}


class _Version(argparse.Action):
    """Reads the version on demand, since importlib.metadata is slow to import."""

    def __call__(self, parser: argparse.ArgumentParser, *rest: object) -> None:
        from importlib.metadata import version

        print(f"router {version('rover-router')}")
        parser.exit()


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; the exit code: 0, 78 for a bad table, 2 for wrong usage, 1 for the network."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    _open_what_is_closed()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that lacks a character is no reason to fail
    try:
        code = _run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it flushes at exit
        return BROKEN_PIPE
    except KeyboardInterrupt:
        return INTERRUPTED
    except (MemoryError, ImportError, OSError, RuntimeError) as error:  # each of them says that memory could not be had
        if (limit := address_space()) is None or limit >= ADDRESS_SPACE:
            raise
        what = f"this process may map {limit >> 20} MiB of memory (ulimit -v), which is not enough"
        print(
            f"router {_verb(arguments)}: {what}: {str(error).partition(chr(10))[0] or 'no memory'}",
            file=sys.stderr,
            flush=True,
        )
        os._exit(BAD_TABLE)  # threads that could be started when others could not would keep the process
    return code


def _verb(arguments: Sequence[str]) -> str | None:
    return next((argument for argument in arguments if not argument.startswith("-")), None)


def _open_what_is_closed() -> None:
    """A standard stream that our caller has closed leads nowhere; its number would be the next socket's otherwise."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115 - for as long as we run


def _run(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="router",
        description="Route messages between protobuf over UDP and ROS 2.",
        formatter_class=functools.partial(argparse.HelpFormatter, indent_increment=1),  # with 2, long verbs break
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    subparsers = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    chosen = _verb(arguments)
    module = None
    for verb, summary in VERBS.items():
        if verb == chosen:
            module = importlib.import_module(f"router.cli.{verb}")
            module.add_parser(subparsers)
        else:
            subparsers.add_parser(verb, help=summary)
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        subparsers.choices[args.verb].error(f"unrecognized arguments: {' '.join(unknown)}")
    if module is None:
        raise AssertionError("argparse refuses what is no verb")
    try:
        Path.cwd()
    except FileNotFoundError:
        print(f"router {chosen}: the working directory was deleted; change to one that exists", file=sys.stderr)
        return BAD_TABLE
    try:
        code: int = module.run(args)
    except TableError as error:
        from router.cli.findings import print_findings

        print_findings(error.diagnostics, sys.stderr)
        return BAD_TABLE
    except RouterError as error:
        print(f"router {chosen}: {error}", file=sys.stderr)
        if isinstance(error, UsageError):
            return BAD_USAGE
        return NETWORK_FAULT if isinstance(error, TransportError) else BAD_TABLE
    return code
