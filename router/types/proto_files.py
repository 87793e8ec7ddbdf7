"""A folder of `.proto` files: texts, problems for which protoc has no good message, and the file of the envelope.

Declarations and imports are found without a compiler, so this also works for files that do not compile.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path, PurePosixPath

from router import inputs
from router.errors import Code, Diagnostic, Located, SourceSpan, TableError, did_you_mean, nearest_path, shown_path
from router.types.lock_file import Lock

PROTO = ".proto"
OPTIONS = ".options"
NANOPB = "nanopb.proto"
"""The file that declares nanopb's options; the router has one for folders without."""

_FILE_NAME = re.compile(r"[\w ./+,@-]+", re.ASCII)
_SYNTAX = re.compile(rb"^(?:\xef\xbb\xbf|\s|/\*.*?\*/)*(?:syntax|edition)\s*=", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Folder:
    """The files of a folder. `files` has the bytes of all readable ones, sorted by name relative to `root`, with `/`.

    `faults` are the findings of files, readable or not, by the same names. `excluded` has the names of files that are
    in neither, with the entry of `exclude` that excludes them.
    """

    root: Path
    files: Mapping[str, bytes]
    faults: Mapping[str, Sequence[Diagnostic]]
    excluded: Mapping[str, Located[str]] = field(default_factory=dict)

    @property
    def protos(self) -> Mapping[str, bytes]:
        return {name: content for name, content in self.files.items() if name.endswith(PROTO)}

    @cached_property
    def sha256(self) -> str:
        """The hash of names and contents."""
        digest = sha256()
        for name, content in self.files.items():
            digest.update(os.fsencode(f"{name}\0{len(content)}\0"))
            digest.update(content)
        return digest.hexdigest()


def _meant(root: Path, blame: SourceSpan) -> str:
    """Return a hint for a missing folder that the table names at `blame`."""
    path = Path(inputs.real_path(root))
    if inputs.is_file(path):
        return "that is a file: name its folder"
    beside_table = path.parent.parent / path.name  # of a table in routes/
    near = next(
        (folder for folder in (nearest_path(path), beside_table) if folder is not None and inputs.is_dir(folder)), None
    )
    if near is None:
        return "paths are relative to the table"
    return f"did you mean '{Path(os.path.relpath(near, Path(inputs.real_path(blame.file)).parent)).as_posix()}'?"


def read_folder(root: Path, blame: SourceSpan, exclude: Sequence[Located[str]] = ()) -> Folder:
    """Read the `.proto` and `.options` files below `root`, except hidden ones and those in `exclude`.

    Findings about the folder itself, or about a file's name, point at `blame`. Raises TableError for an invalid folder,
    and for entries of `exclude` that match nothing.
    """
    if not inputs.is_dir(root):
        raise TableError.of(blame, Code.BAD_FILE, f"there is no folder {inputs.real_path(root)}", _meant(root, blame))
    paths = {path.relative_to(root).as_posix(): path for path in walk(root) if path.suffix in (PROTO, OPTIONS)}
    if not any(name.endswith(PROTO) for name in paths):
        raise TableError.of(blame, Code.BAD_FILE, f"{shown_path(root)} contains no .proto file")
    excluded = _excluded(root, paths, exclude)
    files = {}
    faults: dict[str, Sequence[Diagnostic]] = {}
    for name, path in sorted(paths.items()):
        if name in excluded:
            continue
        if not _FILE_NAME.fullmatch(name):
            hint = "use only letters, digits, '_', '-' and '.'"
            faults[name] = [Diagnostic(blame, Code.BAD_FILE, f"protoc cannot import a file named {name!a}", hint)]
        try:
            files[name] = inputs.read_bytes(path)
        except OSError as error:
            message = f"the file cannot be read: {error.strerror}"
            faults[name] = [Diagnostic(SourceSpan(shown_path(path)), Code.BAD_FILE, message)]
        else:
            if complaints := list(_text_findings(path, files[name])):
                faults[name] = [*faults.get(name, ()), *complaints]
    return Folder(root, files, faults, excluded)


def _excluded(root: Path, names: Iterable[str], exclude: Sequence[Located[str]]) -> Mapping[str, Located[str]]:
    """Return the excluded files, a `.proto` with its `.options`, and the entries that exclude them.

    Raises TableError.
    """
    excluded: dict[str, Located[str]] = {}
    findings = []
    for entry in exclude:
        written = entry.value.rstrip("/")
        covered = [name for name in names if written in (proto_of(name), name) or name.startswith(f"{written}/")]
        excluded.update(dict.fromkeys(covered, entry))
        if not covered:
            hint = _exclude_hint(written, [name for name in names if name.endswith(PROTO)])
            what = f"{shown_path(root)} has no file or folder '{entry.value}' to exclude"
            findings.append(Diagnostic(entry.span, Code.BAD_FILE, what, hint))
    if findings:
        raise TableError(findings)
    return excluded


def _exclude_hint(written: str, protos: Sequence[str]) -> str:
    """Return a hint with the file that is meant: one of this name in another folder, or a similar one."""
    same = [name for name in protos if PurePosixPath(name).name == PurePosixPath(written).name]
    return f"did you mean '{same[0]}'?" if len(same) == 1 else did_you_mean(written, same or protos)


def proto_of(name: str) -> str:
    """Return the `.proto` file of a `.proto` or `.options` file."""
    return name.removesuffix(OPTIONS) + PROTO if name.endswith(OPTIONS) else name


def walk(root: Path) -> Iterator[Path]:
    """Yield all files and folders below a folder once, except hidden ones. Follows links to other folders."""
    seen = set()
    waiting = [root]
    while waiting:
        folder = waiting.pop()
        seen.add(inputs.real_path(folder))
        names, files = inputs.listing(folder)
        inner = [path for name in names if inputs.real_path(path := folder / name) not in seen]
        yield from (*inner, *(folder / name for name in files))
        waiting += reversed(inner)


def _text_findings(path: Path, content: bytes) -> Iterator[Diagnostic]:
    try:
        content.decode()
    except UnicodeDecodeError as error:  # protoc accepts it in comments
        line = content.count(b"\n", 0, error.start) + 1
        yield Diagnostic(SourceSpan(shown_path(path), line), Code.BAD_FILE, "the file is not UTF-8")
    if path.suffix == PROTO and not _SYNTAX.search(content):  # protoc would treat it as proto2
        hint = 'start it with `syntax = "proto3";`'
        yield Diagnostic(SourceSpan(shown_path(path)), Code.BAD_PROTO, "the file does not declare its syntax", hint)


_TOKEN = re.compile(
    rb"""(?P<comment>//[^\n]*|/\*.*?(?:\*/|\Z))"""
    rb"""|"(?:\\.|[^"\\\n])*"?|'(?:\\.|[^'\\\n])*'?|[\w.]+|[{};]""",
    re.DOTALL,
)
_SIGNS = frozenset("{;}")


@dataclass(frozen=True, slots=True)
class Scanned:
    """The declarations of a file: full `names` of all messages and enums, nested ones included, and of `messages`."""

    package: str
    names: tuple[str, ...]
    messages: frozenset[str]
    imports: tuple[str, ...]

    def is_top_level(self, name: str) -> bool:
        return "." not in name.removeprefix(f"{self.package}." if self.package else "")


@lru_cache(maxsize=64)
def scan(content: bytes) -> Scanned:
    """Return the declarations and imports of a file, in order. Cached, because each file is examined several times."""
    package = ""
    names: list[str] = []
    messages: set[str] = set()
    imports: list[str] = []
    blocks: list[str] = []  # for each open brace, the full name of the innermost message
    for statement, opens in _statements(content):
        match statement:
            case ["package", name] if not blocks:  # an option of nanopb has the same name
                package = name
            case ["import", *_, name]:
                imports.append(name.strip("\"'"))
            case [*_, ("message" | "enum") as kind, name] if opens:  # `export` or `local` may precede it
                around = blocks[-1] if blocks else package
                names.append(f"{around}.{name}" if around else name)
                if kind == "message":
                    messages.add(names[-1])
                blocks.append(names[-1])
                continue
            case ["}"]:
                del blocks[-1:]
        if opens:
            blocks.append(blocks[-1] if blocks else package)
    return Scanned(package, tuple(names), frozenset(messages), tuple(imports))


def _statements(content: bytes) -> Iterator[tuple[list[str], bool]]:
    """Yield the words before each `;` or brace, and whether a block begins there. A `}` is its own statement."""
    words: list[str] = []
    for match in _TOKEN.finditer(content):
        if match["comment"]:
            continue
        word = match[0].decode(errors="replace")
        if word not in _SIGNS:
            words.append(word)
            continue
        yield words, word == "{"
        words = []
        if word == "}":
            yield ["}"], False


def declaring(name: str, files: Mapping[str, bytes]) -> list[tuple[str, str]]:
    """Return the files that declare a message or an enum of this full or short name, each with the full name."""
    short = re.compile(rb"\b" + re.escape(name.rpartition(".")[2].encode()) + rb"\b")
    return [
        (file, full)
        for file, content in files.items()
        if short.search(content)
        for full in scan(content).names
        if full == name or full.endswith(f".{name}")
    ]


def reached(start: str, files: Mapping[str, bytes]) -> set[str]:
    """Return the file and all that it imports, directly or indirectly, existing or not."""
    seen: set[str] = set()
    waiting: Iterable[str] = [start]
    while waiting:
        seen.update(waiting)
        waiting = {name for file in waiting for name in scan(files.get(file, b"")).imports} - seen
    return seen


_FURTHER_UP = 4
_OF_PROTOBUF = "google/protobuf/"


ANY, _FILE_OF_ANY = "google.protobuf.Any", "google/protobuf/any.proto"
"""An envelope of protobuf's own, which no file of the folder has to import."""


def envelope_file(folder: Folder, protos: Located[Path], message: Located[str], locked: Lock | None) -> tuple[str, str]:
    """Return the file that declares the envelope, and its full name there. Prefers the one in the lock.

    Raises TableError if there is none, if several match, or if `protos` is the wrong folder.
    """
    wanted = message.value
    declared = declaring(wanted, folder.protos)
    declarations = [(file, name) for file, name in declared if name in scan(folder.files[file]).messages]
    if not declarations and wanted == ANY:
        return _FILE_OF_ANY, ANY
    if not declarations:
        raise TableError(_missing(folder, protos, message))
    envelope = locked.messages.get(locked.message) if locked is not None else None

    def rank(declaration: tuple[str, str]) -> tuple[bool, bool, bool]:
        file, name = declaration
        is_locked = envelope is not None and file == envelope.file
        return is_locked, name == wanted, scan(folder.files[file]).is_top_level(name)

    best = max(map(rank, declarations))
    declarations = [*dict.fromkeys(declaration for declaration in declarations if rank(declaration) == best)]
    if len(declarations) > 1:
        files = " and ".join(file for file, _ in declarations)
        what = f"several files declare a message '{wanted}': {files}"
        hint = "remove all but one, or write the full name if they have packages"
        raise TableError.of(message.span, Code.DUPLICATE_MESSAGE, what, hint)
    file, name = declarations[0]
    if (above := _folder_above(folder, file)) is not None:
        raise TableError([_too_deep(folder, protos, above, file)])
    return file, name


def _missing(folder: Folder, protos: Located[Path], wanted: Located[str]) -> list[Diagnostic]:
    """Return findings for a missing envelope, and for unreadable files, which may declare it."""
    for file in folder.protos:
        if (above := _folder_above(folder, file)) is not None:
            return [_too_deep(folder, protos, above, file)]
    hint = did_you_mean(wanted.value, [name for content in folder.protos.values() for name in scan(content).messages])
    message = f"no .proto file declares a message '{wanted.value}'"
    if folder.excluded:
        hint = f"is it in a file that `exclude` leaves out ({', '.join(folder.excluded)})?"
    faults = [fault for faults in folder.faults.values() for fault in faults]
    return [Diagnostic(wanted.span, Code.BAD_VALUE, message, hint), *faults]


def _imports(content: bytes) -> list[str]:
    return [name for name in scan(content).imports if name != NANOPB and not name.startswith(_OF_PROTOBUF)]


def _folder_above(folder: Folder, file: str) -> Path | None:
    """Return the parent folder that the imports of a file are relative to, or None."""
    imports = _imports(folder.files[file])
    if not imports or any(name in folder.files or name in folder.faults for name in imports):
        return None
    above = folder.root.parents[:_FURTHER_UP]
    return next((parent for parent in above if all(inputs.is_file(parent / name) for name in imports)), None)


def _too_deep(folder: Folder, protos: Located[Path], right: Path, file: str) -> Diagnostic:
    steps = len(folder.root.relative_to(right).parts)
    count = {1: "one folder", 2: "two folders"}.get(steps, f"{steps} folders")
    message = f"`protos` is {count} too deep: {file} imports '{_imports(folder.files[file])[0]}'"
    table = Path(protos.span.file)
    shown = os.path.relpath(right, table.absolute().parent) if inputs.is_file(table) else shown_path(right)
    return Diagnostic(protos.span, Code.BAD_VALUE, message, f"use {shown}, because imports are relative to it")
