"""A new message in protobuf: its `.proto` file, its place in the envelope, its numbers in the lock.

Texts in, texts out; only for protoc the changed files are put in a folder that is gone afterwards.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from router.errors import Severity, TableError, UsageError
from router.table.model import Located
from router.tools.new_message_layout import aligned
from router.tools.new_message_model import SCALARS, NewMessage, Site
from router.types.lock import check_lock, extended_lock
from router.types.lock_file import lock_text
from router.types.protobuf import find_envelope, load_protos

_IMPORT = re.compile(r'\s*import\s+(?:public\s+)?"(.*)"\s*;')
_HEAD = re.compile(r"\s*(syntax|package)\b")


def proto_texts(message: NewMessage, site: Site) -> Mapping[str, str]:
    """The contents of every file of the protos that is new or changes, by name relative to their folder, lock included.

    The lock's name is its path.
    Raises UsageError when protoc or the lock refuses what came of it.
    """
    envelope_file = site.file(site.envelope.name)
    before = (site.schema.root / envelope_file).read_text(encoding="utf-8")
    texts = {site.new_file(message): _declared(message, site), envelope_file: _in_envelope(before, message, site)}
    return {**texts, str(site.schema.lock): _locked(texts, site)}


def _declared(message: NewMessage, site: Site) -> str:
    """The new `.proto` file."""
    imports = sorted({site.file(field.type) for field in message.fields if field.type not in SCALARS})
    rows = [
        (f"  {field.type} {field.name} = {number};", field.comment) for number, field in enumerate(message.fields, 1)
    ]
    lines = [
        f"// {message.title}.",
        'syntax = "proto3";',
        "",
        *(f'import "{name}";' for name in imports),
        *([""] if imports else []),
        f"message {message.name} {{",
        *aligned(rows, "//"),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _in_envelope(text: str, message: NewMessage, site: Site) -> str:
    """The envelope's file with the import, in its order, and the payload case after the last one."""
    lines = text.split("\n")
    cases = site.schema.messages[site.envelope.name].fields
    places = {
        field: site.schema.span(site.envelope.name, field.name).line
        for field in cases
        if field.oneof == site.envelope.oneof
    }
    last = max(places, key=lambda field: places[field])
    end = next(index for index in range(places[last] - 1, len(lines)) if ";" in lines[index])
    indent = lines[end][: len(lines[end]) - len(lines[end].lstrip())]
    own = f"{indent}{message.name} {message.case} = {message.number};"
    is_of_same_board = site.envelope.cases[last.name].type.short_name.startswith(message.prefix)
    lines[end + 1 : end + 1] = [own] if is_of_same_board else ["", f"{indent}// {message.board_words}", own]
    imports = {index: found[1] for index, line in enumerate(lines) if (found := _IMPORT.match(line))}
    new = site.new_file(message)
    place = next((index for index, name in imports.items() if name > new), max(imports, default=_head(lines)) + 1)
    lines.insert(place, f'import "{new}";')
    return "\n".join(lines)


def _head(lines: Sequence[str]) -> int:
    """The last line before which there can be no import."""
    return max((index for index, line in enumerate(lines) if _HEAD.match(line)), default=-1)


def _locked(texts: Mapping[str, str], site: Site) -> str:
    """The lock as `router schema lock` would write it after the changes."""
    with tempfile.TemporaryDirectory(prefix="router_new_") as folder:
        root = Path(folder, "protos")
        shutil.copytree(site.schema.root, root)
        for name, text in texts.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text, encoding="utf-8")
        try:
            settings = replace(site.settings, protos=Located(root, site.settings.protos.span))
            schema = load_protos(settings)
            envelope = find_envelope(schema, settings)
            errors = [each for each in check_lock(schema, envelope) if each.severity is Severity.ERROR]
        except TableError as error:
            errors = list(error.diagnostics)
        if errors:
            raise UsageError("; ".join(each.message for each in errors))
        return lock_text(extended_lock(schema, envelope))
