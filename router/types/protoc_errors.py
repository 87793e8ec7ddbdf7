"""What protoc complains about, as findings.

Knows protoc's sentences; how protoc is run is `protoc`'s business.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from router.errors import Code, Diagnostic, SourceSpan, did_you_mean, nearest, shown_path
from router.types.proto_folder import Folder
from router.types.proto_scan import declaring, scan
from router.types.proto_text import ProtoText

EVERYTHING = "router_every_proto_of_the_folder.proto"
"""The file that imports all others; its own errors only repeat theirs."""

_IMPORT_FAILED = re.compile(r'Import "(?P<name>.*)" was not found or had errors\.')
_NUMBER_TAKEN = re.compile(
    r"Field number \d+ has already been used|uses reserved number|Field name \S+ is reserved"
    r"|uses the same enum value as"
)
_RESERVED = re.compile(r'Field "(?P<field>\w+)" uses reserved number (?P<number>\d+)')
_TYPE_TAKEN = re.compile(r'^"(?P<name>[\w.]+)" is already defined(?: in file "(?P<other>[^"]+)")?')
_NOT_DEFINED = re.compile(r'^"(?P<name>[\w.]+)" is not defined\.')
_NOT_IMPORTED = re.compile(r'^"(?P<name>[\w.]+)" seems to be defined in')
_NOT_A_TYPE = re.compile(r'^"(?P<name>[\w.]+)" is not a type')
_MEMBER_TAKEN = re.compile(r'^"\w+" is already defined in "(?P<holder>[\w.]+)"')


@dataclass(frozen=True, slots=True)
class Complaint:
    """One error of protoc: file name relative to the root; line and column from 0, -1 for neither."""

    file: str
    line: int
    column: int
    message: str


def findings_of(complaints: Sequence[Complaint], folder: Folder, homes: Mapping[str, str]) -> list[Diagnostic]:
    """One finding for each fault; what only follows from another one is left out.

    Of two messages of one name, the one that is not where `homes` has it is blamed.
    """
    texts = {file: ProtoText(folder.root / file) for file in {complaint.file for complaint in complaints}}
    places: dict[tuple[str, int, int], list[Complaint]] = {}
    findings = []
    merging = set()
    for complaint in _without_consequences(complaints, folder.files.keys() | folder.faults.keys()):
        if complaint.file in merging:
            continue
        if (span := texts[complaint.file].merge_mark(complaint.line)) is not None:
            merging.add(complaint.file)
            hint = "keep what is right of both sides and delete the marks"
            findings.append(Diagnostic(span, Code.BAD_PROTO, "an unresolved merge", hint))
        else:
            places.setdefault((complaint.file, complaint.line, complaint.column), []).append(complaint)
    for first, *more in places.values():
        finding = _newcomer(first, folder.root, homes) or _finding(first, folder.protos, texts[first.file])
        # What else protoc says about the same place is advice, or the same again.
        advice = [other.message.rstrip(".") for other in more if other.message != first.message]
        findings.append(replace(finding, hint=finding.hint or next(iter(advice), "")))
    return findings


def _without_consequences(complaints: Sequence[Complaint], names: Container[str]) -> Iterator[Complaint]:
    lacking = {complaint.file for complaint in complaints if _IMPORT_FAILED.fullmatch(complaint.message)}
    twice = {found["name"] for complaint in complaints if (found := _TYPE_TAKEN.match(complaint.message))}
    for complaint in complaints:
        if complaint.file == EVERYTHING:
            continue
        if (member := _MEMBER_TAKEN.match(complaint.message)) and member["holder"] in twice:
            continue  # its message is a finding, and so would be all its fields
        if (taken := _TYPE_TAKEN.match(complaint.message)) and taken["name"].rpartition(".")[0] in twice:
            continue  # so too where the other message is in another file
        used = _NOT_IMPORTED.match(complaint.message)
        meant = used or _NOT_A_TYPE.match(complaint.message)
        if meant and meant["name"] in twice:
            continue  # it means the other declaration of that name
        if complaint.file in lacking and (_NOT_DEFINED.match(complaint.message) or used):
            continue  # it would be, by the import
        if (imported := _IMPORT_FAILED.fullmatch(complaint.message)) and imported["name"] in names:
            continue  # that file's own errors are findings already
        if complaint.line < 0 and complaint.file not in names:
            continue  # an imported file that does not exist; the import is a finding
        yield complaint


def _finding(complaint: Complaint, files: Mapping[str, bytes], text: ProtoText) -> Diagnostic:
    if complaint.line < 0:
        return Diagnostic(SourceSpan(shown_path(text.path)), Code.BAD_PROTO, complaint.message.rstrip("."))
    span = text.word(complaint.line, complaint.column)
    if reserved := _RESERVED.match(complaint.message):  # protoc blames the `reserved`, not who breaks it
        span = text.nearest(rf"\b{reserved['field']}\s*=\s*{reserved['number']}\b", complaint.line) or span
    if missing := _IMPORT_FAILED.fullmatch(complaint.message):
        others = files.keys() - {complaint.file, *scan(files.get(complaint.file, b"")).imports}
        hint = _import_hint(missing["name"], complaint.file, others)
        return Diagnostic(span, Code.BAD_PROTO, f"there is no file '{missing['name']}' to import", hint)
    if undefined := _NOT_DEFINED.match(complaint.message) or _NOT_IMPORTED.match(complaint.message):
        hint = _type_hint(undefined["name"], complaint.file, files)
        return Diagnostic(span, Code.BAD_PROTO, f'"{undefined["name"]}" is not defined', hint)
    what, _, advice = complaint.message.partition(". ")
    return Diagnostic(span, _code(complaint, text), what.rstrip("."), advice.rstrip("."))


def _import_hint(name: str, importer: str, files: Collection[str]) -> str:
    """Which of `files`, not imported yet, is meant: beside the importing one, or of that name elsewhere, or similar."""
    beside = posixpath.normpath(posixpath.join(posixpath.dirname(importer), name))
    same = [file for file in files if posixpath.basename(file).lower() == posixpath.basename(name).lower()]
    if beside in same:
        return f"imports are relative to the folder of the protos: write '{beside}'"
    if len(same) == 1:
        return f"did you mean '{same[0]}'?"
    return did_you_mean(name, same or files)


def _type_hint(name: str, user: str, files: Mapping[str, bytes]) -> str:
    """Which files declare a type that is not defined where it is used."""
    found = declaring(name, files)
    if not found:
        close = nearest(name, [known for content in files.values() for known in scan(content).names])
        return f"did you mean '{close}'?" if close else ""
    imported = scan(files.get(user, b"")).imports
    parts = []
    for file, full in found:
        declared = f"{file} declares it" if full == name else f"{file} declares {full}"
        parts.append(declared if file in imported else f'{declared}: `import "{file}";` is missing')
    return "; ".join(parts)


def _newcomer(complaint: Complaint, root: Path, homes: Mapping[str, str]) -> Diagnostic | None:
    """protoc blames the file that comes last in the alphabet; where that one had the message first, blame the other."""
    taken = _TYPE_TAKEN.match(complaint.message)
    if taken is None or taken["other"] is None or homes.get(taken["name"]) != complaint.file:
        return None
    short = taken["name"].rpartition(".")[2]
    span = ProtoText(root / taken["other"]).nearest(rf"(?<=\bmessage ){short}\b|\b{short}\b(?=\s*=)", 0)
    message = f'"{taken["name"]}" is already defined in file "{complaint.file}"'
    return Diagnostic(span, Code.DUPLICATE_MESSAGE, message) if span is not None else None


def _code(complaint: Complaint, text: ProtoText) -> Code:
    if _NUMBER_TAKEN.search(complaint.message):
        return Code.WIRE_NUMBER_CONFLICT
    if _TYPE_TAKEN.search(complaint.message) and text.before(complaint.line, complaint.column).endswith("message"):
        return Code.DUPLICATE_MESSAGE
    return Code.BAD_PROTO
