"""The code blocks of a page: commands with their output, files, and others. CONTRIBUTING.md has the rules."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_NOT_RUN = re.compile(r"<!-- not run: \S.*-->")
_FILE = re.compile(r"(?:#|//) ((?:[\w.-]+/)*[\w-]+\.\w[\w.]*)(?::.*)?")
_EXIT = re.compile(r"# exit code (\d+)")
ANY = "..."


@dataclass(frozen=True)
class Block:
    """The text between two fences; `line` is the number of its first line in the page."""

    language: str
    line: int
    lines: tuple[str, ...]
    is_run: bool


@dataclass(frozen=True)
class File:
    line: int
    path: str
    text: str


@dataclass(frozen=True)
class Command:
    line: int
    text: str
    printed: tuple[str, ...]
    code: int = 0

    @property
    def is_background(self) -> bool:
        return self.text.endswith(" &")

    def is_printed(self, output: str) -> bool:
        """Whether the output matches the page. The output of a background process only has to begin with it."""
        lines = [line.rstrip() for line in output.rstrip().splitlines()]
        shown = "".join(r"(?:.*\n)*?" if line == ANY else f"{_line(line)}\n" for line in self.printed)
        more = r"(?:.*\n)*" if self.is_background else ""
        return not self.printed or re.fullmatch(shown + more, "".join(f"{line}\n" for line in lines)) is not None


def _line(shown: str) -> str:
    return ".*".join(map(re.escape, shown.rstrip().split(ANY)))


def blocks(page: Path) -> Iterator[Block]:
    lines = page.read_text(encoding="utf-8").splitlines()
    start = None
    for number, line in enumerate(lines):
        if not line.lstrip().startswith("```"):
            continue
        if start is None:
            start = number
            continue
        language = lines[start].strip().strip("`")
        before = lines[start - 1].strip() if start else ""
        indent = len(lines[start]) - len(lines[start].lstrip())
        found = tuple(each[indent:] for each in lines[start + 1 : number])
        yield Block(language, start + 2, found, _NOT_RUN.fullmatch(before) is None)
        start = None


def steps(page: Path) -> list[File | Command]:
    """The steps of a reader, from top to bottom."""
    found: list[File | Command] = []
    for block in blocks(page):
        if not block.is_run:
            continue
        if block.language == "console":
            found += commands(block)
        elif block.language == "sh":
            found += [Command(block.line + number, line, ()) for number, line in enumerate(block.lines)]
        elif block.lines and (path := file_name(block.lines[0])):
            lines = block.lines[block.language == "json" :]  # where a comment would be an error
            found.append(File(block.line, path, "\n".join([*lines, ""])))
    return found


def typed(page: Path) -> list[str]:
    """The commands of a page, in order."""
    return [step.text for step in steps(page) if isinstance(step, Command)]


def written(page: Path) -> dict[str, str]:
    """The complete files on a page, by path."""
    return {step.path: step.text for step in steps(page) if isinstance(step, File)}


def file_name(first_line: str) -> str | None:
    """The path in the comment on a block's first line, if the block is a file."""
    named = _FILE.fullmatch(first_line)
    return named[1] if named else None


def commands(block: Block) -> Iterator[Command]:
    """The commands of a block. Raises ValueError if the block has none."""
    number = 0
    while number < len(block.lines):
        first = number
        if not block.lines[first].startswith("$ "):
            raise ValueError(f"line {block.line + first}: a block begins with a command: `$ ...`")
        text = [block.lines[first][2:]]
        number += 1
        while number < len(block.lines) and (text[-1].endswith("\\") or "<<" in text[0]):
            if not block.lines[number].startswith("> "):
                break
            text.append(block.lines[number][2:])
            number += 1
        printed = []
        while number < len(block.lines) and not block.lines[number].startswith("$ "):
            printed.append(block.lines[number])
            number += 1
        code = 0
        if printed and (ended := _EXIT.fullmatch(printed[-1])):
            code = int(ended[1])
            printed.pop()
        while printed and not printed[-1].strip():
            printed.pop()
        yield Command(block.line + first, "\n".join(text), tuple(printed), code)
