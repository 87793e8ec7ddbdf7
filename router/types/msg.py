"""Parser of the ROS interface language: from the text of one `.msg` file to fields and constants.

References to other messages are not resolved here. Quotes, escapes and ranges of constants and default values follow
rosidl_adapter, the parser that ROS builds its interfaces with. The parser of rosbags drops default values and treats
`wstring` as a message.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

PRIMITIVES: dict[str, Type] = {
    "bool": Bool(),
    "byte": Int(8, signed=False, octet=True),
    "char": Int(8, signed=False),
    **{f"{'' if signed else 'u'}int{bits}": Int(bits, signed) for bits in (8, 16, 32, 64) for signed in (True, False)},
    "float32": Float(32),
    "float64": Float(64),
    "string": String(),
    "wstring": String(wide=True),
}

_TYPE = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)"
    r"(?:<=(?P<string_bound>[1-9][0-9]{0,8}))?"
    r"(?P<array>\[(?:(?P<length>[1-9][0-9]{0,8})|<=(?P<bound>[1-9][0-9]{0,8}))?\])?"
)
_MESSAGE_NAME = re.compile(r"(?:(?P<package>[a-z](?:_?[a-z0-9])*)/)?(?P<name>[A-Z][A-Za-z0-9]*)")
_FIELD_NAME = re.compile(r"[a-z](?:_?[a-z0-9])*")
_CONSTANT_NAME = re.compile(r"[A-Z](?:_?[A-Z0-9])*")


class MsgError(ValueError):
    """A mistake in one line; `line`, `column` and `end_column` as in SourceSpan."""

    def __init__(self, message: str, line: int, column: int, end_column: int) -> None:
        super().__init__(message)
        self.message = message
        self.line = line
        self.column = column
        self.end_column = end_column


@dataclass(frozen=True, slots=True)
class MsgDefinition:
    """Fields and constants as declared. A field of another message has a MessageType of its name, without fields.

    `lines` are the line numbers of the fields, by name.
    """

    fields: tuple[Field, ...]
    constants: Mapping[str, object]
    lines: Mapping[str, int]


def parse_msg(package: str, text: str) -> MsgDefinition:
    """Parse `text`; names without a package belong to `package`. Raises MsgError at the first mistake."""
    fields: dict[str, Field] = {}
    lines: dict[str, int] = {}
    constants: dict[str, object] = {}
    comments: list[str] = []
    header = True
    last: Field | None = None
    for number, raw in enumerate(text.splitlines(), start=1):
        code, sign, comment = raw.partition("#")
        header = header and raw.startswith("#")
        if not code.strip():
            if code and sign and last is not None:  # an indented comment continues the line above
                last = fields[last.name] = replace(last, comment=_one_line(last.comment, comment))
            else:  # comments above a declaration belong to it, except the file's first block
                comments = [*comments, comment] if sign and not header else []
            continue
        line = _Line(number, code.replace("\t", " "))
        if line.is_constant:
            last = None
            name, value = line.constant()
            _refuse_second(name, constants, line)
            constants[name] = value
        else:
            last = line.field(package, _one_line(*comments, comment))
            _refuse_second(last.name, fields, line)
            fields[last.name] = last
            lines[last.name] = number
        comments = []
    return MsgDefinition(tuple(fields.values()), constants, lines)


def _one_line(*comments: str) -> str:
    return " ".join(" ".join(comments).replace("#", " ").split())


def _refuse_second(name: str, known: Mapping[str, object], line: _Line) -> None:
    if name in known:
        raise line.error(f"'{name}' is declared twice", name)


class _Line:
    """One declaration without its comment: `type name`, `type name default` or `type NAME=value`."""

    def __init__(self, number: int, text: str) -> None:
        self._number = number
        self._text = text
        self._type, _, rest = text.strip().partition(" ")
        self._rest = rest.strip()
        if not self._rest:
            raise self.error(f"no name after '{self._type}'", self._type)

    @property
    def is_constant(self) -> bool:
        return "=" in self._rest

    def error(self, message: str, blamed: str) -> MsgError:
        """Return an error at `blamed`, a part of the line's text."""
        start = max(self._text.find(blamed), 0)
        return MsgError(message, self._number, start + 1, start + 1 + max(len(blamed), 1))

    def constant(self) -> tuple[str, object]:
        name, _, text = (part.strip() for part in self._rest.partition("="))
        if not _CONSTANT_NAME.fullmatch(name):
            raise self.error(f"'{name}' is not a valid constant name; write it in upper case", name)
        type_ = PRIMITIVES.get(self._type)
        if type_ is None:
            raise self.error(f"a constant cannot be of type {self._type}", self._type)
        return name, self._value(type_, text)

    def field(self, package: str, comment: str) -> Field:
        name, _, text = self._rest.partition(" ")
        text = text.strip()
        if not _FIELD_NAME.fullmatch(name):
            raise self.error(f"'{name}' is not a valid field name; write it in lower case", name)
        declared = self._field_type(package)
        element = declared.element if isinstance(declared, List) else declared
        if text and isinstance(element, MessageType):
            short = element.name.replace("/msg/", "/")
            raise self.error(f"a field of type {short} takes no default value", text)
        default = self._value(declared, text) if text else None
        return Field(name, declared, default=None if is_zero(default) else default, comment=comment)

    def _value(self, type_: Type, text: str) -> object:
        try:
            return parse_value(type_, text)
        except ValueError as error:
            raise self.error(str(error), text) from None

    def _field_type(self, package: str) -> Type:
        parts = _TYPE.fullmatch(self._type)
        if parts is None:
            raise self.error(f"'{self._type}' is not a type", self._type)
        element = PRIMITIVES.get(parts["base"])
        if isinstance(element, String):
            element = String(_number(parts["string_bound"]), element.wide)
        elif parts["string_bound"]:
            raise self.error(f"'{self._type}' is not a type; only strings have a bound", self._type)
        elif element is None:
            named = _MESSAGE_NAME.fullmatch(parts["base"])
            if named is None:
                raise self.error(f"'{self._type}' is not a type", self._type)
            element = MessageType(f"{named['package'] or package}/msg/{named['name']}")
        return List(element, _number(parts["length"]), _number(parts["bound"])) if parts["array"] else element


def _number(digits: str | None) -> int | None:
    return int(digits) if digits else None


_TRUTH = {"true": True, "1": True, "false": False, "0": False}
_ELEMENT = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'|[^,]*)\s*(,|$)""")


def parse_value(type_: Type, text: str) -> object:
    """Parse a value, a list as a tuple. Raises ValueError with the text of the finding."""
    if isinstance(type_, List):
        return _parse_list(type_, text)
    if isinstance(type_, Bool):
        if text.lower() not in _TRUTH:
            raise ValueError(f"'{text}' is neither true nor false")
        return _TRUTH[text.lower()]
    if isinstance(type_, Int):
        return _parse_integer(type_, text)
    if isinstance(type_, Float):
        try:
            return float(text)
        except ValueError:
            raise ValueError(f"'{text}' is not a number") from None
    if isinstance(type_, String):
        return _parse_string(type_, text)
    raise ValueError(f"a field of type {type_} takes no default value")


def is_zero(value: object) -> bool:
    """Return whether a value is the default of its type."""
    if isinstance(value, tuple):
        return all(map(is_zero, value))
    if isinstance(value, float):
        return value == 0 and math.copysign(1, value) > 0
    return not value


def _parse_integer(type_: Int, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        try:
            value = int(text, 0)
        except ValueError:
            raise ValueError(f"'{text}' is not an integer") from None
    if not type_.low <= value <= type_.high:
        raise ValueError(f"{text} is outside the range of {type_}, {type_.low} to {type_.high}")
    return value


def _parse_string(type_: String, text: str) -> str:
    for quote in "\"'":
        if len(text) > 1 and text.startswith(quote) and text.endswith(quote):
            text = text[1:-1]
            if re.search(rf"(?<!\\){quote}", text):
                raise ValueError(f"a quote inside the string needs a backslash: {text}")
            text = text.replace(f"\\{quote}", quote)
            break
    if type_.bound is not None and len(text) > type_.bound:
        raise ValueError(f"'{text}' is longer than {type_.bound} characters")
    return text


def _parse_list(type_: List, text: str) -> tuple[object, ...]:
    if not (len(text) > 1 and text.startswith("[") and text.endswith("]")):
        raise ValueError(f"'{text}' is not a list; write [1, 2]")
    inner = text[1:-1].strip()
    items = []
    at = 0
    while at < len(inner):
        element = _ELEMENT.match(inner, at)
        if element is None or not element[1]:
            raise ValueError(f"'{text}' is not a list of {type_.element}")
        item = parse_value(type_.element, element[1].rstrip())
        items.append(item.strip() if isinstance(item, str) else item)  # even inside quotes, like rosidl_adapter
        at = element.end()
    if type_.length is not None and len(items) != type_.length:
        raise ValueError(f"the array has {type_.length} elements, but its default has {len(items)}")
    if type_.bound is not None and len(items) > type_.bound:
        raise ValueError(f"the list has at most {type_.bound} elements, but its default has {len(items)}")
    return tuple(items)
