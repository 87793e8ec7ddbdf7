"""The ROS interface language: the text of one `.msg` file becomes fields and constants.

Knows one file at a time: other messages stay names here, `ros` resolves them. rosbags has such a parser
too, but it drops default values and takes `wstring` for a message.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from router.types.model import Bool, Float, Int, List, String, Type
from router.types.msg_values import is_zero, parse_value

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
    """What is wrong with one line; `line`, `column` and `end_column` as in SourceSpan."""

    def __init__(self, message: str, line: int, column: int, end_column: int) -> None:
        super().__init__(message)
        self.message = message
        self.line = line
        self.column = column
        self.end_column = end_column


@dataclass(frozen=True, slots=True)
class NamedType:
    """Another message, as `package/Name`, not yet looked up."""

    name: str


@dataclass(frozen=True, slots=True)
class Shape:
    """An array of something: of a fixed `length`, of at most `bound` elements, or of any number."""

    length: int | None = None
    bound: int | None = None


@dataclass(frozen=True, slots=True)
class MsgField:
    """A field as declared. `shape` is None for a single value, `default` None for the type's zero."""

    name: str
    element: Type | NamedType
    shape: Shape | None = None
    default: object = None
    comment: str = ""
    line: int = 1


@dataclass(frozen=True, slots=True)
class MsgDefinition:
    fields: tuple[MsgField, ...]
    constants: dict[str, object]


def parse_msg(package: str, text: str) -> MsgDefinition:
    """The definition in `text`; names without a package are of `package`. Raises MsgError at the first fault."""
    fields: dict[str, MsgField] = {}
    constants: dict[str, object] = {}
    comments: list[str] = []
    header = True
    last: MsgField | None = None
    for number, raw in enumerate(text.splitlines(), start=1):
        code, sign, comment = raw.partition("#")
        header = header and raw.startswith("#")
        if not code.strip():
            if code and sign and last is not None:  # an indented comment goes on with the line above
                last = fields[last.name] = replace(last, comment=_one_line(last.comment, comment))
            else:  # what is above a declaration belongs to it, but for the file's first block
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
        comments = []
    return MsgDefinition(tuple(fields.values()), constants)


def _one_line(*comments: str) -> str:
    return " ".join(" ".join(comments).replace("#", " ").split())


def _refuse_second(name: str, known: dict[str, MsgField] | dict[str, object], line: _Line) -> None:
    if name in known:
        raise line.error(f"there are two '{name}'", name)


class _Line:
    """One declaration: `type name`, `type name default` or `type NAME=value`, comment already cut off."""

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
        """An error at `blamed`, a stretch of the line's text."""
        start = max(self._text.find(blamed), 0)
        return MsgError(message, self._number, start + 1, start + 1 + max(len(blamed), 1))

    def constant(self) -> tuple[str, object]:
        name, _, text = (part.strip() for part in self._rest.partition("="))
        if not _CONSTANT_NAME.fullmatch(name):
            raise self.error(f"'{name}' is no name for a constant; write it in upper case", name)
        type_ = PRIMITIVES.get(self._type)
        if type_ is None:
            raise self.error(f"a constant cannot be of type {self._type}", self._type)
        return name, self._value(type_, text)

    def field(self, package: str, comment: str) -> MsgField:
        name, _, text = self._rest.partition(" ")
        text = text.strip()
        if not _FIELD_NAME.fullmatch(name):
            raise self.error(f"'{name}' is no name for a field; ROS wants lower case", name)
        element, shape = self._field_type(package)
        default = None
        if text:
            if isinstance(element, NamedType):
                raise self.error(f"a field of type {element.name} takes no default value", text)
            default = self._value(List(element, shape.length, shape.bound) if shape else element, text)
        return MsgField(name, element, shape, None if is_zero(default) else default, comment, self._number)

    def _value(self, type_: Type, text: str) -> object:
        try:
            return parse_value(type_, text)
        except ValueError as error:
            raise self.error(str(error), text) from None

    def _field_type(self, package: str) -> tuple[Type | NamedType, Shape | None]:
        declared = _TYPE.fullmatch(self._type)
        if declared is None:
            raise self.error(f"'{self._type}' is no type", self._type)
        shape = Shape(_number(declared["length"]), _number(declared["bound"])) if declared["array"] else None
        element = PRIMITIVES.get(declared["base"])
        if isinstance(element, String):
            return String(_number(declared["string_bound"]), element.wide), shape
        if declared["string_bound"]:
            raise self.error(f"'{self._type}' is no type; only strings have a bound of their own", self._type)
        if element is not None:
            return element, shape
        named = _MESSAGE_NAME.fullmatch(declared["base"])
        if named is None:
            raise self.error(f"'{self._type}' is no type", self._type)
        return NamedType(f"{named['package'] or package}/{named['name']}"), shape


def _number(digits: str | None) -> int | None:
    return int(digits) if digits else None
