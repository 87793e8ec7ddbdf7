"""`${NAME}` and `${NAME:-default}` in a text.

Knows no YAML; where the text stands in a file is the caller's business.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from router.errors import Code, nearest

_OPENING = "${"
_REFERENCE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)(?::-((?:(?!\$\{)[^}])*))?\}")
_USAGE = "write ${NAME} or ${NAME:-default}"


@dataclass(frozen=True, slots=True)
class Problem:
    """What is wrong with the characters `start` to `end` (exclusive) of a text."""

    start: int
    end: int
    code: Code
    message: str
    hint: str


def has_variables(text: str) -> bool:
    return _OPENING in text


def fill(text: str, environ: Mapping[str, str]) -> tuple[str, list[Problem]]:
    """The text with every variable replaced, or with those that have a problem left as they are.

    As in a shell, the default stands in for a variable that is empty as well. Values are not searched
    for variables again.
    """
    parts: list[str] = []
    problems: list[Problem] = []
    position = 0
    while (start := text.find(_OPENING, position)) >= 0:
        parts.append(text[position:start])
        match = _REFERENCE.match(text, start)
        position = match.end() if match else _end_of_bad_reference(text, start)
        filled = _value(match, environ) if match else Problem(
            start, position, Code.BAD_VALUE, f"'{text[start:position]}' is no variable", _USAGE
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
        return Problem(match.start(), match.end(), Code.UNDEFINED_VARIABLE, f"the variable '{name}' is not set", hint)
    filled = value or default or ""
    if _OPENING in filled:
        what = f"the value of the variable '{name}' holds '${{', and values are not searched for variables"
        return Problem(match.start(), match.end(), Code.BAD_VALUE, what, "put the final text into the variable")
    return filled


def _end_of_bad_reference(text: str, start: int) -> int:
    closing = text.find("}", start)
    return closing + 1 if closing >= 0 else len(text)
