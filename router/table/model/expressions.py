"""Expressions and the fields that they fill, as texts that are not yet parsed."""

from dataclasses import dataclass

from router.errors import Located, SourceSpan
from router.table.nodes import TextSpan


@dataclass(frozen=True, slots=True)
class Expression:
    """The text of an expression, not yet parsed.

    `text_span` has the position of each character. A YAML sequence becomes `items`, a mapping with the key `map`
    becomes `choices`, and another mapping, an element of a list of messages, becomes `fields`; these have empty text.
    `literal` text, `{text: imu_link}`, is not an expression.
    """

    text: str
    text_span: TextSpan
    items: "tuple[Expression, ...] | None" = None
    choices: "Choices | None" = None
    literal: bool = False
    fields: "FieldMap | None" = None

    @property
    def span(self) -> SourceSpan:
        return self.text_span.whole

    def __str__(self) -> str:
        if self.choices is not None:
            return str(self.choices)
        if self.fields is not None:
            return str(self.fields)
        if self.literal:
            return repr(self.text)
        return self.text if self.items is None else f"[{', '.join(map(str, self.items))}]"


@dataclass(frozen=True, slots=True)
class Choices:
    """`{map: fix_quality, GPS_FIX: 1, else: 0}`: the value of `subject` selects one of `values` by name."""

    subject: Expression
    values: tuple[tuple[Located[str], Expression], ...]
    otherwise: Expression | None

    def __str__(self) -> str:
        parts = [f"map: {self.subject}", *(f"{name.value}: {value}" for name, value in self.values)]
        parts += [f"else: {self.otherwise}"] if self.otherwise is not None else []
        return f"{{{', '.join(parts)}}}"


@dataclass(frozen=True, slots=True)
class Elements:
    """`{each: detections, fields: {x: x / 1000}}`: each message of the list `source` fills one of the target's list."""

    source: Expression
    fields: "FieldMap"

    @property
    def span(self) -> SourceSpan:
        return self.source.span

    def __str__(self) -> str:
        return f"{{each: {self.source}, fields: {self.fields}}}"


@dataclass(frozen=True, slots=True)
class FieldEntry:
    """`linear_acceleration: {x: accel_x}` has the path ("linear_acceleration", "x"); dotted keys are split.

    `path_spans` has the span of each part of the path.
    """

    path: tuple[str, ...]
    path_spans: tuple[SourceSpan, ...]
    value: Expression | Elements


@dataclass(frozen=True, slots=True)
class FieldMap:
    """How the target is filled: 'auto' for fields of the same name on both sides, or each field with its expression.
    The entry 'auto: true' adds the fields of the same name that are not listed. Default: 'auto', if every field of the
    ROS message has a field of the same name on the other side.

    `span` is that of the value. `fields: auto`, or `auto: true` among the entries, sets `auto`. Entries take
    precedence.

    Title: Fields
    Error: must be 'auto' or a mapping of fields to expressions
    """

    span: SourceSpan
    auto: bool
    entries: tuple[FieldEntry, ...]

    def __str__(self) -> str:
        """Return the text of a table: `{brake: true}`."""
        entries = ["auto"] if self.auto else []
        entries += [f"{'.'.join(entry.path)}: {entry.value}" for entry in self.entries]
        return f"{{{', '.join(entries)}}}"
