"""nanopb's `.options` files: how large the boards make strings, bytes and repeated fields.

Reads text; knows neither descriptors nor how large an encoding gets (see `sizes`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, shown_path

_COMMENT = re.compile(r"//.*|#.*|/\*.*?\*/")
_OPTION = re.compile(r"(?P<key>\w+)\s*:\s*(?P<value>\"[^\"]*\"|[\w.+-]+)\s*[,;]?\s*")
_COUNTS = frozenset({"max_size", "max_length", "max_count"})
_FLAGS = frozenset({"fixed_length", "fixed_count"})
_WITHOUT_INFLUENCE = frozenset(
    {
        "long_names", "packed_struct", "packed_enum", "msgid", "anonymous_oneof", "proto3", "proto3_singular_msgs",
        "enum_to_string", "enum_validate", "mangle_names", "callback_datatype", "callback_function", "descriptorsize",
        "default_has", "include", "exclude", "package", "sort_by_tag", "initializer", "enum_intsize",
        "discard_unused_automatic_types", "discard_deprecated",
    }
)  # fmt: skip
_TYPES = {"FT_DEFAULT": True, "FT_STATIC": True, "FT_INLINE": True, "FT_CALLBACK": False, "FT_POINTER": False}


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """What nanopb is told about one field. Sizes in bytes, a string's with its final NUL.

    `is_static` is False where the board holds the field by pointer or callback, which has no bound.
    """

    max_size: int | None = None
    max_length: int | None = None
    max_count: int | None = None
    fixed_length: bool = False
    fixed_count: bool = False
    is_static: bool = True

    @property
    def string_size(self) -> int | None:
        """As `max_size` of a string: `max_length` wins where both are given."""
        return self.max_length + 1 if self.max_length is not None else self.max_size


NO_OPTIONS = BoardOptions()


@dataclass(frozen=True, slots=True)
class OptionsFile:
    """The lines of one file: which names (a pattern with wildcards), and what changes for them."""

    lines: tuple[tuple[str, Mapping[str, int | bool]], ...] = ()

    def of(self, message: str, field: str) -> BoardOptions:
        """Full name of the message (or of the enclosing ones, by pattern), name of the field.

        As in nanopb, options of a message hold for its fields, and later lines win over earlier ones.
        """
        options = NO_OPTIONS
        for name in (message, f"{message}.{field}"):
            for pattern, changes in self.lines:
                if fnmatchcase(name, pattern):
                    options = replace(options, **changes)  # type: ignore[arg-type]
        return options


def read_options(path: Path) -> tuple[OptionsFile, list[Diagnostic]]:
    """An `.options` file and what is wrong with it."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        return OptionsFile(), [Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, f"cannot be read: {error}")]
    lines = []
    findings = []
    for number, line in enumerate(text.splitlines(), start=1):
        bare = _COMMENT.sub("", line).strip()
        if not bare:
            continue
        pattern, _, rest = bare.partition(" ") if " " in bare else bare.partition("\t")
        changes, complaints = _changes(rest)
        column = len(line) - len(line.lstrip()) + 1
        span = SourceSpan(shown_path(path), number, column, column + len(bare))
        findings += [Diagnostic(span, Code.BAD_PROTO, message, hint) for message, hint in complaints]
        lines.append((pattern, changes))
    return OptionsFile(tuple(lines)), findings


def _changes(text: str) -> tuple[Mapping[str, int | bool], Iterable[tuple[str, str]]]:
    """What one line sets, and (message, hint) of what cannot be understood."""
    text = text.strip()
    changes: dict[str, int | bool] = {}
    if not text:
        return changes, [("no option after the name", "write for example 'max_size:16'")]
    at = 0
    while at < len(text):
        option = _OPTION.match(text, at)
        if option is None:
            return changes, [(f"'{text[at:]}' is no option of nanopb", "write for example 'max_size:16'")]
        at = option.end()
        key, value = option["key"], option["value"]
        if key in _COUNTS and value.isdecimal():
            changes[key] = int(value)
        elif key in _FLAGS and value in ("true", "false"):
            changes[key] = value == "true"
        elif key == "type" and value in _TYPES:
            changes["is_static"] = _TYPES[value]
        elif key in _COUNTS | _FLAGS | {"type"}:
            return changes, [(f"{key} cannot be '{value}'", "")]
        elif key not in _WITHOUT_INFLUENCE:
            hint = did_you_mean(key, _COUNTS | _FLAGS | {"type"})
            return changes, [(f"the router cannot tell sizes with nanopb's option '{key}'", hint)]
    return changes, []
