"""Runs protoc on the files of a folder, and converts its errors to findings.

The result is a FileDescriptorSet with source info.
"""

from __future__ import annotations

import os
import posixpath
import re
import tempfile
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import grpc_tools
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import _protoc_compiler

from router.assets import asset
from router.errors import Code, Diagnostic, SourceSpan, StartError, TableError, nearest, shown_path
from router.types.proto_files import NANOPB, Folder, declaring, scan
from router.types.proto_source import ProtoText

EVERYTHING = "router_every_proto_of_the_folder.proto"
"""The file that imports all others. Its errors only repeat theirs."""

_IN_MEMORY = "/dev/shm"  # noqa: S108 - Linux's shared memory

_IMPORT_FAILED = re.compile(r'Import "(?P<name>.*)" was not found or had errors\.')
_NUMBER_TAKEN = re.compile(
    r"Field number \d+ has already been used|uses reserved number|Field name \S+ is reserved"
    r"|uses the same enum value as"
)
_SENTENCE_END = re.compile(r"\. +(?=[A-Z])")
_TYPE_TAKEN = re.compile(r'^"(?P<name>[\w.]+)" is already defined(?: in file "[^"]+")?')
_NO_LABEL = re.compile(r'Expected "required", "optional", or "repeated"')
_NOT_DEFINED = re.compile(r'^"(?P<name>[\w.]+)" is not defined\.')
_NOT_IMPORTED = re.compile(r'^"(?P<name>[\w.]+)" seems to be defined in')
_NOT_A_TYPE = re.compile(r'^"(?P<name>[\w.]+)" is not a type')
_SCALARS = ("bool", "float", "double", "int32", "int64", "uint32", "uint64", "string", "bytes")
_MEMBER_TAKEN = re.compile(r'^"\w+" is already defined in "(?P<holder>[\w.]+)"')


@dataclass(frozen=True, slots=True)
class Complaint:
    """One error of protoc: file name relative to the root; line and column from 0, or -1."""

    file: str
    line: int
    column: int
    message: str


def findings_of(complaints: Sequence[Complaint], folder: Folder) -> list[Diagnostic]:
    """Convert errors to findings, in protoc's words except for imports. Omits consequences of other errors."""
    texts = {file: ProtoText(folder.root / file) for file in {complaint.file for complaint in complaints}}
    places: dict[tuple[str, int, int], list[Complaint]] = {}
    findings = []
    for complaint in _without_consequences(complaints, folder.files.keys() | folder.faults.keys()):
        places.setdefault((complaint.file, complaint.line, complaint.column), []).append(complaint)
    for first, *more in places.values():
        finding = _finding(first, folder, texts[first.file])
        # Further messages about the same position are advice, or repetitions.
        advice = [_advice(other.message.rstrip(".")) for other in more if other.message != first.message]
        findings.append(replace(finding, hint=finding.hint or next(iter(advice), "")))
    return list(_once(findings))


def _once(findings: Sequence[Diagnostic]) -> Iterator[Diagnostic]:
    """Yield one finding per mistake in a file; it lists further lines with the same mistake."""
    alike: dict[tuple[str, str, str], list[Diagnostic]] = {}
    for finding in findings:
        alike.setdefault((finding.span.file, finding.message, finding.hint), []).append(finding)
    for first, *more in alike.values():
        lines = [str(other.span.line) for other in more]
        listed = ", ".join(lines[:_MOST_LINES]) + ", ..." * (len(lines) > _MOST_LINES)
        where = f" (and {len(lines)} more, in {'line' if len(lines) == 1 else 'lines'} {listed})" if lines else ""
        yield replace(first, message=first.message + where)


_MOST_LINES = 3
"""Maximum number of further lines in a finding."""


def _without_consequences(complaints: Sequence[Complaint], names: Container[str]) -> Iterator[Complaint]:
    lacking = {complaint.file for complaint in complaints if _IMPORT_FAILED.fullmatch(complaint.message)}
    twice = {taken["name"] for complaint in complaints if (taken := _TYPE_TAKEN.match(complaint.message))}
    for complaint in complaints:
        if complaint.file == EVERYTHING:
            continue
        if (member := _MEMBER_TAKEN.match(complaint.message)) and member["holder"] in twice:
            continue  # its message has a finding already
        if (taken := _TYPE_TAKEN.match(complaint.message)) and taken["name"].rpartition(".")[0] in twice:
            continue  # likewise if the other message is in another file
        used = _NOT_IMPORTED.match(complaint.message)
        meant = used or _NOT_A_TYPE.match(complaint.message)
        if meant and meant["name"] in twice:
            continue  # it refers to the other declaration of that name
        if complaint.file in lacking and (_NOT_DEFINED.match(complaint.message) or used):
            continue  # the failed import would define it
        if (imported := _IMPORT_FAILED.fullmatch(complaint.message)) and imported["name"] in names:
            continue  # the errors of that file are findings already
        if complaint.line < 0 and complaint.file not in names:
            continue  # an imported file that does not exist: the import has a finding
        yield complaint


def _finding(complaint: Complaint, folder: Folder, text: ProtoText) -> Diagnostic:
    files = folder.protos
    if complaint.line < 0:
        return Diagnostic(SourceSpan(shown_path(text.path)), Code.BAD_PROTO, complaint.message.rstrip("."))
    span = text.word(complaint.line, complaint.column)
    if missing := _IMPORT_FAILED.fullmatch(complaint.message):
        others = files.keys() - {complaint.file, *scan(files.get(complaint.file, b"")).imports}
        hint = _import_hint(missing["name"], complaint.file, others, folder.root)
        return Diagnostic(span, Code.BAD_PROTO, f"there is no file '{missing['name']}' to import", hint)
    if undefined := _NOT_DEFINED.match(complaint.message) or _NOT_IMPORTED.match(complaint.message):
        hint = _type_hint(undefined["name"], complaint.file, files)
        return Diagnostic(span, Code.BAD_PROTO, f'"{undefined["name"]}" is not defined', hint)
    if _NO_LABEL.match(complaint.message):
        hint = 'write `optional` before the type, or declare `syntax = "proto3";` if the file is proto3'
        return Diagnostic(span, Code.BAD_PROTO, complaint.message.rstrip("."), hint)
    what, *advice = _SENTENCE_END.split(complaint.message, maxsplit=1)
    return Diagnostic(span, _code(complaint, text), what.rstrip("."), _advice("".join(advice).rstrip(".")))


def _advice(sentence: str) -> str:
    """Return protoc's advice as an imperative, if it is known."""
    if free := re.fullmatch(r"Next available field number is (\d+)", sentence):
        return f"use {free[1]}, the next free number"
    if alias := re.search(r"allow_alias.*next available enum value is (\d+)", sentence):
        return f"use {alias[1]}, the next free number, or write `option allow_alias = true;` in the enum"
    if sentence.startswith("Note that enum values use C++ scoping rules"):
        return "rename the value: enums beside each other need different names for their values"
    return sentence


_OF_GOOGLE = tuple(
    f"google/protobuf/{name}.proto"
    for name in ("any", "descriptor", "duration", "empty", "field_mask", "struct", "timestamp", "wrappers")
)


def _import_hint(name: str, importer: str, files: Collection[str], root: Path) -> str:
    """Return a hint with the file that is meant: beside the importer, of that name elsewhere, or a similar one.

    If there is none, the hint says where the file belongs.
    """
    beside = posixpath.normpath(posixpath.join(posixpath.dirname(importer), name))
    same = [file for file in files if posixpath.basename(file).lower() == posixpath.basename(name).lower()]
    if beside in same:
        return f"imports are relative to the folder of the protos: write '{beside}'"
    if len(same) == 1:
        return f"did you mean '{same[0]}'?"
    if close := nearest(name, same or (*files, *_OF_GOOGLE)):
        return f"did you mean '{close}'?"
    return f"copy it into {shown_path(root)}, the folder that imports are relative to"


def _type_hint(name: str, user: str, files: Mapping[str, bytes]) -> str:
    """Return a hint with the files that declare a type that is not defined where it is used."""
    declarations = declaring(name, files)
    if not declarations:
        names = [known for content in files.values() for known in scan(content).names]
        close = nearest(name, [*names, *_SCALARS])
        return f"did you mean '{close}'?" if close else ""
    imported = scan(files.get(user, b"")).imports
    parts = []
    for file, full in declarations:
        declared = f"{file} declares it" if full == name else f"{file} declares {full}"
        parts.append(declared if file in imported else f'add `import "{file}";`: {declared}')
    return "; ".join(parts)


def _code(complaint: Complaint, text: ProtoText) -> Code:
    if _NUMBER_TAKEN.search(complaint.message):
        return Code.WIRE_NUMBER_CONFLICT
    if _TYPE_TAKEN.search(complaint.message) and text.before(complaint.line, complaint.column).endswith("message"):
        return Code.DUPLICATE_MESSAGE
    return Code.BAD_PROTO


_WELL_KNOWN = Path(grpc_tools.__file__).parent / "_proto"
"""Where grpcio-tools keeps `google/protobuf/*.proto`."""


def shipped(name: str) -> Path:
    """Return the path of a file that is not in the folder of the protos: nanopb's, or one of google/protobuf."""
    return asset("schemas") / NANOPB if name == NANOPB else _WELL_KNOWN / name


def compile_protos(folder: Folder, names: Sequence[str]) -> FileDescriptorSet:
    """Compile the named files and their imports. Return their descriptors, dependencies first.

    Names are relative to the folder, with `/`, in ASCII and without quotes or backslashes. Raises TableError with one
    finding per error of protoc, and StartError.
    """
    with _scratch(folder, names) as include, os.fdopen(os.memfd_create("descriptors"), "rb") as output:
        if complaints := _complaints(include):
            raise TableError(findings_of(complaints, folder))
        written_to = f"/proc/self/fd/{output.fileno()}"
        options = ["--include_imports", "--include_source_info", f"--descriptor_set_out={written_to}"]
        arguments = ["protoc", *(f"--proto_path={path}" for path in include), *options, EVERYTHING]
        if status := _protoc_compiler.run_main([argument.encode() for argument in arguments]):
            message = f"protoc first accepted these files, then failed with status {status}"
            hint = "try again: the files may have changed in the meantime"
            raise TableError.of(SourceSpan(shown_path(folder.root)), Code.BAD_PROTO, message, hint)
        compiled = FileDescriptorSet.FromString(output.read())
    del compiled.file[-1]
    return compiled


def check_protos(folder: Folder, compiled: Sequence[str], names: Sequence[str]) -> Sequence[Complaint]:
    """Return protoc's errors for the named files. The `compiled` ones come first, so that clashes are blamed on others.

    Raises StartError.
    """
    with _scratch(folder, [*compiled, *names]) as include:
        return _complaints(include)


@contextmanager
def _scratch(folder: Folder, names: Sequence[str]) -> Iterator[list[str]]:
    """Provide the include folders for EVERYTHING, in a temporary folder that is removed. Raises StartError."""
    with ExitStack() as ending:
        try:
            try:
                include = _include(ending.enter_context(tempfile.TemporaryDirectory()), folder, names)
            except OSError:  # a router must start on a full disk
                include = _include(ending.enter_context(tempfile.TemporaryDirectory(dir=_IN_MEMORY)), folder, names)
        except OSError as error:
            what = f"protoc needs a temporary folder, but none is writable: {error.strerror}"
            raise StartError(what, "make /tmp writable, or set TMPDIR to a writable folder") from error
        yield include


def _include(scratch: str, folder: Folder, names: Sequence[str]) -> list[str]:
    """Create the file EVERYTHING, which imports the named files. Return the include folders for it."""
    # One file that imports all others makes protoc examine every file even if some are broken.
    # The imports are public, because protoc prints a warning for an unused private one.
    imports = "".join(f'import public "{name}";\n' for name in names)
    everything = Path(scratch, "everything")
    everything.mkdir()
    (everything / EVERYTHING).write_text(f'syntax = "proto3";\n{imports}', encoding="ascii")
    protos, nanopb = Path(scratch, "protos"), Path(scratch, "nanopb")  # names without `:` and `=`, where protoc splits
    protos.symlink_to(folder.root.absolute(), target_is_directory=True)
    nanopb.mkdir()
    (nanopb / NANOPB).symlink_to(shipped(NANOPB))
    return [str(everything), str(protos), str(nanopb), str(_WELL_KNOWN)]


def _complaints(include: Sequence[str]) -> list[Complaint]:
    """Return the errors in the files that EVERYTHING imports.

    `get_protos` returns errors as objects; the ordinary entry point prints them to standard error. It also generates
    Python modules, which costs 3 ms for 27 files. Raises OSError if no descriptor is free: protoc would report missing
    files.
    """
    os.close(os.memfd_create("free"))
    try:
        _protoc_compiler.get_protos(EVERYTHING.encode(), [path.encode() for path in include])
    except _protoc_compiler.ProtocErrors as failure:
        return [
            Complaint(error.filename.decode(), error.line, error.column, error.message.decode())
            for error in failure.errors()
        ]
    return []
