"""How our files are laid out: stanzas of YAML with a line between, sections with a rule, comments below each other.

Lines in, lines out; knows no key and no message.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

WIDEST = 120
_SECTION_WIDTH = 115
_COMMENT_GAP = 3


@dataclass(frozen=True, slots=True)
class Stanza:
    """The lines of one entry in a file: `first` is that of its key, `end` the one behind its last; from 0."""

    first: int
    end: int
    indent: int


def stanza_at(lines: Sequence[str], first: int) -> Stanza:
    """That whose key is in the line `first`. What stands above the next key belongs to that."""
    indent = _indent(lines[first])
    end = first + 1
    while end < len(lines) and (_says_nothing(lines[end]) or _is_below(lines[end], indent)):
        end += 1
    while _says_nothing(lines[end - 1]):
        end -= 1
    return Stanza(first, end, indent)


def with_stanza_after(lines: Sequence[str], before: Stanza, written: Iterable[str], section: str = "") -> str:
    """The text with another stanza below `before`, in a section of its own where that has a name."""
    indent = " " * before.indent
    head = ["", f"{indent}# ---- {section} ".ljust(_SECTION_WIDTH, "-")] if section else []
    stanza = ["", *(indent + line for line in written)]
    return "\n".join([*lines[: before.end], *head, *stanza, *lines[before.end :]])


def aligned(rows: Iterable[tuple[str, str]], mark: str) -> Iterator[str]:
    """Lines of declarations with their comments below each other."""
    rows = list(rows)
    width = max((len(code) for code, comment in rows if comment), default=0) + _COMMENT_GAP
    for code, comment in rows:
        yield f"{code:{width}}{mark} {comment}" if comment else code


def _is_below(line: str, indent: int) -> bool:
    """A list, and what closes a brace, may stand as far left as their key, or further."""
    is_item = line.lstrip().startswith("- ") and _indent(line) == indent
    return _indent(line) > indent or is_item or line.lstrip()[0] in "]}"


def _says_nothing(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith("#")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())
