"""Reads the `.proto` and `.options` files of a folder and refuses what protoc would only stumble over.

Knows no syntax beyond a file's first words.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from router.errors import Code, Diagnostic, SourceSpan, TableError, shown_path

PROTO = ".proto"
OPTIONS = ".options"

_HIDDEN = re.compile(r"(^|/)\.")
_FILE_NAME = re.compile(r"[\w ./+,@-]+", re.ASCII)
_SYNTAX = re.compile(rb"^\s*(syntax|edition)\s*=", re.MULTILINE)


def read_folder(root: Path, blame: SourceSpan) -> dict[str, bytes]:
    """The bytes of all files by name relative to `root`, with `/`, sorted. Hidden files are left alone.

    Raises TableError with every finding; what is wrong with the folder itself is blamed on `blame`.
    """
    if not root.is_dir():
        raise TableError([Diagnostic(blame, Code.BAD_FILE, f"there is no folder {shown_path(root)}")])
    found = {
        name: path
        for path in root.rglob("*")
        if path.suffix in (PROTO, OPTIONS) and not _HIDDEN.search(name := path.relative_to(root).as_posix())
    }
    if not any(name.endswith(PROTO) for name in found):
        raise TableError([Diagnostic(blame, Code.BAD_FILE, f"{shown_path(root)} holds no .proto file")])
    files = {}
    findings = []
    for name, path in sorted(found.items()):
        if not _FILE_NAME.fullmatch(name):
            hint = "take letters, digits, '_', '-' and '.'"
            findings.append(Diagnostic(blame, Code.BAD_FILE, f"protoc cannot import a file named {name!a}", hint))
            continue
        try:
            files[name] = path.read_bytes()
        except OSError as error:
            message = f"cannot be read: {error.strerror}"
            findings.append(Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message))
        else:
            findings += _text_findings(path, files[name])
    if findings:
        raise TableError(findings)
    return files


def _text_findings(path: Path, content: bytes) -> Iterator[Diagnostic]:
    try:
        content.decode()
    except UnicodeDecodeError as error:  # protoc lets it pass in comments
        line = content.count(b"\n", 0, error.start) + 1
        yield Diagnostic(SourceSpan(shown_path(path), line), Code.BAD_FILE, "the file is not UTF-8")
    if path.suffix == PROTO and not _SYNTAX.search(content):  # protoc would take it for proto2
        hint = 'begin it with `syntax = "proto3";`'
        yield Diagnostic(SourceSpan(shown_path(path)), Code.BAD_PROTO, "the file does not say its syntax", hint)


def sha256_of(files: Mapping[str, bytes]) -> str:
    """Over names and contents, in the order given."""
    digest = hashlib.sha256()
    for name, content in files.items():
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def folder_sha256(root: Path, blame: SourceSpan) -> str:
    """Of a folder as it is now. Raises TableError, as `read_folder` does."""
    return sha256_of(read_folder(root, blame))
