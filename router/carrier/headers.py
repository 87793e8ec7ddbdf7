"""Makes `router/declared.py` of the headers in `native/`: their structures for ctypes, constants, enums and functions.

It reads the C that these headers are written in, and no other. `checks` has the compiler confirm what was read.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import indent
from types import ModuleType

_HEAD = '''"""What the headers of the carrier declare: made of them by router/carrier/headers.py with each build."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import POINTER
from enum import IntEnum

TYPE_CHECKING = False
'''

_LAZY = """
def __getattr__(name: str) -> type[IntEnum]:
    \"""Make an enum when it is used first: all of them take longer than the rest of this module.\"""
    if name not in _ENUMS:
        raise AttributeError(f"the headers declare no {name}")
    return globals().setdefault(name, IntEnum(name, _ENUMS[name], module=__name__))
"""

_LIMITS = {f"{sign}INT{bits}_MAX": (1 << bits - (not sign)) - 1 for sign in ("", "U") for bits in (8, 16, 32, 64)}
_PLAIN = {
    **{f"{sign}int{bits}_t": f"ctypes.c_{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    **{name: f"ctypes.c_{name}" for name in ("bool", "char", "int", "size_t", "float", "double")},
}
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_DIRECTIVE = re.compile(r"^#(?:.*\\\n)*.*$", re.MULTILINE)
_DEFINED = re.compile(r"^#define (\w+) (\w+)\s*$", re.MULTILINE)
_INCLUDED = re.compile(r'^#include "(.+)"', re.MULTILINE)
_TYPE = re.compile(r"((?:struct |enum )?\w+)\b(.*)")
_DECLARATOR = re.compile(r"([* ]*)(\w+)(?:\[(\w+)\])?")


class HeaderError(Exception):
    """A header has C that is not understood here."""


@dataclass(frozen=True, slots=True)
class _Member:
    """A field: its type, the number of `*`, and the size of an array. `members` are those of a union instead."""

    name: str
    type: str
    pointers: int = 0
    size: str = ""
    members: tuple[_Member, ...] = ()


@dataclass(slots=True)
class _Declared:
    constants: dict[str, int] = field(default_factory=dict)
    enums: dict[str, dict[str, int]] = field(default_factory=dict)
    """By tag, the enumerators without the prefix that they have in common."""
    structures: dict[str, list[_Member]] = field(default_factory=dict)
    functions: dict[str, tuple[str, str]] = field(default_factory=dict)
    values: dict[str, int] = field(default_factory=dict)
    """Enumerators and limits by their names in C."""


def declarations(folder: Path, checksum: str) -> str:
    """The text of the module. Raises HeaderError."""
    declared = _Declared(values=dict(_LIMITS))
    for statement in _statements(folder, declared):
        _declare(statement, declared)
    return "\n".join([_HEAD, f'CHECKSUM = "{checksum}"', *_text(declared), ""])


def checks(folder: Path, made: ModuleType) -> str:
    """C that no compiler takes unless the structures and enumerators of a module are those of the headers."""
    lines = [f'#include "{path.name}"' for path in sorted(folder.glob("*.h"))]
    for tag, structure in made.STRUCTURES.items():
        lines.append(_asserted(f"sizeof(struct {tag})", ctypes.sizeof(structure)))
        for name in _names(structure):
            member = getattr(structure, name)
            lines.append(_asserted(f"offsetof(struct {tag}, {name})", member.offset))
            lines.append(_asserted(f"sizeof(((struct {tag} *)0)->{name})", member.size))
    lines += [_asserted(name, value) for name, value in made.ENUMERATORS.items()]
    return "\n".join(["#include <stddef.h>", *lines, ""])


def _names(structure: type[ctypes.Structure | ctypes.Union]) -> Iterator[str]:
    """Its fields, with those of unions in it."""
    unions = getattr(structure, "_anonymous_", ())
    for name, kind, *_ in structure._fields_:
        if name in unions:
            yield from _names(kind)  # type: ignore[arg-type]
        else:
            yield name


def _asserted(what: str, value: int) -> str:
    suffix = "u" if value >= 1 << 63 else ""
    return f'_Static_assert({what} == {int(value)}{suffix}, "{what}");'


# ---- reading


def _statements(folder: Path, declared: _Declared) -> Iterator[str]:
    """The declarations of all headers, each of them after those that it includes; no definitions of functions."""
    done: set[str] = set()

    def read(name: str) -> Iterator[str]:
        if name in done:
            return
        done.add(name)
        text = _COMMENT.sub(" ", (folder / name).read_text(encoding="utf-8"))
        for included in _INCLUDED.findall(text):
            yield from read(included)
        for constant, value in _DEFINED.findall(text):
            if value in declared.values:
                declared.constants[constant] = declared.values[constant] = declared.values[value]
        yield from _split(_DIRECTIVE.sub("", text))

    for path in sorted(folder.glob("*.h")):
        yield from read(path.name)


def _split(text: str, end: str = ";") -> Iterator[str]:
    """What `end` ends outside of braces and parentheses. Definitions of functions are left out."""
    depth, begin = 0, 0
    for at, character in enumerate(text):
        if character in "{(":
            depth += 1
        elif character in "})":
            depth -= 1
            if character == "}" and not depth and ")" in text[begin:at].partition("{")[0]:
                begin = at + 1
        elif character == end and not depth:
            yield " ".join(text[begin:at].split())
            begin = at + 1
    if rest := text[begin:].strip():
        if end == ";":
            raise HeaderError(f"a declaration without an end: {rest[:60]}")
        yield " ".join(rest.split())


def _declare(statement: str, declared: _Declared) -> None:
    head, brace, body = statement.partition("{")
    words = head.split()
    if not words or words[0] in {"static", "typedef", "extern"}:
        return
    if brace and words[0] == "enum":
        _declare_enum(words[1] if len(words) > 1 else "", _inside(body), declared)
    elif brace:
        members = _members(_inside(body))
        if members is not None:
            declared.structures[words[1]] = members
    elif "(" in statement:
        declared.functions.update(_function(statement))


def _inside(body: str) -> str:
    return body.rpartition("}")[0]


def _declare_enum(tag: str, body: str, declared: _Declared) -> None:
    enumerators = [tuple(word.strip() for word in each.partition("=")[::2]) for each in _split(body, ",")]
    names = [name for name, _ in enumerators]
    prefix = names[0].partition("_")[0] + "_"
    if sum(name.startswith(prefix) for name in names) < max(2, len(names) - 1):
        prefix = ""
    short = declared.enums.setdefault(tag, {}) if tag else declared.constants
    value = -1
    for name, text in enumerators:
        value = eval(text, None, declared.values) if text else value + 1  # noqa: S307 - C of our own
        declared.values[name] = value
        short[name.removeprefix(prefix) if tag else name] = value


def _members(body: str) -> list[_Member] | None:
    """None if one has a type that ctypes has not, such as a function's or an atomic one."""
    made: list[_Member] = []
    for text in _split(body):
        if text.startswith("union {"):
            members = _members(_inside(text.partition("{")[2]))
            if members is None:
                return None
            made.append(_Member(f"_{len(made)}", "union", members=tuple(members)))
            continue
        found = _TYPE.fullmatch(_plain(text))
        if found is None or "(" in text or "_Atomic" in text:
            return None
        for each in _split(found[2], ","):
            declarator = _DECLARATOR.fullmatch(each)
            if declarator is None:
                return None
            stars, name, size = declarator.groups()
            made.append(_Member(name, found[1], stars.count("*"), size or ""))
    return made


def _plain(text: str) -> str:
    return " ".join(re.sub(r"\bconst\b", " ", text).split())


def _function(statement: str) -> Iterator[tuple[str, tuple[str, str]]]:
    """A function, unless it is one that Python cannot call."""
    head, _, taken = statement.partition("(")
    returned, name = re.fullmatch(r"(.*?)(\w+)", _plain(head)).groups()  # type: ignore[union-attr]
    parameters = [each for each in map(_plain, _split(_inside_parentheses(taken), ",")) if each != "void"]
    types = [_passed(re.sub(r"\w+$", "", each)) for each in parameters]
    made = "None" if returned.strip() == "void" else _passed(returned)
    if made and all(types):
        yield name, (made, f"({''.join(f'{each}, ' for each in types)})")


def _inside_parentheses(text: str) -> str:
    return text.rpartition(")")[0]


def _passed(declared: str) -> str:
    """What ctypes passes for a type; '' for one that it has not. Any pointer may be an address, bytes or an array."""
    declared = declared.strip()
    if "*" in declared:
        return "ctypes.c_void_p"
    if declared.startswith("struct "):
        return _class(declared.removeprefix("struct "))
    return "ctypes.c_int" if declared.startswith("enum ") else _PLAIN.get(declared, "")


def _class(tag: str) -> str:
    return "".join(word.capitalize() for word in tag.split("_"))


# ---- writing


def _text(declared: _Declared) -> Iterator[str]:
    known = dict(_known(declared.structures))
    classes = {_class(tag) for tag in known}
    if both := classes & {_class(tag) for tag in declared.enums}:
        raise HeaderError(f"both a struct and an enum: {', '.join(sorted(both))}")
    if declared.enums:
        yield from _enums(declared.enums)
    yield from (f"{name} = {value}" for name, value in declared.constants.items())
    for tag in known:
        yield f'\n\nclass {_class(tag)}(ctypes.Structure):\n    """`struct {tag}`."""'
    yield "\n"
    for tag, members in known.items():
        yield from _fields(_class(tag), members, known)
    functions = {
        name: both
        for name, both in declared.functions.items()
        if {both[0]} <= {"None", *classes} or both[0].startswith("ctypes.")
    }
    yield "\nFUNCTIONS: Mapping[str, tuple[type | None, tuple[type, ...]]] = {"
    yield from (f'    "{name}": ({returned}, {taken}),' for name, (returned, taken) in sorted(functions.items()))
    yield "}\n"
    yield "STRUCTURES: Mapping[str, type[ctypes.Structure]] = {"
    yield from (f'    "{tag}": {_class(tag)},' for tag in known)
    yield "}\n"
    yield "ENUMERATORS: Mapping[str, int] = {"
    yield from (f'    "{name}": {value},' for name, value in declared.values.items() if name not in _LIMITS)
    yield "}"


def _enums(enums: Mapping[str, Mapping[str, int]]) -> Iterator[str]:
    yield "\nif TYPE_CHECKING:"
    for tag, enumerators in enums.items():
        yield f"\n    class {_class(tag)}(IntEnum):"
        yield from (f"        {name} = {value}" for name, value in enumerators.items())
    yield "\nelse:\n    _ENUMS = {"
    yield from (f'        "{_class(tag)}": {enumerators},' for tag, enumerators in enums.items())
    yield f"    }}\n{indent(_LAZY, '    ')}"


def _known(structures: Mapping[str, list[_Member]]) -> Iterator[tuple[str, list[_Member]]]:
    """Those of which Python knows all members; others are only pointed to."""
    known: set[str] = set()

    def is_known(member: _Member) -> bool:
        if member.pointers or member.members:
            return all(map(is_known, member.members))
        return member.type in _PLAIN or member.type.startswith("enum ") or member.type.removeprefix("struct ") in known

    for tag, members in structures.items():
        if all(map(is_known, members)):
            known.add(tag)
            yield tag, members


def _fields(owner: str, members: Iterable[_Member], known: Mapping[str, object]) -> Iterator[str]:
    lines, unions = [], []
    for each in members:
        if each.members:
            union = f"_{owner}{each.name}"
            yield f"\n\nclass {union}(ctypes.Union):\n    pass\n\n"
            yield from _fields(union, each.members, known)
            unions.append(each.name)
            lines.append(f'("{each.name}", {union})')
        else:
            lines.append(f'("{each.name}", {_held(each, known)})')
    if unions:
        yield f"{owner}._anonymous_ = {unions}"
    yield f"{owner}._fields_ = [{', '.join(lines)}]"


def _held(member: _Member, known: Mapping[str, object]) -> str:
    """The type of a field."""
    tag = member.type.removeprefix("struct ")
    plain = _PLAIN.get(member.type) or ("ctypes.c_int" if member.type.startswith("enum ") else "")
    if member.pointers > 1:
        made = "POINTER(ctypes.c_void_p)"
    elif member.pointers and member.type in {"char", "uint8_t"}:
        made = "ctypes.c_char_p"
    elif member.pointers:
        made = f"POINTER({plain or _class(tag)})" if plain or tag in known else "ctypes.c_void_p"
    else:
        made = plain or _class(tag)
    return f"{made} * {member.size}" if member.size else made
