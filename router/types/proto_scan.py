"""What the text of a `.proto` file says without a compiler: what it declares and what it imports.

Works for files that do not compile.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

_TOKEN = re.compile(
    rb"""(?P<skipped>//[^\n]*|/\*.*?(?:\*/|\Z)|^(?:<{7}|\|{7}|>{7})[^\n]*)"""
    rb"""|"(?:\\.|[^"\\\n])*"?|'(?:\\.|[^'\\\n])*'?|[\w.]+|[{};]""",
    re.DOTALL | re.MULTILINE,
)
"""Comments and the marks of an unresolved merge are skipped."""
_SIGNS = frozenset("{;}")


@dataclass(frozen=True, slots=True)
class Scanned:
    """`names` are the full names of all messages and enums, nested ones as well; `messages` those of messages."""

    package: str
    names: tuple[str, ...]
    messages: frozenset[str]
    imports: tuple[str, ...]

    def is_top_level(self, name: str) -> bool:
        return "." not in name.removeprefix(f"{self.package}." if self.package else "")


def scan(content: bytes) -> Scanned:
    """The declarations and imports of a file, in order."""
    package = ""
    names: list[str] = []
    messages: set[str] = set()
    imports: list[str] = []
    blocks: list[str] = []  # for each open brace the full name of the message, or that of the one around
    for statement, opens in _statements(content):
        match statement:
            case ["package", name]:
                package = name
            case ["import", *_, name]:
                imports.append(name.strip("\"'"))
            case [*_, ("message" | "enum") as kind, name] if opens:  # `export` or `local` may stand before it
                around = blocks[-1] if blocks else package
                names.append(f"{around}.{name}" if around else name)
                if kind == "message":
                    messages.add(names[-1])
                blocks.append(names[-1])
                continue
            case ["}"]:
                del blocks[-1:]
        if opens:
            blocks.append(blocks[-1] if blocks else package)
    return Scanned(package, tuple(names), frozenset(messages), tuple(imports))


def _statements(content: bytes) -> Iterator[tuple[list[str], bool]]:
    """The words before each `;` or brace, and whether a block begins there. A `}` is a statement of its own."""
    words: list[str] = []
    for match in _TOKEN.finditer(content):
        if match["skipped"]:
            continue
        word = match[0].decode(errors="replace")
        if word not in _SIGNS:
            words.append(word)
            continue
        yield words, word == "{"
        words = []
        if word == "}":
            yield ["}"], False


def declaring(name: str, files: Mapping[str, bytes]) -> list[tuple[str, str]]:
    """The files that declare a message or an enum of this full or short name, each with the full name."""
    short = re.compile(rb"\b" + re.escape(name.rpartition(".")[2].encode()) + rb"\b")
    return [
        (file, full)
        for file, content in files.items()
        if short.search(content)
        for full in scan(content).names
        if full == name or full.endswith(f".{name}")
    ]


def reached(start: str, files: Mapping[str, bytes]) -> set[str]:
    """The file and all that it imports, directly or not, whether they exist or not."""
    found: set[str] = set()
    waiting: Iterable[str] = [start]
    while waiting:
        found.update(waiting)
        waiting = {name for file in waiting for name in scan(files.get(file, b"")).imports} - found
    return found
