"""Reading of one table file: bounded, decoded, without invisible characters, with `${VARIABLES}` replaced.

A file that cannot be read raises TableError with one finding.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from router import inputs
from router.assets import asset, is_installed
from router.errors import Code, SourceSpan, TableError, nearest, nearest_path, shown_path

TEST_ENDINGS = (".test.yaml", ".test.yml")
"""What the names of files with table tests end in."""
MAX_BYTES = 4 << 20
UNREADABLE = "the file cannot be read: "
_LINE_END = re.compile(r"\r\n|\r|\n")
_UNUSABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff\ud800-\udfff\ufffe\uffff]")


@dataclass(frozen=True, slots=True)
class Source:
    """A file: `file` is its name in findings; `text` has no byte order mark; `lines` have no line ends."""

    path: Path
    file: str
    data: bytes
    text: str
    lines: tuple[str, ...]

    def span(self, line: int, column: int, end_line: int, end_column: int) -> SourceSpan:
        """Return a span from YAML's marks, which count from 0; of several lines, the first."""
        if end_line != line:
            end_column = len(self.lines[line]) if line < len(self.lines) else column
        return SourceSpan(self.file, line + 1, column + 1, max(end_column, column) + 1)


def read_source(path: Path) -> Source:
    """Read a file. Raises TableError if it cannot be read."""
    file = shown_path(path)
    data = _read(path, file)
    try:
        text = data.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        before = _LINE_END.split(data[: error.start].decode("utf-8"))
        span = SourceSpan(file, len(before), len(before[-1]) + 1, len(before[-1]) + 2)
        what = f"the byte 0x{data[error.start]:02x} is not UTF-8"
        raise TableError.of(span, Code.BAD_FILE, what, "save the file as UTF-8") from error
    source = Source(path, file, data, text, tuple(_LINE_END.split(text)))
    if unusable := unusable_character(text):
        offset, name = unusable
        line = len(_LINE_END.split(text[:offset])) - 1
        column = offset - max(text.rfind("\n", 0, offset), text.rfind("\r", 0, offset)) - 1
        what = f"tables cannot contain the character {name}"
        raise TableError.of(source.span(line, column, line, column + 1), Code.BAD_YAML, what)
    return source


def unusable_character(text: str) -> tuple[int, str] | None:
    """Return offset and name of a control character, foreign line end or half surrogate pair; None if there is none."""
    match = _UNUSABLE.search(text)
    return (match.start(), f"U+{ord(match[0]):04X}") if match else None


def foreign_blank(text: str) -> str | None:
    """Return the name of the first character that looks like a space, or is invisible, but is not a space in YAML."""
    if text.isascii():
        return None
    blank = next((char for char in text if unicodedata.category(char) in ("Zs", "Cf") and char != " "), None)
    return f"U+{ord(blank):04X}" if blank else None


def _read(path: Path, file: str) -> bytes:
    hint = ""
    try:
        if inputs.is_dir(path):
            what = "this is a folder, not a route table"
        elif inputs.exists(path) and not inputs.is_file(path):
            what = "this is not a regular file"
        else:
            data = inputs.read_bytes(path, MAX_BYTES + 1)
            if len(data) <= MAX_BYTES:
                return data
            what = f"the file is larger than {MAX_BYTES >> 20} MiB"
    except OSError as error:
        what = f"{UNREADABLE}{(error.strerror or str(error)).lower()}"
        if isinstance(error, FileNotFoundError) and (near := nearest_path(path)):
            hint = f"did you mean '{shown_path(near)}'?"
        elif isinstance(error, FileNotFoundError) and not path.is_absolute():
            hint = f"paths are relative to the working directory, {Path.cwd()}"
            if is_installed(asset("routes")):
                hint += "; `router init` writes example tables there"
    except ValueError as error:  # a path that no file system accepts: NUL, half a surrogate pair
        what = f"{UNREADABLE}{error}"
    raise TableError.of(SourceSpan(file), Code.BAD_FILE, what, hint)


_OPENING = "${"
_REFERENCE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)(?::-((?:(?!\$\{)[^}])*))?\}")
_USAGE = "write ${NAME} or ${NAME:-default}"


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem with the characters `start` to `end` (exclusive) of a text."""

    start: int
    end: int
    code: Code
    message: str
    hint: str


_AS_IN_A_SHELL = re.compile(r"\$\(?([A-Za-z_]\w*)\)?|^~(?=/|$)")


def in_braces(text: str) -> str:
    """Return the text with shell variables, such as `$NAME` or `~`, in the syntax of tables."""
    return _AS_IN_A_SHELL.sub(lambda match: f"${{{match[1] or 'HOME'}}}", text)


def has_variables(text: str) -> bool:
    return _OPENING in text


def fill(text: str, environ: Mapping[str, str]) -> tuple[str, list[Problem]]:
    """Return the text with every variable replaced, except those with a problem, and the problems.

    As in a shell, the default also replaces an empty variable. Values are not expanded again.
    """
    parts: list[str] = []
    problems: list[Problem] = []
    position = 0
    while (start := text.find(_OPENING, position)) >= 0:
        parts.append(text[position:start])
        match = _REFERENCE.match(text, start)
        position = match.end() if match else _end_of_bad_reference(text, start)
        filled = _value(match, environ) if match else Problem(
            start, position, Code.BAD_VALUE, f"'{text[start:position]}' is not a variable", _USAGE
        )  # fmt: skip
        if isinstance(filled, Problem):
            problems.append(filled)
            filled = text[start:position]
        parts.append(filled)
    parts.append(text[position:])
    return "".join(parts), problems


def _value(match: re.Match[str], environ: Mapping[str, str]) -> str | Problem:
    name, default = match[1], match[2]
    value = environ.get(name)
    if value is None and default is None:
        near = nearest(name, environ)
        hint = f"did you mean '{near}'? " if near else ""
        hint += f"set it, or give it a default: ${{{name}:-value}}"
        hint += f"; in an expression, name a field as `{name}`" if name.islower() else ""
        return Problem(match.start(), match.end(), Code.UNDEFINED_VARIABLE, f"the variable '{name}' is not set", hint)
    filled = value or default or ""
    if _OPENING in filled:
        what = f"the value of the variable '{name}' contains '${{', but values are not expanded again"
        return Problem(match.start(), match.end(), Code.BAD_VALUE, what, "set the variable to the final text")
    return filled


def _end_of_bad_reference(text: str, start: int) -> int:
    closing = text.find("}", start)
    return closing + 1 if closing >= 0 else len(text)
