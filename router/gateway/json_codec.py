"""Converts messages between CDR and JSON, with generated functions for each message type.

`encoder` makes functions from CDR to JSON. Their code reads the CDR fields in declared order and builds dictionaries
with sorted keys, which orjson writes. `decoder` makes functions from JSON to CDR. msgspec checks the text and reads it
into Structs, whose fields are written one by one: clients send little.
"""

from __future__ import annotations

import linecache
import struct
from collections.abc import Callable, Sequence
from itertools import count
from typing import Annotated, Any, NoReturn, TypeVar

import msgspec
import orjson

from router.compiler.cdr import (
    CDR_LE,
    HEADER,
    put_length,
    put_numbers,
    put_text,
    put_wide_text,
    scalar_format,
)
from router.gateway.json_types import PLACEHOLDER, Style
from router.gateway.packets import PacketError
from router.types.model import Bool, Float, Int, List, MessageType, String, Type

T = TypeVar("T")

Encode = Callable[[bytes], bytes]
"""From CDR bytes with their header to UTF-8 JSON. Raises UnreadableError."""
Decode = Callable[[bytes], bytes]
"""From UTF-8 JSON to CDR bytes with their header. Raises InvalidMessageError, and PacketError if it is not JSON."""


class UnreadableError(ValueError):
    """The bytes are not a message of the type, or contain text that is not Unicode."""


class InvalidMessageError(ValueError):
    """A client's text is not JSON, or not a message of the type. The text of the error is short and printable."""


# -- CDR to JSON ------------------------------------------------------------------------------------------------------

_SHORT = 64
"""The longest list, in elements, for which `struct` is faster than a NumPy array."""
_CHUNK = 4096
"""Elements in one call of orjson, which holds the interpreter lock: other threads run between calls."""
_NUMPY = orjson.OPT_SERIALIZE_NUMPY
_LARGEST_UNIT = 0xFFFF


def encoder(message: MessageType, style: Style) -> Encode:
    """Make a function that writes messages of this type as JSON. It ignores trailing bytes: middlewares pad."""
    reading = _Reading(style)
    expression = reading.message(message)
    reading.unpack()
    text = _FUNCTION.format("\n".join(reading.lines), expression)
    file = f"<json of {message.name}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)  # for tracebacks
    scope: dict[str, Any] = {**_ENCODING, **reading.constants}
    exec(compile(text, file, "exec"), scope)  # noqa: S102 - generated here; names are rosidl's identifiers
    function: Encode = scope["encode"]
    return function


_FUNCTION = f"""\
def encode(cdr):
    try:
        if cdr[:2] != CDR_LE:
            refuse(cdr[:2])
        at = {len(HEADER)}
{{}}
        if at > len(cdr):
            cut_off(cdr)
        return dumps({{}}, None, NUMPY)
    except DAMAGED as error:
        raise UnreadableError(str(error)) from error
"""


class _Reading:
    """Generates lines that read a message from `cdr`, starting at offset `at`. Methods return expressions for orjson.

    Adjacent scalars are unpacked together. Their padding depends on the last three bits of `at`, which select one of
    eight unpackers.
    """

    def __init__(self, style: Style) -> None:
        self.lines: list[str] = []
        self.constants: dict[str, object] = {}
        self._is_wrapped = style is Style.WRAPPED
        self._indent = 8 * " "
        self._together: list[tuple[str, int, str]] = []  # format, alignment, variable
        self._numbers = count(1)

    def message(self, message: MessageType) -> str:
        members: dict[str, str] = {}
        for field in message.fields or (PLACEHOLDER,):
            expression = self._value(field.type)
            is_bare = isinstance(field.type, List) or not self._is_wrapped
            members[field.name] = expression if is_bare else f"({expression},)"
        return "{" + ", ".join(f"{name!r}: {members[name]}" for name in sorted(members)) + "}"

    def unpack(self) -> None:
        """Append the lines that unpack all pending scalars."""
        if self._together:
            layouts = (_layout(self._together, phase) for phase in range(8))
            unpackers = self._constant(tuple((struct.Struct(form).unpack_from, size) for form, size in layouts))
            self._line(f"unpack, size = {unpackers}[at & 7]")
            self._line(f"{', '.join(variable for _, _, variable in self._together)}, = unpack(cdr, at)")
            self._line("at += size")
            self._together = []

    def _value(self, declared: Type) -> str:
        match declared:
            case MessageType():
                return self.message(declared)
            case List(element=MessageType() | String()):
                return f"in_chunks({self._elements(declared)})"
            case List():
                return self._scalars(declared)
            case String():
                convert = "text" if not declared.wide else "wide_units" if self._is_wrapped else "wide_text"
                return f"{convert}({self._stretch(4 if declared.wide else 1)})"
            case _:
                letter = scalar_format(declared)
                return self._take(letter, struct.calcsize(letter))

    def _scalars(self, declared: List) -> str:
        letter = scalar_format(declared.element)
        size = struct.calcsize(letter)
        if declared.length is None:
            return f"{_SEQUENCES[letter]}({self._stretch(size)})"
        array = self._take(f"{declared.length * size}s", size)
        if declared.length > _SHORT:
            return f"{_SEQUENCES[letter]}({array})"
        return f"{self._constant(struct.Struct(f'<{declared.length}{letter}').unpack)}({array})"

    def _elements(self, declared: List) -> str:
        times = self._take("I", 4) if declared.length is None else declared.length
        self.unpack()
        elements = self._name("v")
        self._line(f"{elements} = []")
        self._line(f"for _ in range({times}):")
        self._indent += 4 * " "
        element = self._value(declared.element)
        self.unpack()
        self._line(f"{elements}.append({element})")
        self._indent = self._indent[4:]
        return elements

    def _stretch(self, size: int) -> str:
        """Return the variable with the bytes of a string, or of a sequence of scalars of `size` bytes each."""
        length, stretch = self._take("I", 4), self._name("v")
        self.unpack()
        if size == 8:
            self._line(f"at += {length} and {len(HEADER)} - at & 7")
        self._line(f"{stretch} = cdr[at : at + {size} * {length}]")
        self._line(f"at += {size} * {length}")
        return stretch

    def _take(self, form: str, alignment: int) -> str:
        """Return the variable of a scalar that `struct` will read."""
        variable = self._name("v")
        self._together.append((form, alignment, variable))
        return variable

    def _constant(self, value: object) -> str:
        name = self._name("c")
        self.constants[name] = value
        return name

    def _name(self, prefix: str) -> str:
        return f"{prefix}{next(self._numbers)}"

    def _line(self, text: str) -> None:
        self.lines.append(self._indent + text)


def _layout(takes: Sequence[tuple[str, int, str]], phase: int) -> tuple[str, int]:
    """Return the struct format and size of scalars at an offset with these last three bits."""
    whole, at = "<", phase
    for form, alignment, _ in takes:
        padding = (len(HEADER) - at) % alignment
        whole += f"{padding}x{form}"
        at += padding + struct.calcsize(f"<{form}")
    return whole, at - phase


def _refuse(representation: bytes) -> NoReturn:
    raise UnreadableError(f"the message starts with 0x{representation.hex()}, not with the header of CDR_LE")


def _cut_off(cdr: bytes) -> NoReturn:
    raise UnreadableError(f"the message ends after {len(cdr)} bytes, within a string or list")


def _text(data: bytes) -> str:
    """Decode a string. The final NUL may be missing: Fast CDR accepts that."""
    text = data.removesuffix(b"\0")
    try:
        return text.decode()
    except UnicodeDecodeError:
        begin = text[:_LONGEST_EXCERPT].decode(errors="backslashreplace") + "..." * (len(text) > _LONGEST_EXCERPT)
        raise UnreadableError(f"the text '{begin}' is not UTF-8: correct its publisher") from None


_LONGEST_EXCERPT = 48
"""Bytes of a text that an error quotes."""


def _units(data: bytes) -> Any:
    """Return the UTF-16 units of a wstring, which stores each in 32 bits."""
    import numpy as np  # only few messages need it, and it takes 0.1 s and 20 MB

    units: Any = np.frombuffer(data, "<u4")
    if len(units) and units.max() > _LARGEST_UNIT:
        raise UnreadableError("a wstring contains values above 0xFFFF, which are not UTF-16")
    return units


def _wide_units(data: bytes) -> Any:
    return _in_chunks(_units(data))


def _wide_text(data: bytes) -> str:
    text: str = _units(data).astype("<u2").tobytes().decode("utf-16-le")
    return text


def _in_chunks(values: Any) -> Any:
    """Return a value that orjson writes as a list. Long lists are serialized here, a chunk at a time."""
    if len(values) <= _CHUNK:
        return values
    chunks = (values[start : start + _CHUNK] for start in range(0, len(values), _CHUNK))
    texts = [orjson.dumps(chunk, None, _NUMPY)[1:-1] for chunk in chunks]
    texts[0], texts[-1] = b"[" + texts[0], texts[-1] + b"]"
    return orjson.Fragment(b",".join(texts))


def _sequence(letter: str) -> Callable[[bytes], Any]:
    """Make a function that turns the bytes of a list of scalars into a value that orjson can write."""
    size = struct.calcsize(letter)

    def sequence(data: bytes) -> Any:
        number = len(data) // size
        if number <= _SHORT:
            return struct.unpack(f"<{number}{letter}", data)
        import numpy as np  # as in _units

        values: Any = np.frombuffer(data, f"<{letter}" if letter != "?" else "u1")
        # orjson would write the shortest text of the float32, but clients read doubles.
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
"""The largest double that rounds to a float32."""
_BEGIN, _END = 70, 50
"""Characters at the beginning and end of a long error text that are shown: what is wrong, and where."""


def decoder(message: MessageType, style: Style) -> Decode:
    """Make a function that reads messages of this type: all fields and no others, each with its type and range.

    Values are not converted: 3.0 is not an integer, 1 is not a bool. An integer is accepted as a float, however.
    """
    writing = _Writing(style)
    read: Callable[[bytes], Any] = reader(msgspec.json.Decoder(writing.struct(message)))

    def decode(text: bytes) -> bytes:
        data = bytearray()
        try:
            writing.write(data, message, read(text), "")
        except (msgspec.ValidationError, UnicodeError, InvalidMessageError) as error:
            remedy = "; send every field of the message" if str(error).startswith(_MISSING) else ""
            raise InvalidMessageError(shown(str(error)) + remedy) from None
        return HEADER + data

    return decode


_MISSING = "Object missing required field"
"""The beginning of msgspec's error for a missing field."""
_AnyJson = msgspec.json.Decoder(msgspec.Raw)


def reader(decoder: msgspec.json.Decoder[T]) -> Callable[[bytes], T]:
    """Make a function that reads JSON. It raises PacketError for invalid JSON, ValidationError for any other fault."""

    def read(text: bytes) -> T:
        try:
            try:
                return decoder.decode(text)
            except msgspec.ValidationError:
                _AnyJson.decode(text)  # raises DecodeError if the rest is not JSON
                raise
        except msgspec.ValidationError:
            raise
        except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
            raise PacketError(f"not JSON: {shown(str(error))}") from None

    return read


def shown(text: str) -> str:
    """Shorten and escape a text for the log; it may quote a client."""
    text = ascii(text)[1:-1]
    return text if len(text) <= _BEGIN + _END else f"{text[:_BEGIN]}...{text[-_END:]}"


class _Writing:
    """Makes the Structs that msgspec reads messages into, and writes their fields as CDR."""

    def __init__(self, style: Style) -> None:
        self._is_wrapped = style is Style.WRAPPED
        self._structs: dict[MessageType, type] = {}

    def struct(self, message: MessageType) -> type:
        """Return the Struct of a message. Its attributes are `f0`, `f1` ..., as names may be Python keywords."""
        if (struct := self._structs.get(message)) is None:
            fields = message.fields or (PLACEHOLDER,)
            members: list[Any] = [(f"f{index}", self._field(field.type)) for index, field in enumerate(fields)]
            if not message.fields:
                members = [(*members[0], (0,) if self._is_wrapped else 0)]
            struct = self._structs[message] = msgspec.defstruct(
                message.short_name,
                members,
                rename={f"f{index}": field.name for index, field in enumerate(fields)},
                forbid_unknown_fields=True,
                frozen=True,
                gc=False,
            )
        return struct

    def _field(self, declared: Type) -> Any:
        bare = self._bare(declared)
        return bare if isinstance(declared, List) or not self._is_wrapped else tuple[bare]  # type: ignore[valid-type]

    def _bare(self, declared: Type) -> Any:
        match declared:
            case MessageType():
                return self.struct(declared)
            case Bool():
                return bool
            case Int(bits=64, signed=False):  # msgspec has no bounds above int64; `struct` checks
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

    def write(self, data: bytearray, declared: Type, value: Any, path: str) -> None:  # noqa: C901 - a case a type
        """Append a value as CDR. `path` names it in errors. Raises InvalidMessageError, UnicodeError."""
        match declared:
            case MessageType(fields=()):
                data.append(0)
            case MessageType():
                for field, member in zip(declared.fields, msgspec.structs.astuple(value), strict=True):
                    is_bare = isinstance(field.type, List) or not self._is_wrapped
                    inner = f"{path}.{field.name}" if path else field.name
                    self.write(data, field.type, member if is_bare else member[0], inner)
            case List(element=element):
                if declared.length is None:
                    put_length(data, len(value))
                if isinstance(element, (MessageType, String)):
                    for item in value:
                        self.write(data, element, item, f"{path}[]")
                else:
                    _put_scalars(data, element, value, f"{path}[]")
            case String(wide=True):
                text = _wide_text_of_units(value, path) if self._is_wrapped else value
                _check_size(len(text.encode("utf-16-le")) // 2, "characters", declared.bound, path)
                put_wide_text(data, text)
            case String():
                if "\0" in value:
                    raise InvalidMessageError(f"{path}: a ROS string cannot contain NUL")
                _check_size(len(value.encode()), "bytes", declared.bound, path)
                put_text(data, value)
            case _:
                _put_scalars(data, declared, (value,), path)


def _check_size(size: int, unit: str, bound: int | None, path: str) -> None:
    if bound is not None and size > bound:
        raise InvalidMessageError(f"{path}: {size} {unit} exceed the bound of {bound}")


def _put_scalars(data: bytearray, declared: Type, values: Sequence[Any], path: str) -> None:
    letter = scalar_format(declared)
    try:
        put_numbers(data, letter, struct.calcsize(letter), values)
    except struct.error:  # only uint64: msgspec has checked the others
        raise InvalidMessageError(f"{path}: {max(values)} is out of range for {declared}") from None


def _wide_text_of_units(units: Sequence[int], path: str) -> str:
    try:
        return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le")
    except UnicodeDecodeError:
        raise InvalidMessageError(f"{path}: the string has an unpaired surrogate") from None
