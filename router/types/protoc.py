"""Runs protoc over files of a folder of `.proto` files.

Knows nothing of the type model: it hands on a FileDescriptorSet with source info.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import grpc_tools
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import _protoc_compiler

from router.errors import Code, Diagnostic, SourceSpan, TableError, shown_path
from router.types.proto_folder import Folder
from router.types.protoc_errors import EVERYTHING, Complaint, findings_of

WELL_KNOWN = Path(grpc_tools.__file__).parent / "_proto"
"""Where grpcio-tools keeps `google/protobuf/*.proto`."""


def compile_protos(folder: Folder, names: Sequence[str], homes: Mapping[str, str]) -> FileDescriptorSet:
    """The descriptors of the named files and of what they import, dependencies first.

    Names are relative to the folder, with `/`, in ASCII and without quotes or backslashes. `homes`
    says which file a message is known to belong to: a second one of that name is blamed elsewhere.
    Raises TableError with one finding for each error of protoc.
    """
    with tempfile.TemporaryDirectory() as scratch:
        include = _include(scratch, folder, names)
        if complaints := _complaints(include):
            raise TableError(findings_of(complaints, folder, homes))
        output = Path(scratch, "descriptors")
        options = ["--include_imports", "--include_source_info", f"--descriptor_set_out={output}"]
        arguments = ["protoc", *(f"--proto_path={path}" for path in include), *options, EVERYTHING]
        if status := _protoc_compiler.run_main([argument.encode() for argument in arguments]):
            message = f"protoc accepted these files at first, and then failed with status {status}"
            hint = "perhaps they changed meanwhile: try again"
            raise TableError([Diagnostic(SourceSpan(shown_path(folder.root)), Code.BAD_PROTO, message, hint)])
        compiled = FileDescriptorSet.FromString(output.read_bytes())
    del compiled.file[-1]
    return compiled


def check_protos(folder: Folder, compiled: Sequence[str], names: Sequence[str]) -> Sequence[Complaint]:
    """What protoc says against the named files; those that were `compiled` come first, so that none of them clashes."""
    with tempfile.TemporaryDirectory() as scratch:
        return _complaints(_include(scratch, folder, [*compiled, *names]))


def _include(scratch: str, folder: Folder, names: Sequence[str]) -> list[str]:
    """The folders in which protoc finds EVERYTHING, which imports the named files, and whatever they import."""
    # One file that imports all others makes protoc go through every file although some are broken.
    # Public imports, because protoc prints a warning for an unused private one.
    imports = "".join(f'import public "{name}";\n' for name in names)
    everything = Path(scratch, "everything")
    everything.mkdir()
    (everything / EVERYTHING).write_text(f'syntax = "proto3";\n{imports}', encoding="ascii")
    protos = Path(scratch, "protos")  # a name without `:` and `=`, at which protoc splits
    protos.symlink_to(folder.root.absolute(), target_is_directory=True)
    return [str(everything), str(protos), str(WELL_KNOWN)]


def _complaints(include: Sequence[str]) -> list[Complaint]:
    """What is wrong with the files that EVERYTHING imports.

    `get_protos` returns errors as objects, where the ordinary entry point prints them to the process's
    standard error. It makes Python modules too, but that costs 3 ms for 27 files.
    """
    try:
        _protoc_compiler.get_protos(EVERYTHING.encode(), [path.encode() for path in include])
    except _protoc_compiler.ProtocErrors as failure:
        return [
            Complaint(error.filename.decode(), error.line, error.column, error.message.decode())
            for error in failure.errors()
        ]
    return []
