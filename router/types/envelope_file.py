"""Find the `.proto` file that declares the envelope by the texts, before anything is compiled."""

from __future__ import annotations

import os
from pathlib import Path

from router.errors import Code, Diagnostic, TableError, did_you_mean, shown_path
from router.table.model import EnvelopeSettings
from router.types.lock_file import Lock
from router.types.proto_folder import Folder
from router.types.proto_scan import declaring, scan

_FURTHER_UP = 4
_OF_PROTOBUF = "google/protobuf/"


def envelope_file(folder: Folder, settings: EnvelopeSettings, locked: Lock | None) -> tuple[str, str]:
    """The file that declares the envelope, and its full name there. Of several, the one that the lock has goes first.

    Raises TableError when there is none or more than one, and when `protos` is the wrong folder.
    """
    wanted = settings.message.value
    declared = declaring(wanted, folder.protos)
    found = [(file, name) for file, name in declared if name in scan(folder.files[file]).messages]
    if not found:
        raise TableError(_missing(folder, settings))
    envelope = locked.messages.get(locked.message) if locked is not None else None

    def rank(each: tuple[str, str]) -> tuple[bool, bool, bool]:
        file, name = each
        is_locked = envelope is not None and file == envelope.file
        return is_locked, name == wanted, scan(folder.files[file]).is_top_level(name)

    best = max(map(rank, found))
    found = [*dict.fromkeys(each for each in found if rank(each) == best)]
    if len(found) > 1:
        files = " and ".join(file for file, _ in found)
        message = f"several files declare a message '{wanted}': {files}"
        hint = "remove all but one, or give its full name if they have packages"
        raise TableError([Diagnostic(settings.message.span, Code.DUPLICATE_MESSAGE, message, hint)])
    file, name = found[0]
    if (above := _folder_above(folder, file)) is not None:
        raise TableError([_too_deep(folder, settings, above, file)])
    return file, name


def _missing(folder: Folder, settings: EnvelopeSettings) -> list[Diagnostic]:
    """What is wrong when no file declares the envelope: perhaps it is in one that cannot be read."""
    for file in folder.protos:
        if (above := _folder_above(folder, file)) is not None:
            return [_too_deep(folder, settings, above, file)]
    wanted = settings.message
    hint = did_you_mean(wanted.value, [name for content in folder.protos.values() for name in scan(content).messages])
    message = f"no .proto file declares a message '{wanted.value}'"
    faults = [each for found in folder.faults.values() for each in found]
    return [Diagnostic(wanted.span, Code.BAD_VALUE, message, hint), *faults]


def _imports(content: bytes) -> list[str]:
    return [name for name in scan(content).imports if not name.startswith(_OF_PROTOBUF)]


def _folder_above(folder: Folder, file: str) -> Path | None:
    """The folder above this one that the imports of a file are relative to, if they are."""
    imports = _imports(folder.files[file])
    if not imports or any(name in folder.files or name in folder.faults for name in imports):
        return None
    above = folder.root.parents[:_FURTHER_UP]
    return next((each for each in above if all((each / name).is_file() for name in imports)), None)


def _too_deep(folder: Folder, settings: EnvelopeSettings, right: Path, file: str) -> Diagnostic:
    steps = len(folder.root.relative_to(right).parts)
    count = {1: "one folder", 2: "two folders"}.get(steps, f"{steps} folders")
    message = f"`protos` is {count} too deep: {file} imports '{_imports(folder.files[file])[0]}'"
    table = Path(settings.protos.span.file)
    shown = os.path.relpath(right, table.absolute().parent) if table.is_file() else shown_path(right)
    return Diagnostic(settings.protos.span, Code.BAD_VALUE, message, f"take {shown}, to which imports are relative")
