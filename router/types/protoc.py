"""Runs protoc over a folder of `.proto` files.

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
from router.types.protoc_errors import EVERYTHING, Complaint, findings_of

WELL_KNOWN = Path(grpc_tools.__file__).parent / "_proto"
"""Where grpcio-tools keeps `google/protobuf/*.proto`."""


def compile_protos(root: Path, names: Sequence[str], homes: Mapping[str, str]) -> FileDescriptorSet:
    """The descriptors of the named files and of what they import, dependencies first.

    Names are relative to `root`, with `/`, in ASCII and without quotes or backslashes. `homes`
    says which file a message is known to belong to: a second one of that name is blamed elsewhere.
    Raises TableError with one finding for each error of protoc.
    """
    with tempfile.TemporaryDirectory() as scratch:
        # One file that imports all others makes protoc go through every file although some are broken.
        # Public imports, because protoc prints a warning for an unused private one.
        imports = "".join(f'import public "{name}";\n' for name in names)
        everything = Path(scratch, "everything")
        everything.mkdir()
        (everything / EVERYTHING).write_text(f'syntax = "proto3";\n{imports}', encoding="ascii")
        folder = Path(scratch, "protos")  # a name without `:` and `=`, at which protoc splits
        folder.symlink_to(root.absolute(), target_is_directory=True)
        include = [str(everything), str(folder), str(WELL_KNOWN)]
        _refuse_errors(root, names, homes, include)
        output = Path(scratch, "descriptors")
        options = ["--include_imports", "--include_source_info", f"--descriptor_set_out={output}"]
        arguments = ["protoc", *(f"--proto_path={path}" for path in include), *options, EVERYTHING]
        if status := _protoc_compiler.run_main([argument.encode() for argument in arguments]):
            message = f"protoc accepted these files at first, and then failed with status {status}"
            hint = "perhaps they changed meanwhile: try again"
            raise TableError([Diagnostic(SourceSpan(shown_path(root)), Code.BAD_PROTO, message, hint)])
        compiled = FileDescriptorSet.FromString(output.read_bytes())
    del compiled.file[-1]
    return compiled


def _refuse_errors(root: Path, names: Sequence[str], homes: Mapping[str, str], include: Sequence[str]) -> None:
    """Raise TableError for what is wrong with the files.

    `get_protos` returns errors as objects, where the ordinary entry point prints them to the process's
    standard error. It makes Python modules too, but that costs 3 ms for 27 files.
    """
    try:
        _protoc_compiler.get_protos(EVERYTHING.encode(), [path.encode() for path in include])
    except _protoc_compiler.ProtocErrors as failure:
        complaints = [
            Complaint(error.filename.decode(), error.line, error.column, error.message.decode())
            for error in failure.errors()
        ]
        raise TableError(findings_of(complaints, root, names, homes)) from None
