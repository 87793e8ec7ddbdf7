"""What can be wrong, and where: source spans, diagnostics with a closed list of codes, the exceptions.

This module is the bottom of the house: it imports nothing of ours and knows no table, type or socket.
"""

from __future__ import annotations

import difflib
import enum
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, order=True)
class SourceSpan:
    """A stretch of one line of a file that a person wrote.

    `line` and `column` count from 1; `end_column` is exclusive. What covers several lines is blamed on
    its first. A span without a place in the file (a file that cannot be read) has line 1, column 1.
    """

    file: str
    line: int = 1
    column: int = 1
    end_column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"

    def part(self, start: int, end: int) -> SourceSpan:
        """The characters `start` to `end` (from 0, `end` exclusive) of this span."""
        return SourceSpan(self.file, self.line, self.column + start, self.column + max(end, start + 1))


class Severity(enum.Enum):
    ERROR = "error"
    WARNING = "warning"


class Code(enum.Enum):
    """Every kind of finding. Tests match the code, people read the sentence; the list is closed."""

    # the text
    BAD_FILE = "bad-file"
    BAD_YAML = "bad-yaml"
    DUPLICATE_KEY = "duplicate-key"
    AMBIGUOUS_SCALAR = "ambiguous-scalar"
    UNDEFINED_VARIABLE = "undefined-variable"
    BAD_EXTENDS = "bad-extends"
    # the shape
    UNKNOWN_KEY = "unknown-key"
    MISSING_KEY = "missing-key"
    WRONG_TYPE = "wrong-type"
    BAD_VALUE = "bad-value"
    BAD_ADDRESS = "bad-address"
    UNKNOWN_QOS_VALUE = "unknown-qos-value"
    # the wire definitions
    BAD_PROTO = "bad-proto"
    WIRE_NUMBER_CONFLICT = "wire-number-conflict"
    DUPLICATE_MESSAGE = "duplicate-message"
    NOT_LOCKED = "not-locked"
    # the names
    UNKNOWN_PAYLOAD_CASE = "unknown-payload-case"
    UNCOVERED_PAYLOAD_CASE = "uncovered-payload-case"
    UNKNOWN_ENDPOINT = "unknown-endpoint"
    ADDRESS_CLASH = "address-clash"
    FORWARDING_LOOP = "forwarding-loop"
    BAD_TOPIC_NAME = "bad-topic-name"
    TOPIC_TYPE_CLASH = "topic-type-clash"
    UNKNOWN_ROS_TYPE = "unknown-ros-type"
    UNKNOWN_FIELD = "unknown-field"
    UNKNOWN_ENUM_VALUE = "unknown-enum-value"
    QOS_CONFLICT = "qos-conflict"
    BOARD_PAYLOAD = "board-payload"
    NO_TARGET = "no-target"
    # the mapping
    DUPLICATE_FIELD = "duplicate-field"
    NOTHING_MAPPED = "nothing-mapped"
    EXPRESSION_SYNTAX = "expression-syntax"
    FORBIDDEN_EXPRESSION = "forbidden-expression"
    UNKNOWN_FUNCTION = "unknown-function"
    WRONG_ARGUMENTS = "wrong-arguments"
    TYPE_MISMATCH = "type-mismatch"
    LOSSY_CONVERSION = "lossy-conversion"
    OUT_OF_RANGE = "out-of-range"

    @property
    def severity(self) -> Severity:
        return Severity.WARNING if self in _WARNINGS else Severity.ERROR


_WARNINGS = frozenset({Code.UNCOVERED_PAYLOAD_CASE, Code.NOT_LOCKED})


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One finding: where, of which kind, what is wrong, and what to do about it."""

    span: SourceSpan
    code: Code
    message: str
    hint: str = ""

    @property
    def severity(self) -> Severity:
        return self.code.severity

    def __str__(self) -> str:
        """The one-line form, `file:line:column: severity[code]: what; hint`."""
        hint = f"; {self.hint}" if self.hint else ""
        return f"{self.span}: {self.severity.value}[{self.code.value}]: {self.message}{hint}"


class RouterError(Exception):
    """The root of everything that this package raises on purpose."""


class TableError(RouterError):
    """The route table, or what it refers to, is wrong; carries every finding."""

    def __init__(self, diagnostics: Sequence[Diagnostic]) -> None:
        super().__init__("\n".join(map(str, diagnostics)))
        self.diagnostics = tuple(diagnostics)


class StartError(RouterError):
    """An edge could not be opened; the message says which and what to do."""


class DecodeError(RouterError):
    """The sender's fault: a datagram that is no envelope, or a payload that is no such message."""


class MappingError(RouterError):
    """A mapping has no representable result for this one value."""


class NonFiniteError(MappingError):
    """NaN or an infinity where the target can only hold a finite value."""


class TransportError(RouterError):
    """The network's fault: a datagram or a ROS message could not be handed over."""


def shown_path(path: Path) -> str:
    """How findings name a file: relative to the working directory where it is below it."""
    absolute = path.absolute()
    try:
        return str(absolute.relative_to(Path.cwd()))
    except ValueError:
        return str(absolute)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name that somebody who wrote `name` most likely meant, None when none is near."""
    folded = {candidate.lower(): candidate for candidate in sorted(set(known))}
    close = difflib.get_close_matches(name.lower(), folded, n=1, cutoff=0.6)
    return folded[close[0]] if close else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint for a name that does not exist: the nearest known one, else a short list, else nothing."""
    candidates = sorted(set(known))
    if close := nearest(name, candidates):
        return f"did you mean '{close}'?"
    if not candidates:
        return ""
    shown = ", ".join(candidates[:8])
    return f"known: {shown}" + (f" and {len(candidates) - 8} more" if len(candidates) > 8 else "")
