"""Messages between CDR bytes and JSON text, by functions that are generated for each message type.

`encoder` makes functions from CDR to JSON: the code reads the CDR fields in declared order and builds dictionaries with
sorted keys, which orjson writes. `decoder` makes functions from JSON to CDR: msgspec checks and reads the text into
Structs, and generated code writes their fields.
"""

from __future__ import annotations

import linecache
import struct
from collections.abc import Callable, Sequence
from itertools import count
from typing import Annotated, Any, NoReturn

import msgspec
import numpy as np
import orjson

from router.compiler.cdr import write_message
from router.compiler.cdr.primitives import CDR_LE, scalar_format
from router.compiler.cdr.reading import LENGTH, Loop, ReadingCode, Step, Stretch, Take
from router.compiler.expressions.kinds import IntKind, StringKind, kind_of
from router.compiler.expressions.tree import Call, Constant, Element, Node, Read, Variable
from router.compiler.namespace import NAMESPACE
from router.compiler.plan import Each, Leaf, Plan, Record
from router.compiler.source import Source
from router.errors import MappingError, SourceSpan
from router.gateway.json_types import PLACEHOLDER, Style
from router.types.model import Bool, Field, Float, Int, List, MessageType, String, Type

Encode = Callable[[bytes], bytes]
"""From CDR bytes with their header to UTF-8 JSON. Raises UnreadableError."""
Decode = Callable[[bytes], bytes]
"""From UTF-8 JSON to CDR bytes with their header. Raises InvalidMessageError."""


class UnreadableError(ValueError):
    """The bytes are no message of the type, or hold text that is no Unicode."""


class InvalidMessageError(ValueError):
    """A client's text is no JSON, or no message of the type. The text of the error is short and printable."""


def _function(out: Source, name: str, file: str, namespace: dict[str, object]) -> Any:
    """Compile `out`, which defines the function `name`. Tracebacks show its lines as those of `file`."""
    text = out.text()
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    scope = {**namespace, **out.constants}
    exec(compile(text, file, "exec"), scope)  # noqa: S102 - generated here; names are rosidl's identifiers
    return scope[name]


# -- CDR to JSON ------------------------------------------------------------------------------------------------------

_SHORT = 64
"""Elements up to which `struct` is faster than an array of numpy."""
_CHUNK = 4096
"""Elements in one call of orjson, which holds the interpreter lock: other threads run in between."""
_NUMPY = orjson.OPT_SERIALIZE_NUMPY
_LARGEST_UNIT = 0xFFFF


def encoder(message: MessageType, style: Style) -> Encode:
    """A function that writes messages of this type as JSON. Bytes behind the message are ignored: middlewares pad."""
    file = f"<json of {message.name}>"
    span = SourceSpan(file)
    out = Source()
    steps, expression = _Reading(style, out).message(message)
    with out.block("def encode(cdr):", span):
        with out.block("try:", span):
            with out.block("if cdr[:2] != CDR_LE:", span):
                out.line("refuse(cdr[:2])", span)
            code = ReadingCode(out, span)
            code.write(steps)
            if not code.is_checked:
                with out.block("if at > len(cdr):", span):
                    out.line("cut_off(cdr)", span)
            out.line(f"return dumps({expression}, None, NUMPY)", span)
        with out.block("except DAMAGED as error:", span):
            out.line("raise UnreadableError(str(error)) from error", span)
    function: Encode = _function(out, "encode", file, _ENCODING)
    return function


class _Reading:
    """The steps that read a message, and the expression that is its value for orjson once they are done."""

    def __init__(self, style: Style, out: Source) -> None:
        self._is_wrapped = style is Style.WRAPPED
        self._out = out
        self._numbers = count(1)

    def message(self, message: MessageType) -> tuple[list[Step], str]:
        steps: list[Step] = []
        members: dict[str, str] = {}
        for field in message.fields or (PLACEHOLDER,):
            of_field, expression = self._value(field.type)
            steps += of_field
            is_bare = isinstance(field.type, List) or not self._is_wrapped
            members[field.name] = expression if is_bare else f"({expression},)"
        return steps, "{" + ", ".join(f"{name!r}: {members[name]}" for name in sorted(members)) + "}"

    def _value(self, declared: Type) -> tuple[list[Step], str]:
        match declared:
            case MessageType():
                return self.message(declared)
            case List():
                return self._list(declared)
            case String():
                variable = self._variable()
                convert = "text" if not declared.wide else "wide_units" if self._is_wrapped else "wide_text"
                return [LENGTH, Stretch(4 if declared.wide else 1, variable)], f"{convert}({variable})"
            case _:
                variable, letter = self._variable(), scalar_format(declared)
                return [Take(letter, struct.calcsize(letter), variable)], variable

    def _list(self, declared: List) -> tuple[list[Step], str]:
        length: list[Step] = [LENGTH] if declared.length is None else []
        variable = self._variable()
        if isinstance(declared.element, (MessageType, String)):
            body, element = self._value(declared.element)
            return [*length, Loop(declared.length, tuple(body), element, variable)], f"in_chunks({variable})"
        letter = scalar_format(declared.element)
        size = struct.calcsize(letter)
        if declared.length is None:
            return [LENGTH, Stretch(size, variable)], f"{_SEQUENCES[letter]}({variable})"
        steps: list[Step] = [Take(f"{declared.length * size}s", size, variable)]
        if declared.length > _SHORT:
            return steps, f"{_SEQUENCES[letter]}({variable})"
        unpack = self._out.constant("unpack_array", struct.Struct(f"<{declared.length}{letter}").unpack)
        return steps, f"{unpack}({variable})"

    def _variable(self) -> str:
        return f"v{next(self._numbers)}"


def _refuse(representation: bytes) -> NoReturn:
    raise UnreadableError(f"the message begins with 0x{representation.hex()}, which is not CDR_LE")


def _cut_off(cdr: bytes) -> NoReturn:
    raise UnreadableError(f"the message ends after {len(cdr)} bytes, within a string or list")


def _text(data: bytes) -> str:
    """A string from its bytes. The final NUL may be missing, as Fast CDR takes it."""
    return data.removesuffix(b"\0").decode()


def _units(data: bytes) -> Any:
    """The UTF-16 units of a wstring, which has 32 bits for each."""
    units = np.frombuffer(data, "<u4")
    if len(units) and units.max() > _LARGEST_UNIT:
        raise UnreadableError("a wstring has units that are no UTF-16")
    return units


def _wide_units(data: bytes) -> Any:
    return _in_chunks(_units(data))


def _wide_text(data: bytes) -> str:
    text: str = _units(data).astype("<u2").tobytes().decode("utf-16-le")
    return text


def _in_chunks(values: Any) -> Any:
    """What orjson writes as the list `values`. Long lists are written here, a chunk at a time."""
    if len(values) <= _CHUNK:
        return values
    chunks = (values[start : start + _CHUNK] for start in range(0, len(values), _CHUNK))
    return orjson.Fragment(b"[" + b",".join([orjson.dumps(chunk, None, _NUMPY)[1:-1] for chunk in chunks]) + b"]")


def _sequence(letter: str) -> Callable[[bytes], Any]:
    """A function from the bytes of a list of scalars to what orjson writes."""
    size = struct.calcsize(letter)

    def sequence(data: bytes) -> Any:
        number = len(data) // size
        if number <= _SHORT:
            return struct.unpack(f"<{number}{letter}", data)
        values = np.frombuffer(data, f"<{letter}" if letter != "?" else "u1")
        # orjson would write the shortest text that is the same float32, and clients read doubles.
        return _in_chunks(values.astype("<f8") if letter == "f" else values != 0 if letter == "?" else values)

    return sequence


_SEQUENCES = {"?": "bools", "b": "int8s", "B": "uint8s", "h": "int16s", "H": "uint16s", "i": "int32s", "I": "uint32s",
              "q": "int64s", "Q": "uint64s", "f": "float32s", "d": "float64s"}  # fmt: skip
_ENCODING: dict[str, object] = {
    "CDR_LE": CDR_LE,
    "DAMAGED": (struct.error, ValueError),
    "NUMPY": _NUMPY,
    "UnreadableError": UnreadableError,
    "cut_off": _cut_off,
    "dumps": orjson.dumps,
    "in_chunks": _in_chunks,
    "refuse": _refuse,
    "text": _text,
    "wide_text": _wide_text,
    "wide_units": _wide_units,
    **{name: _sequence(letter) for letter, name in _SEQUENCES.items()},
}

# -- JSON to CDR ------------------------------------------------------------------------------------------------------

_LARGEST_FLOAT32 = 3.4028235677973362e38
"""The largest double that a float32 can hold once it is rounded."""
_BEGIN, _END = 70, 50
"""Characters of an error's text that are shown when it is long: what is wrong, and where."""


def decoder(message: MessageType, style: Style) -> Decode:
    """A function that reads messages of this type. Every field must be there and no other, each of its type and range.

    Nothing is converted: 3.0 is no integer, and 1 is no bool. An integer is a float where one is wanted.
    """
    file = f"<message from json of {message.name}>"
    span = SourceSpan(file)
    writing = _Writing(style, span)
    read: Callable[[bytes], Any] = msgspec.json.Decoder(writing.struct(message)).decode
    out = Source()
    with out.block("def write(it):", span):
        out.line(f"return {write_message(out, writing.whole(message, 'it'), 'message')}", span)
    write = _function(out, "write", file, _DECODING)

    def decode(text: bytes) -> bytes:
        try:
            return bytes(write(read(text)))
        except (msgspec.DecodeError, UnicodeError, RecursionError, MappingError, struct.error) as error:
            raise InvalidMessageError(shown(str(error))) from None

    return decode


def shown(text: str) -> str:
    """A text that may repeat what a client sent, cut short and safe in a line of a log."""
    text = ascii(text)[1:-1]
    return text if len(text) <= _BEGIN + _END else f"{text[:_BEGIN]}...{text[-_END:]}"


class _Writing:
    """The Structs that msgspec reads messages into, and plans that write their fields."""

    def __init__(self, style: Style, span: SourceSpan) -> None:
        self._is_wrapped = style is Style.WRAPPED
        self._span = span
        self._structs: dict[MessageType, type] = {}
        self._items = count(1)

    def struct(self, message: MessageType) -> type:
        """The Struct of a message. Its attributes are `f0`, `f1` ..., since fields may be called as Python keywords."""
        if (made := self._structs.get(message)) is None:
            fields = message.fields or (PLACEHOLDER,)
            members: list[Any] = [(f"f{index}", self._field(field.type)) for index, field in enumerate(fields)]
            if not message.fields:
                members = [(*members[0], (0,) if self._is_wrapped else 0)]
            made = self._structs[message] = msgspec.defstruct(
                message.short_name,
                members,
                rename={f"f{index}": field.name for index, field in enumerate(fields)},
                forbid_unknown_fields=True,
                frozen=True,
                gc=False,
            )
        return made

    def _field(self, declared: Type) -> Any:
        bare = self._bare(declared)
        return bare if isinstance(declared, List) or not self._is_wrapped else tuple[bare]  # type: ignore[valid-type]

    def _bare(self, declared: Type) -> Any:
        match declared:
            case MessageType():
                return self.struct(declared)
            case Bool():
                return bool
            case Int(bits=64, signed=False):  # msgspec has no bound above int64: `uint64` checks it
                return Annotated[int, msgspec.Meta(ge=0)]
            case Int():
                return Annotated[int, msgspec.Meta(ge=declared.low, le=declared.high)]
            case Float(bits=32):
                return Annotated[float, msgspec.Meta(ge=-_LARGEST_FLOAT32, le=_LARGEST_FLOAT32)]
            case Float():
                return float
            case String():
                if declared.wide and self._is_wrapped:
                    unit = Annotated[int, msgspec.Meta(ge=0, le=_LARGEST_UNIT)]
                    return Annotated[list[unit], msgspec.Meta(max_length=declared.bound)]
                return str
            case List():
                most = declared.bound if declared.length is None else declared.length
                element = self._bare(declared.element)
                return Annotated[list[element], msgspec.Meta(min_length=declared.length, max_length=most)]  # type: ignore[valid-type]
            case _:
                raise TypeError(f"ROS has no type {declared}")

    def whole(self, message: MessageType, variable: str) -> Record:
        """The plan of a message that is read from the Struct in a variable."""
        return self._record(message, Variable(kind_of(message), self._span, variable), "")

    def _record(self, message: MessageType, holder: Node, path: str) -> Record:
        """`path` names the message in errors."""
        members = []
        for index, field in enumerate(message.fields):
            value: Node = Read(kind_of(field.type), self._span, holder, Field(f"f{index}", field.type))
            if self._is_wrapped and not isinstance(field.type, List):
                value = Element(value.kind, self._span, value, 0)
            members.append((field, self._plan(field.type, value, f"{path}.{field.name}".lstrip("."))))
        return Record(message, tuple(members), self._span)

    def _plan(self, declared: Type, value: Node, path: str) -> Plan:
        match declared:
            case MessageType():
                return self._record(declared, value, path)
            case List():
                item = Variable(kind_of(declared.element), self._span, f"item{next(self._items)}")
                element = self._plan(declared.element, item, f"{path}[]")
                return Each(declared, ((item.name, value),), element, self._span)
            case String(wide=True) if self._is_wrapped:  # msgspec has checked its bound
                return Leaf(declared, self._checked("wide_text_of_units", value, path), self._span)
            case String():
                check = "wide_text" if declared.wide else "text"
                return Leaf(declared, self._checked(check, value, path, declared.bound), self._span)
            case Int(bits=64, signed=False):
                return Leaf(declared, self._checked("uint64", value, path), self._span)
            case _:
                return Leaf(declared, value, self._span)

    def _checked(self, check: str, value: Node, path: str, bound: int | None = None) -> Node:
        """The call of one of the functions below; without a bound where there is none."""
        given = [Constant(StringKind(), self._span, path)]
        if bound is not None:
            given.append(Constant(IntKind(bound, bound), self._span, bound))
        return Call(value.kind, self._span, f"checked_{check}", (value, *given))


def _checked_text(value: str, path: str, bound: int | None = None) -> str:
    if "\0" in value:
        raise InvalidMessageError(f"{path}: a string of ROS holds no NUL")
    if bound is not None and (size := len(value.encode())) > bound:
        raise InvalidMessageError(f"{path}: {size} bytes are more than {bound}")
    return value


def _checked_wide_text(value: str, path: str, bound: int | None = None) -> str:
    if bound is not None and (size := len(value.encode("utf-16-le")) // 2) > bound:
        raise InvalidMessageError(f"{path}: {size} characters are more than {bound}")
    return value


def _checked_wide_text_of_units(units: Sequence[int], path: str) -> str:
    try:
        return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")
    except UnicodeDecodeError:
        raise InvalidMessageError(f"{path}: the string has half of a surrogate pair") from None


def _checked_uint64(value: int, path: str) -> int:
    if value >> 64:
        raise InvalidMessageError(f"{path}: {value} is outside of uint64")
    return value


_DECODING: dict[str, object] = {
    **NAMESPACE,
    "checked_text": _checked_text,
    "checked_wide_text": _checked_wide_text,
    "checked_wide_text_of_units": _checked_wide_text_of_units,
    "checked_uint64": _checked_uint64,
}
