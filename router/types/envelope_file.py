"""Which `.proto` file declares the envelope; told from the texts, before anything is compiled."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from router.errors import Code, Diagnostic, TableError, did_you_mean, shown_path
from router.table.model import EnvelopeSettings
from router.types.proto_folder import Folder
from router.types.proto_scan import declaring, reached, scan
from router.types.protoc_errors import Homes

_FURTHER_UP = 4
_OF_PROTOBUF = "google/protobuf/"


def envelope_file(folder: Folder, settings: EnvelopeSettings, homes: Homes) -> tuple[str, str]:
    """The file that declares the envelope, and its full name there. `homes` are the files that the lock knows.

    Raises TableError when there is none or more than one, and when `protos` is the wrong folder.
    """
    wanted = settings.message.value
    found = declaring(wanted, folder.protos)
    if not found:
        raise TableError(_missing(folder, settings))
    rules: Sequence[Callable[[str, str], bool]] = (
        lambda _, name: "." in wanted and name == wanted,
        lambda file, name: homes().get(name) == file,
        lambda _, name: name == wanted,
        lambda file, name: scan(folder.files[file]).is_top_level(name),
    )
    for rule in rules:
        if len(found) > 1:
            found = [each for each in found if rule(*each)] or found
    if len(found) > 1:
        files = " and ".join(file for file, _ in found)
        message = f"several files declare a message '{wanted}': {files}"
        hint = "remove all but one, or give its full name if they have packages"
        raise TableError([Diagnostic(settings.message.span, Code.DUPLICATE_MESSAGE, message, hint)])
    file, name = found[0]
    if (other := _other_root(folder, file)) is not None:
        raise TableError([_wrong_folder(folder, settings, other, file)])
    return file, name


def _missing(folder: Folder, settings: EnvelopeSettings) -> list[Diagnostic]:
    """What is wrong when no file declares the envelope: perhaps it is in one that cannot be read."""
    for file in folder.protos:
        if (other := _other_root(folder, file)) is not None and folder.root.is_relative_to(other):
            return [_wrong_folder(folder, settings, other, file)]
    wanted = settings.message
    hint = did_you_mean(wanted.value, [name for content in folder.protos.values() for name in scan(content).names])
    message = f"no .proto file declares a message '{wanted.value}'"
    faults = [each for found in folder.faults.values() for each in found]
    return [Diagnostic(wanted.span, Code.BAD_VALUE, message, hint), *faults]


def _imports(content: bytes) -> list[str]:
    return [name for name in scan(content).imports if not name.startswith(_OF_PROTOBUF)]


def _other_root(folder: Folder, file: str) -> Path | None:
    """The folder to which the imports of a file are relative, where it is not this one."""
    imports = _imports(folder.files[file])
    if not imports or any(name in folder.files or name in folder.faults for name in imports):
        return None
    for above in folder.root.parents[:_FURTHER_UP]:
        if all((above / name).is_file() for name in imports):
            return above
    for below in _folders_of(file):
        inner = {name.removeprefix(below): content for name, content in folder.files.items() if name.startswith(below)}
        needed = reached(file.removeprefix(below), inner)
        if all(name in inner or name.startswith(_OF_PROTOBUF) for name in needed):
            return folder.root / below
    return None


def _folders_of(file: str) -> Iterator[str]:
    """`a/` and `a/b/` of `a/b/c.proto`."""
    parts = file.split("/")[:-1]
    for count in range(1, len(parts) + 1):
        yield "".join(f"{part}/" for part in parts[:count])


def _wrong_folder(folder: Folder, settings: EnvelopeSettings, right: Path, file: str) -> Diagnostic:
    is_above = folder.root.is_relative_to(right)
    steps = len(folder.root.relative_to(right).parts if is_above else right.relative_to(folder.root).parts)
    count = {1: "one folder", 2: "two folders"}.get(steps, f"{steps} folders")
    imported = _imports(folder.files[file])[0]
    message = f"`protos` is {count} too {'deep' if is_above else 'high'}: {file} imports '{imported}'"
    table = Path(settings.protos.span.file)
    shown = os.path.relpath(right, table.absolute().parent) if table.is_file() else shown_path(right)
    return Diagnostic(settings.protos.span, Code.BAD_VALUE, message, f"take {shown}, to which imports are relative")
