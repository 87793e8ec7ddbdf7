"""Findings for people and for machines: text with the source line and a caret, JSON, GitHub annotations."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import textwrap
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from router.errors import Diagnostic, Severity, SourceSpan, plural

FORMATS = ("text", "json", "github")

BOLD, RED, GREEN, YELLOW, CYAN = "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m", "\x1b[36m"
_RESET = "\x1b[0m"
_INVISIBLE = re.compile(r"[\x00-\x08\x0a-\x1f\x7f-\x9f\u2028\u2029]")
_LONGEST_LINE = 160


def print_findings(findings: Sequence[Diagnostic], out: TextIO, style: str = "text", *, strict: bool = False) -> None:
    """Write all findings in one of FORMATS; `strict` shows warnings as errors."""
    if style == "json":
        print(json.dumps([as_data(finding, strict=strict) for finding in findings], indent=2), file=out)
        return
    coloured = is_coloured(out)
    for finding in findings:
        is_github = style == "github"
        text = as_github(finding, strict=strict) if is_github else as_text(finding, coloured=coloured, strict=strict)
        out.write(f"{text}\n")


def severity(finding: Diagnostic, *, strict: bool) -> Severity:
    return Severity.ERROR if strict else finding.severity


def count_line(findings: Sequence[Diagnostic], tables: int, *, strict: bool) -> str:
    """Return `2 errors, 1 warning in 1 table`."""
    errors = sum(severity(finding, strict=strict) is Severity.ERROR for finding in findings)
    counts = [plural(errors, "error")] if errors else []
    if len(findings) > errors:
        counts.append(plural(len(findings) - errors, "warning"))
    return f"{', '.join(counts)} in {plural(tables, 'table')}"


def as_data(finding: Diagnostic, *, strict: bool) -> dict[str, str | int]:
    return {
        **place(finding.span),
        "severity": severity(finding, strict=strict).value,
        "code": finding.code.value,
        "message": finding.message,
        "hint": finding.hint,
    }


def as_github(finding: Diagnostic, *, strict: bool) -> str:
    text = finding.message + (f"; {finding.hint}" if finding.hint else "")
    return annotation(severity(finding, strict=strict), finding.span, finding.code.value, text)


def as_text(finding: Diagnostic, *, coloured: bool, strict: bool) -> str:
    """Return the message, the source line with a caret if the file still has it, and the hint."""
    level = severity(finding, strict=strict)
    paint, colour = Paint(coloured), RED if level is Severity.ERROR else YELLOW
    head = paint(BOLD, f"{visible(str(finding.span))}: ") + paint(BOLD + colour, f"{level.value}[{finding.code.value}]")
    remedy = [f"{paint(BOLD + CYAN, 'help:')} {visible(finding.hint)}"] if finding.hint else []
    first = head + paint(BOLD, f": {visible(finding.message)}")
    return "\n".join((first, *excerpt(finding.span, paint, colour), *remedy))


def annotation(level: Severity, span: SourceSpan, title: str, text: str) -> str:
    """Return a workflow command that makes GitHub show a text beside a line of a pull request."""
    properties = {"file": span.file, "line": span.line, "col": span.column, "endColumn": span.end_column}
    listed = ",".join(f"{name}={_escaped(str(value), ':,')}" for name, value in (properties | {"title": title}).items())
    return f"::{level.value} {listed}::{_escaped(text)}"


def place(span: SourceSpan) -> dict[str, str | int]:
    """Return a span as JSON. Lines and columns count from 1, `end_column` is exclusive."""
    return {"file": span.file, "line": span.line, "column": span.column, "end_column": span.end_column}


def wrapped(text: str, out: TextIO, hanging: int = 4) -> str:
    """Return the text with its lines wrapped at words to the width of the terminal; unchanged without a terminal.

    What continues a line is indented by `hanging` more than the line. Words such as paths stay whole.
    """
    if not out.isatty():
        return text
    width = shutil.get_terminal_size().columns
    return "\n".join(line for given in text.splitlines() for line in _wrapped_line(given, width, hanging))


def _wrapped_line(line: str, width: int, hanging: int) -> list[str]:
    indent = " " * (len(line) - len(line.lstrip()) + hanging)
    return textwrap.wrap(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False) or [""]


class Paint:
    """Wraps text in the ANSI sequences of a style if `coloured`."""

    def __init__(self, coloured: bool) -> None:
        self._coloured = coloured

    def __call__(self, style: str, text: str) -> str:
        return f"{style}{text}{_RESET}" if self._coloured else text


def is_coloured(out: TextIO) -> bool:
    return out.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def visible(text: str) -> str:
    """Return the text on one line: line ends and control characters as escapes."""
    return _INVISIBLE.sub(lambda match: repr(match[0])[1:-1], text)


def excerpt(span: SourceSpan, paint: Paint, style: str) -> list[str]:
    """Return the source line with carets below the span; no lines if the file does not have it."""
    lines = _lines(span.file)
    text = lines[span.line - 1] if span.line <= len(lines) else ""
    if not text.strip():
        return []
    start, text = _window(text, span.column - 1)
    before = text[: span.column - 1 - start]
    marked = text[len(before) : span.end_column - 1 - start]
    gap = "".join("\t" if character == "\t" else " " * _width(character) for character in before)
    carets = paint(style, "^" * max(sum(map(_width, marked)), 1))
    return [f"{span.line:5d} | {visible(text)}", f"      | {gap}{carets}"]


def _window(text: str, column: int) -> tuple[int, str]:
    """Return the part of a long line that is shown, preceded by the index of its first character."""
    if len(text) <= _LONGEST_LINE:
        return 0, text
    start = max(0, min(column - _LONGEST_LINE // 2, len(text) - _LONGEST_LINE))
    return start, text[start : start + _LONGEST_LINE]


def _width(character: str) -> int:
    """Return the width of a character in terminal columns; control characters are shown as escapes."""
    if _INVISIBLE.match(character):
        return len(visible(character))
    if unicodedata.combining(character):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _lines(file: str) -> tuple[str, ...]:
    """Return the lines of a file with a finding; none if the file cannot be read."""
    path = Path(file)
    try:
        return _read_lines(path.absolute(), path.stat().st_mtime_ns) if path.is_file() else ()
    except (OSError, ValueError):
        return ()


@functools.lru_cache(maxsize=16)
def _read_lines(path: Path, changed_at: int) -> tuple[str, ...]:
    """Return the lines of a file. `changed_at` (ns) makes the cache read a changed file again."""
    with path.open("rb") as stream:
        data = stream.read(4 << 20)
    return tuple(re.split(r"\r\n|\r|\n", data.decode("utf-8", "replace").removeprefix("\ufeff")))


def _escaped(text: str, more: str = "") -> str:
    for character in "%\r\n" + more:
        text = text.replace(character, f"%{ord(character):02X}")
    return text
