"""Source spans, diagnostics with a closed list of codes, and exceptions."""

from __future__ import annotations

import difflib
import enum
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True, order=True)
class SourceSpan:
    """Part of one line of a source file.

    `line` and `column` count from 1; `end_column` is exclusive. A finding about several lines points at the first.
    A span without a position, for example of an unreadable file, has line 1, column 1.
    """

    file: str
    line: int = 1
    column: int = 1
    end_column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"

    def part(self, start: int, end: int) -> SourceSpan:
        """Return the span of the characters `start` to `end` (from 0, `end` exclusive) of this one."""
        return SourceSpan(self.file, self.line, self.column + start, self.column + max(end, start + 1))


@dataclass(frozen=True, slots=True)
class Located(Generic[T]):
    """A value and its position in the source."""

    value: T
    span: SourceSpan


class Severity(enum.Enum):
    ERROR = "error"
    WARNING = "warning"


class Code(enum.Enum):
    """A kind of finding. The list is closed: tests match the code, people read the message."""

    meaning: str

    def __new__(cls, value: str, meaning: str) -> Code:
        code = object.__new__(cls)
        code._value_ = value
        code.meaning = meaning
        return code

    # the text
    BAD_FILE = ("bad-file", "A file cannot be read, or does not contain what it should.")
    BAD_YAML = (
        "bad-yaml",
        "The table is not YAML, or uses YAML that tables do not support (tags, merge keys, several documents).",
    )
    DUPLICATE_KEY = ("duplicate-key", "A mapping has the same key twice.")
    AMBIGUOUS_SCALAR = (
        "ambiguous-scalar",
        "A plain word or number that YAML parsers interpret differently (`on`, `0777`, `12:30`).",
    )
    UNDEFINED_VARIABLE = ("undefined-variable", "`${NAME}` has neither a value in the environment nor a default.")
    BAD_EXTENDS = ("bad-extends", "The table named by `extends` is missing, or extends this one.")
    # the shape
    UNKNOWN_KEY = ("unknown-key", "A key that is not allowed here.")
    MISSING_KEY = ("missing-key", "A required key is missing.")
    WRONG_TYPE = ("wrong-type", "A value of the wrong type for its key.")
    BAD_VALUE = ("bad-value", "A value of the right type that makes no sense here.")
    BAD_ADDRESS = ("bad-address", "Not an IP address with a port.")
    UNKNOWN_QOS_VALUE = ("unknown-qos-value", "Not a ROS QoS setting.")
    # the wire definitions
    BAD_PROTO = ("bad-proto", "A `.proto` file does not compile, or declares something that cannot be routed.")
    UNUSED_PROTO = ("unused-proto", "A `.proto` file that the envelope does not import is broken, or clashes.")
    UNUSED_OPTION = ("unused-option", "A line of an `.options` file matches nothing in its `.proto` file.")
    WIRE_NUMBER_CONFLICT = (
        "wire-number-conflict",
        "A field number was reused, renumbered, retyped or renamed, or the envelope is another message.",
    )
    DUPLICATE_MESSAGE = ("duplicate-message", "Two protobuf messages have the same name.")
    NOT_LOCKED = ("not-locked", "`envelope.lock.json` does not record this yet: run `router schema lock`.")
    # the names
    UNKNOWN_PAYLOAD_CASE = ("unknown-payload-case", "A route for a payload case that is not in the envelope.")
    UNCOVERED_PAYLOAD_CASE = ("uncovered-payload-case", "A payload case with neither a route nor `ignore`.")
    UNKNOWN_ENDPOINT = ("unknown-endpoint", "A source or destination that is not in `endpoints`.")
    UNKNOWN_ENVELOPE = ("unknown-envelope", "The `envelope` of a listener or an endpoint that is not in `envelopes`.")
    UNKNOWN_LISTENER = ("unknown-listener", "An endpoint's `listener` or `send_from` that is not in `listen`.")
    UNUSED_LISTENER = ("unused-listener", "A listener that accepts none of the sending endpoints.")
    ADDRESS_CLASH = (
        "address-clash",
        "Two local addresses or Zenoh keys are the same, or two endpoints cannot be told apart.",
    )
    OUTSIDE_NETWORKS = ("outside-networks", "An address, or a way to discover others, outside the table's `networks`.")
    FORWARDING_LOOP = (
        "forwarding-loop",
        "A destination is the message's own source, or this router; or replies lead back to the first one.",
    )
    BAD_TOPIC_NAME = ("bad-topic-name", "Not a ROS topic name.")
    TOPIC_TYPE_CLASH = ("topic-type-clash", "Two routes or gateways give one topic different types.")
    UNKNOWN_ROS_TYPE = ("unknown-ros-type", "Neither an installed package nor `schemas/` defines this interface.")
    UNKNOWN_FIELD = ("unknown-field", "A field that the source message or the target does not have.")
    UNKNOWN_ENUM_VALUE = ("unknown-enum-value", "Not a value of the enum, or not a constant of the ROS type.")
    MISSING_ENUM_VALUE = ("missing-enum-value", "A `map` without `else` that does not cover every value.")
    QOS_CONFLICT = (
        "qos-conflict",
        "QoS settings that contradict each other, or that keep publisher and subscription from connecting.",
    )
    BOARD_PAYLOAD = (
        "board-payload",
        "A payload that a board's firmware cannot decode: no fixed size, too large, or not finite.",
    )
    EMPTY_FIELD = (
        "empty-field",
        "A field of the envelope, beside the payload, that nothing fills where the router makes envelopes for boards.",
    )
    UNUSED_SET = ("unused-set", "A `set` of an endpoint for which the router makes no messages.")
    UNKNOWN_STATE = ("unknown-state", "A condition reads a state that is not in `state`.")
    NEVER_SET = ("never-set", "A state that no message can set, because no route takes its messages.")
    NO_TARGET = ("no-target", "A route without destinations or topics.")
    SOURCE_CLASH = ("source-clash", "Two routes of one payload case have the same source.")
    NO_DEADMAN = ("no-deadman", "Nothing stops the board when its commands stop arriving.")
    DOUBTFUL_DEADMAN = (
        "doubtful-deadman",
        "A deadman that may not serve its purpose, for example with a timeout of 500 s.",
    )
    NO_TTL = (
        "no-ttl",
        "Nothing drops old commands: one may follow the deadman's payload, or move the rover at the start.",
    )
    # the mapping
    DUPLICATE_FIELD = ("duplicate-field", "A mapping fills a field twice, or two members of one oneof.")
    NOTHING_MAPPED = ("nothing-mapped", "A mapping that fills no field at all.")
    EXPRESSION_SYNTAX = ("expression-syntax", "Not a valid expression.")
    CUT_EXPRESSION = (
        "cut-expression",
        "A comment that looks like the rest of the expression before it.",
    )
    FORBIDDEN_EXPRESSION = ("forbidden-expression", "Python syntax that expressions do not support.")
    UNKNOWN_FUNCTION = ("unknown-function", "A function that is not listed in [functions](functions.md).")
    WRONG_ARGUMENTS = ("wrong-arguments", "A call with too many, too few or unsuitable arguments.")
    TYPE_MISMATCH = (
        "type-mismatch",
        "A value whose type does not fit the field or the operator.",
    )
    LOSSY_CONVERSION = ("lossy-conversion", "A conversion that could silently lose information.")
    OUT_OF_RANGE = ("out-of-range", "A value that can never fit.")
    TOO_LARGE = ("too-large", "An expression or mapping that is too large for the router.")

    @property
    def severity(self) -> Severity:
        return Severity.WARNING if self in _WARNINGS else Severity.ERROR


_WARNINGS = frozenset(
    {
        Code.UNUSED_PROTO,
        Code.UNUSED_OPTION,
        Code.UNCOVERED_PAYLOAD_CASE,
        Code.UNUSED_LISTENER,
        Code.NOT_LOCKED,
        Code.NO_DEADMAN,
        Code.DOUBTFUL_DEADMAN,
        Code.NO_TTL,
        Code.EMPTY_FIELD,
        Code.UNUSED_SET,
        Code.CUT_EXPRESSION,
    }
)


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """A finding: its position and kind, what is wrong, and what to do about it."""

    span: SourceSpan
    code: Code
    message: str
    hint: str = ""

    @property
    def severity(self) -> Severity:
        return self.code.severity

    def __str__(self) -> str:
        """Return the one-line form, `file:line:column: severity[code]: what; hint`."""
        hint = f"; {self.hint}" if self.hint else ""
        return f"{self.span}: {self.severity.value}[{self.code.value}]: {self.message}{hint}"


class RouterError(Exception):
    """Base class of all exceptions that this package raises on purpose."""


class TableError(RouterError):
    """The route table, or something that it refers to, is invalid. Carries all findings."""

    def __init__(self, diagnostics: Sequence[Diagnostic]) -> None:
        super().__init__("\n".join(map(str, diagnostics)))
        self.diagnostics = tuple(diagnostics)

    @classmethod
    def of(cls, span: SourceSpan, code: Code, message: str, hint: str = "") -> TableError:
        """Return an error with one finding."""
        return cls([Diagnostic(span, code, message, hint)])


class FindingError(RouterError):
    """Ends the check of one part of a table with a finding."""

    def __init__(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        self.diagnostic = Diagnostic(span, code, message, hint)
        super().__init__(str(self.diagnostic))


class OperatorError(RouterError):
    """An error that an operator can fix: `what` says in one line what is wrong and why, `hint` what to do about it."""

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what, hint)
        self.what = what
        self.hint = hint

    def __str__(self) -> str:
        """Return the one-line form, `what; hint`."""
        return f"{self.what}; {self.hint}" if self.hint else self.what


class UsageError(OperatorError):
    """The operator's request cannot be carried out."""


class StartError(OperatorError):
    """Something that the router needs cannot be opened now; a later attempt may succeed."""


class ConfigurationError(StartError):
    """A file, an argument or the environment must be corrected first: no attempt succeeds until then."""


class DecodeError(RouterError):
    """Invalid data from a sender: a datagram that is not an envelope, or a payload that is not of its type."""


class MappingError(RouterError):
    """The result of a mapping for one message does not exist, or does not fit the target."""


class TransportError(OperatorError):
    """A network failure, for example a datagram that cannot be sent, or a router that does not answer."""


def shown_path(path: Path) -> str:
    """Return a path as findings show it: relative to the working directory if the path is inside it."""
    absolute = path.absolute()
    try:
        return str(absolute.relative_to(Path.cwd()))
    except ValueError:
        return str(absolute)


def nearest_path(path: Path) -> Path | None:
    """Return the file or folder that a missing path most likely stands for: a sibling with a similar name, or None.

    Between files of one kind, such as `*.yaml`, only what is before the suffix counts.
    """
    try:
        siblings = [other for other in path.parent.iterdir() if other != path]
    except OSError:
        return None
    alike = {other.stem: other for other in siblings if path.suffix and other.suffix == path.suffix}
    if near := nearest(path.stem, alike):
        return alike[near]
    near = nearest(path.name, (other.name for other in siblings), _OTHER_KIND if path.suffix else 0.6)
    return path.with_name(near) if near and near not in {other.name for other in alike.values()} else None


_OTHER_KIND = 0.85
"""Similarity required of a file with another suffix: `rover.ymal` is `rover.yaml`, `rover.mcap` is not."""


def plural(count: int, noun: str) -> str:
    """Return `1 error`, `2 errors`."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def did_you_mean_file(written: str, path: Path) -> str:
    """Return a hint for a missing `path`, spelled like `written`; empty if no sibling has a similar name."""
    near = nearest_path(path)
    return f"did you mean '{written.removesuffix(path.name)}{near.name}'?" if near else ""


def nearest(name: str, known: Iterable[str], closeness: float = 0.6) -> str | None:
    """Return the known name that `name` most likely stands for, or None.

    With a `closeness` of 1, the two may differ only in case and in a prefix that all known names share. Otherwise,
    names with the same words in another order are similar, and that prefix does not count: `MODE_X` is not similar to
    `MODE_A`.
    """
    folded = {candidate.lower(): candidate for candidate in sorted(set(known))}
    words = sorted(name.lower().split("_"))
    if closeness < 1 and (same := [each for each in folded if sorted(each.split("_")) == words]):
        return folded[same[0]]
    start = _common_start(folded)
    wanted = name.lower().removeprefix(start)
    ends = {candidate.removeprefix(start): full for candidate, full in folded.items()}
    if not name.lower().startswith(start) and wanted not in ends:
        start, ends = "", folded
    found = {candidate: _likeness(candidate, wanted) for candidate in ends}
    best = max(found.values(), default=0.0)
    if best >= closeness or (start and closeness < 1 and best > _HALF):
        return ends[min(each for each, likeness in found.items() if likeness == best)]
    longer = [candidate for candidate in ends if len(wanted) >= _SHORTEST and candidate.startswith(wanted)]
    return ends[longer[0]] if len(longer) == 1 and closeness < 1 else None


_HALF = 0.5
"""Similarity that names must exceed without their shared prefix: in `MODE_OM`, one of two letters is right."""
_SHORTEST = 3
"""Minimum length at which the beginning of a name can stand for the whole name."""


def _likeness(known: str, wanted: str) -> float:
    """Return the similarity, 0 to 1, slightly raised if both begin alike or have the same letters."""
    ratio = difflib.SequenceMatcher(a=known, b=wanted).ratio()
    alike = next((at for at, pair in enumerate(zip(known, wanted, strict=False)) if len({*pair}) > 1), len(wanted))
    return ratio + (1 - ratio) * (min(alike, 4) * 0.1 + (sorted(known) == sorted(wanted)) * 0.1)


def _common_start(names: Collection[str]) -> str:
    """Return the whole words that all of several names begin with, such as `board_mode_`; empty if there are none."""
    if len(names) <= 1:
        return ""
    first, last = min(names), max(names)
    same = next((at for at, pair in enumerate(zip(first, last, strict=False)) if len({*pair}) > 1), len(first))
    found = re.match(r".*[\W_]", first[:same])
    return found[0] if found else ""


def did_you_mean(name: str, known: Iterable[str], closeness: float = 0.6) -> str:
    """Return a hint for a name that does not exist: the most similar known one, else a short list, else nothing."""
    candidates = sorted(set(known))
    if close := nearest(name, candidates, closeness):
        return f"did you mean '{close}'?"
    if not candidates:
        return ""
    shown = ", ".join(candidates[:8])
    return f"known: {shown}" + (f" and {len(candidates) - 8} more" if len(candidates) > 8 else "")


MOST_MEANT = 3
"""Maximum number of names in a hint."""


def one_of(names: Sequence[str]) -> str:
    """Return a hint that offers several names; empty if there are none."""
    quoted = [f"'{name}'" for name in names[:MOST_MEANT]]
    if not quoted:
        return ""
    return f"did you mean {listed([*quoted, 'another one'] if len(names) > MOST_MEANT else quoted, 'or')}?"


def listed(names: Sequence[str], conjunction: str = "and") -> str:
    """Return the names as in a sentence: `a, b and c`."""
    *others, last = names
    return f"{', '.join(others)} {conjunction} {last}" if others else last
