"""CDR bytes to JSON text: one generated function for each message type, and no message object in between.

Fields are read in declared order, which decides the bytes, and put in the order of their names into one f-string.
Plain CDR, little-endian. What comes behind the message is not looked at: middlewares pad it.
"""

from __future__ import annotations

import linecache
import struct
from collections.abc import Callable
from typing import NoReturn

from router.compiler.cdr.primitives import CDR_LE, scalar_format
from router.gateway.json_layout import CdrLines
from router.gateway.json_lists import SHORT, SHORT_LISTS, STRINGS, WIDE_LISTS, WIDE_STRINGS, cut_off, joined, list_text
from router.gateway.numbers import DOUBLES, FLOATS
from router.gateway.style import PLACEHOLDER, Style, UnreadableError
from router.types.model import Bool, Float, List, MessageType, String, Type

JsonWriter = Callable[[bytes], str]

_LETTERS = {"?": "bool", "b": "int8", "B": "uint8", "h": "int16", "H": "uint16", "i": "int32", "I": "uint32",
            "q": "int64", "Q": "uint64", "f": "float32", "d": "float64"}  # fmt: skip


def _refuse(representation: bytes) -> NoReturn:
    raise UnreadableError(f"the message begins with 0x{representation.hex()}, which is not CDR_LE")


_NAMESPACE: dict[str, object] = {
    "CDR_LE": CDR_LE,
    "refuse": _refuse,
    "cut_off": cut_off,
    "joined": joined,
    "DAMAGED": (struct.error, UnicodeError),
    "UnreadableError": UnreadableError,
    "boolean": ("false", "true"),
    "double": DOUBLES,
    "single": FLOATS,
    "string": STRINGS,
    "wide_string": WIDE_STRINGS,
    "wide_list": WIDE_LISTS,
    **{f"short_{name}": SHORT_LISTS[letter] for letter, name in _LETTERS.items()},
    **{f"list_{name}": list_text(letter) for letter, name in _LETTERS.items()},
}


class JsonCode:
    """The source of a writer, and the namespace that it is run in."""

    def __init__(self, message: MessageType, style: Style) -> None:
        self._style = style
        self._out = CdrLines()
        self.file = f"<json {message.name}>" if style is Style.WRAPPED else f"<plain json {message.name}>"
        """What tracebacks call it."""
        with self._out.block("def write_json(cdr):"):
            with self._out.block("try:"):
                self._body(message)
            with self._out.block("except DAMAGED as error:"):
                self._out.line("raise UnreadableError(str(error)) from error")
        self.text = "\n".join(self._out.lines) + "\n"
        self.namespace = {**_NAMESPACE, **self._out.constants}

    def _body(self, message: MessageType) -> None:
        with self._out.block("if cdr[:2] != CDR_LE:"):
            self._out.line("refuse(cdr[:2])")
        members = self._members(message)
        self._out.finish()
        with self._out.block("return ("):
            for index, member in enumerate(members):
                before, after = "{{" if index == 0 else "", "}}" if index == len(members) - 1 else ","
                self._out.line(f"f'{before}{member}{after}'")
        self._out.line(")")

    def _members(self, message: MessageType) -> list[str]:
        """Parts of an f-string, one a field, sorted; the reading of what they name is appended or soon will be."""
        members = {field.name: self._member(field.type) for field in message.fields}
        if not members:
            members[PLACEHOLDER] = self._wrapped(f"{{{self._out.take('B', 1)}}}")
        return [f'"{name}":{members[name]}' for name in sorted(members)]

    def _member(self, declared: Type) -> str:
        return f"[{self._list(declared)}]" if isinstance(declared, List) else self._wrapped(self._bare(declared))

    def _wrapped(self, part: str) -> str:
        return f"[{part}]" if self._style is Style.WRAPPED else part

    def _bare(self, declared: Type) -> str:
        match declared:
            case MessageType():
                return f"{{{{{','.join(self._members(declared))}}}}}"
            case String():
                return self._string(declared.wide)
            case Bool():
                return f"{{boolean[{self._out.take('?', 1)}]}}"
            case Float(bits=64):
                return f"{{double[{self._out.take('Q', 8)}]}}"
            case Float():
                return f"{{single[{self._out.take('I', 4)}]}}"
            case _:
                letter = scalar_format(declared)
                return f"{{{self._out.take(letter, struct.calcsize(letter))}}}"

    def _count(self) -> str:
        count = self._out.take("I", 4)
        self._out.read()
        return count

    def _string(self, is_wide: bool) -> str:
        count = self._count()
        start = self._out.stretch(count, 4 if is_wide else 1)
        text = self._out.variable("text")
        as_list = is_wide and self._style is Style.WRAPPED
        table = "wide_list" if as_list else "wide_string" if is_wide else "string"
        self._out.line(f"{text} = {table}[cdr[{start}:at]]")
        return f"[{{{text}}}]" if as_list else f"{{{text}}}"

    def _list(self, declared: List) -> str:
        if isinstance(declared.element, (MessageType, String)):
            return self._elements(declared)
        letter = scalar_format(declared.element)
        name, size = _LETTERS[letter], struct.calcsize(letter)
        if declared.length is not None and declared.length * size <= SHORT:
            return f"{{short_{name}[{self._out.take(f'{declared.length * size}s', size)}]}}"
        self._out.read()
        start = self._out.stretch(self._count() if declared.length is None else declared.length, size)
        text = self._out.variable("text")
        self._out.line(f"{text} = list_{name}(cdr, {start}, at)")
        return f"{{{text}}}"

    def _elements(self, declared: List) -> str:
        """Of a list whose elements are messages or strings."""
        self._out.read()
        count: str | int = self._count() if declared.length is None else declared.length
        items, text = self._out.variable("items"), self._out.variable("text")
        self._out.line(f"{items} = []")
        with self._out.loop(count):
            part = self._bare(declared.element)
            self._out.read()
            self._out.line(f"{items}.append(f'{part}')")
        self._out.line(f"{text} = joined({items})")
        return f"{{{text}}}"


def json_writer(message: MessageType, style: Style) -> JsonWriter:
    """The function that makes a message's bytes, with their header, JSON text.

    It raises UnreadableError for bytes that are no such message, and nothing else whatever the bytes are.
    """
    code = JsonCode(message, style)
    linecache.cache[code.file] = (len(code.text), None, code.text.splitlines(keepends=True), code.file)
    namespace = dict(code.namespace)
    exec(compile(code.text, code.file, "exec"), namespace)  # noqa: S102 - generated here; names are rosidl's identifiers
    writer: JsonWriter = namespace["write_json"]  # type: ignore[assignment]
    return writer
