"""Read the `.proto` and `.options` files of a folder, and find faults for which protoc has no good message.

Names, encoding and the `syntax` line are checked; nothing else is parsed.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from router.errors import Code, Diagnostic, SourceSpan, TableError, shown_path

PROTO = ".proto"
OPTIONS = ".options"

_HIDDEN = re.compile(r"(^|/)\.")
_FILE_NAME = re.compile(r"[\w ./+,@-]+", re.ASCII)
_SYNTAX = re.compile(rb"^(?:\xef\xbb\xbf|\s|/\*.*?\*/)*(?:syntax|edition)\s*=", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Folder:
    """`files` has the bytes of all readable files by name relative to `root`, with `/`, sorted.

    `faults` are the findings of a file, readable or not, by the same names.
    """

    root: Path
    files: Mapping[str, bytes]
    faults: Mapping[str, Sequence[Diagnostic]]

    @property
    def protos(self) -> Mapping[str, bytes]:
        return {name: content for name, content in self.files.items() if name.endswith(PROTO)}

    @cached_property
    def sha256(self) -> str:
        """Over names and contents."""
        digest = hashlib.sha256()
        for name, content in self.files.items():
            digest.update(os.fsencode(f"{name}\0{len(content)}\0"))
            digest.update(content)
        return digest.hexdigest()


def read_folder(root: Path, blame: SourceSpan) -> Folder:
    """The `.proto` and `.options` files below `root`; hidden ones are left alone.

    What is wrong with the folder itself, or with a file's name, is blamed on `blame`. Raises TableError for the folder.
    """
    if not root.is_dir():
        raise TableError([Diagnostic(blame, Code.BAD_FILE, f"there is no folder {shown_path(root)}")])
    found = {
        name: path
        for path in walk(root)
        if path.suffix in (PROTO, OPTIONS) and not _HIDDEN.search(name := path.relative_to(root).as_posix())
    }
    if not any(name.endswith(PROTO) for name in found):
        raise TableError([Diagnostic(blame, Code.BAD_FILE, f"{shown_path(root)} holds no .proto file")])
    files = {}
    faults: dict[str, Sequence[Diagnostic]] = {}
    for name, path in sorted(found.items()):
        if not _FILE_NAME.fullmatch(name):
            hint = "take letters, digits, '_', '-' and '.'"
            faults[name] = [Diagnostic(blame, Code.BAD_FILE, f"protoc cannot import a file named {name!a}", hint)]
        try:
            files[name] = path.read_bytes()
        except OSError as error:
            message = f"cannot be read: {error.strerror}"
            faults[name] = [Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message)]
        else:
            if complaints := list(_text_findings(path, files[name])):
                faults[name] = [*faults.get(name, ()), *complaints]
    return Folder(root, files, faults)


def walk(root: Path) -> Iterator[Path]:
    """All files and folders below a folder, through links to other folders as well, each folder once."""
    seen = set()
    for folder, inner, files in os.walk(root, followlinks=True):
        seen.add(os.path.realpath(folder))
        inner[:] = [name for name in inner if os.path.realpath(Path(folder, name)) not in seen]
        yield from (Path(folder, name) for name in (*inner, *files))


def _text_findings(path: Path, content: bytes) -> Iterator[Diagnostic]:
    try:
        content.decode()
    except UnicodeDecodeError as error:  # protoc lets it pass in comments
        line = content.count(b"\n", 0, error.start) + 1
        yield Diagnostic(SourceSpan(shown_path(path), line), Code.BAD_FILE, "the file is not UTF-8")
    if path.suffix == PROTO and not _SYNTAX.search(content):  # protoc would take it for proto2
        hint = 'begin it with `syntax = "proto3";`'
        yield Diagnostic(SourceSpan(shown_path(path)), Code.BAD_PROTO, "the file does not say its syntax", hint)
