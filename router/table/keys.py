"""Keys of a table. Each is declared once, as a field of a class in `model`.

The field's name, type and default are those of the key. Marks in `Annotated` add to the type, and a docstring after the
field describes the key:

    max_rate: Annotated[float | None, RATE, Words("at most {}")] = None

A `Quantity` parses and prints a number with a unit; the other marks are below. `build` reads objects according to these
declarations, `flat` and `phrases` print them, and `grammar` makes the schema of them.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from types import UnionType
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from router.errors import Located, SourceSpan
from router.table.nodes import TextSpan
from router.table.units import Quantity

T = TypeVar("T")


class Named(str):
    """The name of a key whose field is named differently. Dots separate nested keys."""

    __slots__ = ()


class Shape(str):
    """Which values fit, if the type does not say it: a definition of `grammar.values`."""

    __slots__ = ()


class OneOf(str):
    """The words that fit, with spaces between them."""

    __slots__ = ()


class Range(NamedTuple):
    """The smallest and the largest whole number that fit."""

    least: int
    most: int


class Listed(NamedTuple):
    """How long a list is at least, whether its items differ, and whether one item may be `alone`, without a list."""

    least: int = 0
    unique: bool = False
    alone: bool = False


SOME = Listed(least=1)


class Words(NamedTuple):
    """A phrase with `{}` for the key's value; used only if the key `beside` is also set."""

    text: str
    beside: str | None = None


@dataclass(frozen=True, slots=True)
class Key:
    """A key as its field declares it. `type` is the type of the value, or of an item if it `is_list`."""

    name: str
    attribute: str
    type: Any
    is_list: bool
    is_located: bool
    quantity: Quantity | None
    words: Words | None
    marks: Mapping[type, Any]
    default: Any

    def mark(self, kind: Callable[..., T]) -> T | None:
        """Return the mark of this class, None if there is none."""
        return self.marks.get(kind)

    def text(self, value: Any) -> str:
        """Return the value as it is written in a table."""
        if self.quantity is None:
            return _text(value)
        values = value if self.is_list else (value,)
        return ", ".join(self.quantity.show(each.value if isinstance(each, Located) else each) for each in values)


def _text(value: object) -> str:
    if isinstance(value, Located):
        return _text(value.value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, enum.Enum):
        return str(value.value)
    if type(value) is tuple:
        return ", ".join(map(_text, value))
    return str(value)


def keys_of(model: type) -> tuple[Key, ...]:
    """Return the keys that a model class declares."""
    if model not in _KEYS:
        hints = get_type_hints(model, include_extras=True)
        _KEYS[model] = tuple(_key(field, hints[field.name]) for field in fields(model) if field.name != "span")
    return _KEYS[model]


_KEYS: dict[type, tuple[Key, ...]] = {}


def _key(field: Field[Any], hint: Any) -> Key:
    marks: dict[type, Any] = {}
    if get_origin(hint) is Annotated:
        hint, *annotated = get_args(hint)
        marks = {type(mark): mark for mark in annotated}
    if get_origin(hint) in (Union, UnionType):
        hint = next(option for option in get_args(hint) if option is not type(None))
    if is_list := get_origin(hint) is tuple:
        hint = get_args(hint)[0]
    if is_located := get_origin(hint) is Located:
        (hint,) = get_args(hint)
    return Key(
        name=marks.get(Named, field.name),
        attribute=field.name,
        type=hint,
        is_list=is_list,
        is_located=is_located,
        quantity=marks.get(Quantity),
        words=marks.get(Words),
        marks=marks,
        default=None if field.default is MISSING else field.default,
    )


def phrases(part: Any) -> dict[str, str]:
    """Return the phrases of all keys that are set and have one: `at most 30 Hz` for `max_rate`."""
    words = {}
    for key in keys_of(type(part)):
        value = getattr(part, key.attribute)
        if key.words is None or value is None:
            continue
        if key.words.beside is None or getattr(part, key.words.beside) is not None:
            words[key.name] = key.words.text.format(key.text(value))
    return words


def flat(part: object) -> dict[str, str]:
    """Return every setting of a part of the table as text, by dotted key. Keys that are not set are omitted.

    For a mapping, return its values by name.
    """
    return dict(_flat(part, ""))


def _flat(part: object, prefix: str) -> Iterator[tuple[str, str]]:
    for name, value, show in _settings(part):
        if isinstance(value, Mapping) or _has_keys(value):
            yield from _flat(value, f"{prefix}{name}.")
        elif not isinstance(value, (SourceSpan, TextSpan)):
            yield prefix + name, show(value)


def _settings(part: object) -> Iterator[tuple[str, Any, Callable[[Any], str]]]:
    """Yield name, value and printer of every setting; None counts as set if it is not the default."""
    if isinstance(part, Mapping):
        yield from ((name, value, _text) for name, value in part.items() if value is not None)
        return
    for key in keys_of(type(part)):
        value = getattr(part, key.attribute)
        if value != () and (value is not None or key.default is not None):
            yield key.name, value, key.text


def _has_keys(value: object) -> bool:
    """Return whether the value is a part with keys, without its own `__str__`."""
    return is_dataclass(value) and not isinstance(value, Located) and type(value).__str__ is object.__str__


def are_same(one: object, other: object) -> bool:
    """Return whether two tables, or parts of them, have the same content, regardless of positions."""
    return _without_spans(one) == _without_spans(other)


def _without_spans(value: object) -> object:
    if isinstance(value, SourceSpan):
        return None
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), *(_without_spans(getattr(value, field.name)) for field in fields(value))
    if isinstance(value, Mapping):
        return tuple((key, _without_spans(member)) for key, member in value.items())
    if isinstance(value, (tuple, list)):
        return tuple(map(_without_spans, value))
    return value
