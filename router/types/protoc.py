"""Runs protoc over a folder of `.proto` files; what protoc complains about becomes findings.

Knows nothing of the type model: it hands on a FileDescriptorSet with source info.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import grpc_tools
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import _protoc_compiler

from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean, shown_path
from router.types.proto_text import ProtoText

WELL_KNOWN = Path(grpc_tools.__file__).parent / "_proto"
"""Where grpcio-tools keeps `google/protobuf/*.proto`."""

_EVERYTHING = "router_every_proto_of_the_folder.proto"
_IMPORT_FAILED = re.compile(r'Import "(?P<name>.*)" was not found or had errors\.')
_NUMBER_TAKEN = re.compile(
    r"Field number \d+ has already been used|uses reserved number|Field name \S+ is reserved"
    r"|uses the same enum value as"
)
_RESERVED = re.compile(r'Field "(?P<field>\w+)" uses reserved number (?P<number>\d+)')
_TYPE_TAKEN = re.compile(r'^"(?P<name>[\w.]+)" is already defined')
_MEMBER_TAKEN = re.compile(r'^"\w+" is already defined in "(?P<holder>[\w.]+)"')


@dataclass(frozen=True, slots=True)
class _Complaint:
    """One error of protoc: file name relative to the root; line and column from 0, -1 for neither."""

    file: str
    line: int
    column: int
    message: str


def compile_protos(root: Path, names: Sequence[str]) -> FileDescriptorSet:
    """The descriptors of the named files and of what they import, dependencies first.

    Names are relative to `root`, with `/`, in ASCII and without quotes or backslashes.
    Raises TableError with one finding for each error of protoc.
    """
    with tempfile.TemporaryDirectory() as scratch:
        # One file that imports all others makes protoc go through every file although some are broken.
        # Public imports, because protoc prints a warning for an unused private one.
        imports = "".join(f'import public "{name}";\n' for name in names)
        everything = Path(scratch, "everything")
        everything.mkdir()
        (everything / _EVERYTHING).write_text(f'syntax = "proto3";\n{imports}', encoding="ascii")
        folder = Path(scratch, "protos")  # a name without `:` and `=`, at which protoc splits
        folder.symlink_to(root.absolute(), target_is_directory=True)
        include = [str(everything), str(folder), str(WELL_KNOWN)]
        _refuse_errors(root, names, include)
        output = Path(scratch, "descriptors")
        options = ["--include_imports", "--include_source_info", f"--descriptor_set_out={output}"]
        arguments = ["protoc", *(f"--proto_path={path}" for path in include), *options, _EVERYTHING]
        if status := _protoc_compiler.run_main([argument.encode() for argument in arguments]):
            raise RuntimeError(f"protoc accepted {root} at first, then failed with status {status}")
        compiled = FileDescriptorSet.FromString(output.read_bytes())
    del compiled.file[-1]
    return compiled


def _refuse_errors(root: Path, names: Sequence[str], include: Sequence[str]) -> None:
    """Raise TableError for what is wrong with the files.

    `get_protos` returns errors as objects, where the ordinary entry point prints them to the process's
    standard error. It makes Python modules too, but that costs 3 ms for 27 files.
    """
    try:
        _protoc_compiler.get_protos(_EVERYTHING.encode(), [path.encode() for path in include])
    except _protoc_compiler.ProtocErrors as failure:
        complaints = [
            _Complaint(error.filename.decode(), error.line, error.column, error.message.decode())
            for error in failure.errors()
        ]
        raise TableError(_findings(root, names, complaints)) from None


def _findings(root: Path, names: Sequence[str], complaints: Sequence[_Complaint]) -> list[Diagnostic]:
    texts: dict[str, ProtoText] = {}
    findings: dict[tuple[str, int, int], Diagnostic] = {}
    lacking = {complaint.file for complaint in complaints if _IMPORT_FAILED.fullmatch(complaint.message)}
    twice = {found["name"] for complaint in complaints if (found := _TYPE_TAKEN.match(complaint.message))}
    for complaint in complaints:
        if complaint.file == _EVERYTHING:
            continue
        if (member := _MEMBER_TAKEN.match(complaint.message)) and member["holder"] in twice:
            continue  # its message is a finding, and so would be all its fields
        if complaint.file in lacking and complaint.message.endswith(" is not defined."):
            continue  # it would be, by the import
        place = (complaint.file, complaint.line, complaint.column)
        if (first := findings.get(place)) is not None:  # protoc's advice, or the same again
            advice = complaint.message.rstrip(".")
            if not first.hint and advice != first.message:
                findings[place] = replace(first, hint=advice)
            continue
        missing = _IMPORT_FAILED.fullmatch(complaint.message)
        if missing and missing["name"] in names:
            continue  # that file's own errors are findings already
        if complaint.line < 0 and complaint.file not in names:
            continue  # an imported file that does not exist; the import is a finding
        text = texts.setdefault(complaint.file, ProtoText(root / complaint.file))
        findings[place] = _finding(complaint, missing["name"] if missing else None, names, text)
    return list(findings.values())


def _finding(complaint: _Complaint, missing: str | None, names: Sequence[str], text: ProtoText) -> Diagnostic:
    if complaint.line < 0:
        return Diagnostic(SourceSpan(shown_path(text.path)), Code.BAD_PROTO, complaint.message.rstrip("."))
    span = text.word(complaint.line, complaint.column)
    if reserved := _RESERVED.match(complaint.message):  # protoc blames the `reserved`, not who breaks it
        span = text.nearest(rf"\b{reserved['field']}\s*=\s*{reserved['number']}\b", complaint.line) or span
    if missing is not None:
        return Diagnostic(span, Code.BAD_PROTO, f"there is no file '{missing}' to import", did_you_mean(missing, names))
    what, _, advice = complaint.message.partition(". ")
    return Diagnostic(span, _code(complaint, text), what.rstrip("."), advice.rstrip("."))


def _code(complaint: _Complaint, text: ProtoText) -> Code:
    if _NUMBER_TAKEN.search(complaint.message):
        return Code.WIRE_NUMBER_CONFLICT
    if _TYPE_TAKEN.search(complaint.message) and text.before(complaint.line, complaint.column).endswith("message"):
        return Code.DUPLICATE_MESSAGE
    return Code.BAD_PROTO
