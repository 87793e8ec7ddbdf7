"""The command line and its verbs. The module of a verb is imported only when the verb is chosen.

A verb's module provides `add_parser(subparsers)`, which calls `add_verb`, and `run(args) -> int`.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import io
import os
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn, TextIO, TypeAlias

from router import __version__
from router.errors import (
    ConfigurationError,
    OperatorError,
    RouterError,
    StartError,
    TableError,
    TransportError,
    UsageError,
    nearest,
)
from router.shortage import (  # imported here: imports fail once memory is short
    ADDRESS_SPACE,
    address_space,
    is_shortage,
)

Subparsers: TypeAlias = "argparse._SubParsersAction[_VerbParser]"

OK = 0
NETWORK_FAULT = 1
NOT_NOW = 1
"""Something cannot be opened now: a later attempt may succeed, so the systemd unit restarts after it."""
BAD_USAGE = 2
UNWRITTEN = 74
"""EX_IOERR: stdout is a file on a full disk."""
BAD_TABLE = 78
"""EX_CONFIG: the systemd unit does not restart after it."""
INTERRUPTED = 130
BROKEN_PIPE = 141

_UNWRITTEN = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})

DEFAULT_TABLE = Path("routes/rover.yaml")

GROUPS = {
    "Check": {
        "validate": "report the errors and warnings of route tables",
        "test": "run the tests of tables, without network or ROS",
        "explain": "show what a route does, field by field",
        "graph": "draw the routes of a table",
        "doctor": "find what keeps a router from working on this computer",
    },
    "Run": {
        "run": "run a route table between UDP and ROS 2",
        "status": "print in one line whether the router is running and healthy",
        "reload": "make the running router reload its table",
    },
    "Watch": {
        "top": "watch rates, drops and ages of the running router",
        "tap": "show what the running router receives",
        "listen": "show what a gateway, a UDP port or a ROS topic carries",
    },
    "Record": {
        "record": "record what the running router receives",
        "show": "print a recording, or explain the stops in it",
        "replay": "send a recording again, or run it through two tables",
    },
    "Try": {
        "demo": "run a router and simulated boards on this computer",
        "init": "write a first table into a folder",
        "sim": "simulate the boards and the basestation of a table",
        "send": "send envelopes with payloads of your choice",
        "call": "call a ROS service and print its response",
    },
    "Protocol": {
        "new": "add a message to all files of a rover checkout",
        "schema": "lock the field numbers of the protobuf messages",
    },
}
VERBS = {verb: summary for verbs in GROUPS.values() for verb, summary in verbs.items()}

SHELLS = ("bash", "zsh", "fish")
_OPTIONS = {
    "--version": "print the version and exit",
    f"--completion {'|'.join(SHELLS)}": "print the completion script, for eval in the shell's start-up file",
}
_INDENT = " " * 12


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *rest: object) -> None:
        print(f"router {__version__}")
        parser.exit()


class _Completion(argparse.Action):
    """Prints the script with which a shell completes command lines of the router."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: object, shell: object, *rest: object) -> None:
        from argcomplete.shell_integration import shellcode

        print(shellcode(["router"], shell=str(shell)))
        parser.exit()


class _MainParser(argparse.ArgumentParser):
    """A parser whose help shows the verbs in groups instead of one long list."""

    def format_help(self) -> str:
        import shutil
        import textwrap

        width = shutil.get_terminal_size().columns - 2
        lines = ["usage: router VERB ...", "", *textwrap.wrap(self.description or "", width)]
        for group, verbs in GROUPS.items():
            lines += ["", f"{group}:"]
            for verb, summary in verbs.items():
                lines += textwrap.wrap(f"  {verb:9} {summary}", width, subsequent_indent=_INDENT)
        lines += ["", *textwrap.wrap("'router VERB --help' shows the options of a verb, with examples.", width), ""]
        for option, summary in _OPTIONS.items():
            lines += [f"  {option}", *textwrap.wrap(summary, width, initial_indent=_INDENT, subsequent_indent=_INDENT)]
        return "\n".join([*lines, ""])


class _VerbParser(argparse.ArgumentParser):
    """The parser of a verb. An error about missing arguments shows the `example` of a complete command."""

    example = ""

    def error(self, message: str) -> NoReturn:
        hint = f"for example, `{self.example}`" if "are required" in message and self.example else ""
        super().error(with_help(message, hint))


class _Help(argparse.HelpFormatter):
    """Wraps paragraphs at the terminal's width, except those with indented lines (examples)."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n\n".join(
            part if "\n  " in part else super(_Help, self)._fill_text(part, width, indent)
            for part in text.strip().split("\n\n")
        )


def add_verb(subparsers: Subparsers, name: str, description: str, *examples: str, more: str = "") -> _VerbParser:
    """Add the parser of a verb, or of an action of a verb. Its help ends with `more`, then the examples."""
    shown = "\n".join(["examples:", *(f"  {example}" for example in examples)])
    parser = subparsers.add_parser(
        name,
        help=VERBS.get(name) or description[0].lower() + description[1:].partition(". ")[0],
        description=description,
        epilog=f"{more}\n\n{shown}",
        formatter_class=_Help,
        allow_abbrev=False,
    )
    parser.example = examples[0]
    return parser


def with_help(what: str, hint: str = "") -> str:
    """Return the problem, with the remedy on a line of its own, as in findings."""
    return f"{what}\nhelp: {hint}" if hint else what


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb. Return the exit code: the verb's own, or for an error one of the constants above."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for terminals without Unicode
    try:
        try:
            code = _run(arguments)
        finally:  # also when argparse prints and exits
            sys.stdout.flush()
    except BrokenPipeError:
        _leave(sys.stdout, sys.stderr)
        return BROKEN_PIPE
    except KeyboardInterrupt:
        return INTERRUPTED
    except (MemoryError, ImportError, OSError, RuntimeError) as error:
        if isinstance(error, OSError) and error.errno in _UNWRITTEN and error.filename is None:
            _leave(sys.stdout)
            print(f"router {_verb(arguments) or ''}".rstrip() + f": stdout: {error.strerror}", file=sys.stderr)
            return UNWRITTEN
        if isinstance(error, ImportError) and (problem := _import_problem(error)):
            print(with_help(f"router {_verb(arguments)}: {problem.what}", problem.hint), file=sys.stderr)
            return BAD_TABLE
        # Each of these errors can mean that memory could not be allocated.
        if (limit := address_space()) is None or limit >= ADDRESS_SPACE:
            if not is_shortage(error):
                raise
            what = f"memory, threads or descriptors have run out: {str(error) or 'no memory'}"
            print(f"router {_verb(arguments)}: {what}", file=sys.stderr)
            return NOT_NOW
        what = f"this process may map {limit >> 20} MiB of memory (ulimit -v), which is not enough"
        print(
            f"router {_verb(arguments)}: {what}: {str(error).partition(chr(10))[0] or 'no memory'}",
            file=sys.stderr,
            flush=True,
        )
        os._exit(NOT_NOW)  # threads that did start would keep the process alive
    return code


def _import_problem(error: ImportError) -> ConfigurationError | None:
    """Return the error to show for a failed import; None if it has another cause than the installation."""
    if "declared" in error.msg:
        return ConfigurationError("router/declared.py does not match the headers of the carrier", "run 'make setup'")
    if not isinstance(error, ModuleNotFoundError):
        return None
    from router.compiler.extras import extra_of, missing_extra  # which needs declarations and memory

    if (extra := extra_of(error.name or "")) is None:
        return None
    return missing_extra(f"this needs a Python package that is not installed: {error.name}", extra)


def _leave(*streams: TextIO) -> None:
    """Discard buffered output: flushing it at exit would fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        os.dup2(nowhere, stream.fileno())


def _verb(arguments: Sequence[str]) -> str | None:
    """Return the first argument unless it is an option, such as --version, which needs no verb."""
    return arguments[0] if arguments and not arguments[0].startswith("-") else None


def _run(arguments: Sequence[str]) -> int:
    parser = _MainParser(prog="router", description="Route messages between protobuf over UDP and ROS 2.")
    parser.add_argument("--version", action=_Version, nargs=0)
    parser.add_argument("--completion", action=_Completion, choices=SHELLS)
    subparsers: Subparsers = parser.add_subparsers(dest="verb", metavar="VERB", parser_class=_VerbParser)
    if "_ARGCOMPLETE" in os.environ:
        _complete(parser, subparsers)
    chosen = _verb(arguments)
    module = _add_verbs(subparsers, chosen)
    if chosen == "help":
        return _run([*(word for word in arguments[1:2] if word in VERBS), "--help"])
    if mistake := _mistake(arguments):
        print(f"router: {mistake}", file=sys.stderr)
        return BAD_USAGE
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        _refuse(subparsers.choices[chosen] if chosen else parser, unknown)
    if module is None:
        parser.print_help()
        return OK
    try:
        Path.cwd()
    except FileNotFoundError:
        what = f"router {chosen}: the working directory was deleted"
        print(with_help(what, "change to one that exists"), file=sys.stderr)
        return BAD_TABLE
    try:
        code: int = module.run(args)
    except TableError as error:
        from router.cli.findings import print_findings

        print_findings(error.diagnostics, sys.stderr)
        return BAD_TABLE
    except RouterError as error:
        what, hint = (error.what, error.hint) if isinstance(error, OperatorError) else (str(error), "")
        print(with_help(f"router {chosen}: {what}", hint), file=sys.stderr)
        return _code_of(error)
    return code


def _code_of(error: RouterError) -> int:
    if isinstance(error, UsageError):
        return BAD_USAGE
    if isinstance(error, StartError) and not isinstance(error, ConfigurationError):
        return NOT_NOW
    return NETWORK_FAULT if isinstance(error, TransportError) else BAD_TABLE


def _mistake(arguments: Sequence[str]) -> str:
    """Return what is wrong with the first word, and the remedy; "" for a verb or an option that needs no verb."""
    first = arguments[0] if arguments else "--help"
    if first.startswith("-"):
        if first.partition("=")[0] in {"-h", "--help", "--version", "--completion"}:
            return ""
        return with_help(
            f"'{first}' is not an option of the router itself", "write options after the verb: router VERB ..."
        )
    return "" if first in VERBS else with_help(f"there is no verb '{first}'", _suggestion(first, VERBS))


def _add_verbs(subparsers: Subparsers, chosen: str | None) -> ModuleType | None:
    """Add every verb, the chosen one with its arguments. Return the module of the chosen one."""
    module = None
    for verb, summary in VERBS.items():
        if verb == chosen:
            module = importlib.import_module(f"router.cli.{verb}")
            module.add_parser(subparsers)
        else:
            subparsers.add_parser(verb, help=summary)
    return module


def _complete(parser: argparse.ArgumentParser, subparsers: Subparsers) -> NoReturn:
    """Print the completions of COMP_LINE, the command line that is being typed in a shell."""
    import argcomplete

    _add_verbs(subparsers, _verb(os.environ.get("COMP_LINE", "").split()[1:]))
    argcomplete.autocomplete(parser, always_complete_options=False)
    sys.exit(OK)


def _refuse(parser: argparse.ArgumentParser, unknown: Sequence[str]) -> NoReturn:
    """Report the words that a verb does not take, and the option that the first one resembles."""
    option = unknown[0].partition("=")[0]
    options = re.findall(r"--\w[\w-]*", parser.format_help())
    close = nearest(option, options) if option.startswith("-") else None
    if option.endswith((".yaml", ".yml")) and "--table" in options:
        parser.error(with_help(f"unrecognized arguments: {' '.join(unknown)}", f"name the table with -t {option}"))
    hint = f"did you mean '{close}'?" if close else f"'{parser.prog} --help' lists the arguments"
    parser.error(with_help(f"unrecognized arguments: {' '.join(unknown)}", hint))


def _suggestion(name: str, known: Iterable[str]) -> str:
    close = nearest(name, known)
    return f"did you mean '{close}'?" if close else "run 'router' for a list"
