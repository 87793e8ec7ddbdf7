"""`router graph [TABLE] -o FILE`: what a table routes, as a picture or as text that other programs draw."""

from __future__ import annotations

import argparse
from pathlib import Path

from router.cli import OK, Subparsers, add_verb
from router.cli.tool_options import add_table, good_table, say, table_path
from router.errors import UsageError, plural

SUFFIXES = (".svg", ".mmd", ".dot")
_DESCRIPTION = """Draw who sends which payload cases and where each goes, with a legend, as text for Mermaid (.mmd) or
Graphviz (.dot), or as an SVG, which follows the viewer's light or dark theme and shows addresses and types as tooltips.
An SVG needs Graphviz."""


def add_parser(subparsers: Subparsers) -> None:
    examples = ("router graph -o routes.svg", "router graph routes/legacy.yaml -o legacy.mmd")
    parser = add_verb(subparsers, "graph", _DESCRIPTION, *examples)
    add_table(parser, is_subject=True)
    what = f"file to write; its name ends in {', '.join(SUFFIXES)}"
    parser.add_argument("-o", "--output", type=_output, required=True, metavar="FILE", help=what)


def _output(text: str) -> Path:
    path = Path(text)
    if path.suffix not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"'{text}' does not end in {', '.join(SUFFIXES)}")
    return path


def run(args: argparse.Namespace) -> int:
    from router.tools.graph import dot, mermaid, svg

    table = good_table(table_path(args))[1].table
    draw = {".svg": svg, ".mmd": mermaid, ".dot": dot}[args.output.suffix]
    try:
        args.output.write_text(draw(table, table.path.name), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{args.output} cannot be written: {error.strerror}") from error
    say(f"{args.output}: {plural(len(table.routes), 'route')}")
    return OK
