"""Folders of `.proto` and `.msg` files written by the test, and functions to load them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from router.errors import Diagnostic, Located, SourceSpan, TableError
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.tables import PROTOS

ONEOF = Located("payload", SourceSpan("table.yaml", 4, 10))
Write = Callable[[Mapping[str, str]], Path]
Load = Callable[[Mapping[str, str]], ProtoSchema]
Refused = Callable[[Mapping[str, str]], tuple[Diagnostic, ...]]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write files by name into the working directory, so that findings name them without a folder."""
    monkeypatch.chdir(tmp_path)

    def write_files(files: Mapping[str, str]) -> Path:
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="")
        return tmp_path

    return write_files


@pytest.fixture
def load(write: Write) -> Load:
    return lambda files: load_protos(*settings(with_envelope(write(files))))


@pytest.fixture
def refused(write: Write) -> Refused:
    """The findings of a folder that cannot be loaded."""
    return lambda files: refusal(with_envelope(write(files)))


def refusal(root: Path, message: str = "Envelope") -> tuple[Diagnostic, ...]:
    """The findings of a folder that cannot be loaded."""
    with pytest.raises(TableError) as caught:
        load_protos(*settings(root, message))
    return caught.value.diagnostics


def with_envelope(root: Path) -> Path:
    """Add a file that declares `Envelope` and imports all others, unless one of them declares it. Return the folder."""
    own = root / "zz_envelope.proto"
    texts = {path: path.read_bytes() for path in root.rglob("*.proto") if path != own}
    if not any(b"message Envelope" in text for text in texts.values()):
        imports = "".join(f'import "{path.relative_to(root).as_posix()}";\n' for path in sorted(texts))
        own.write_text(f'syntax = "proto3";\n{imports}message Envelope {{}}\n', encoding="utf-8")
    return root


def settings(root: Path, message: str = "Envelope") -> tuple[Located[Path], Located[str]]:
    """The folder and the envelope's name as in a table."""
    return Located(root, SourceSpan("table.yaml", 2, 1)), Located(message, SourceSpan("table.yaml", 3, 12))


def proto(body: str) -> str:
    return f'syntax = "proto3";\n{body}\n'


@pytest.fixture(scope="session")
def rover_schema() -> ProtoSchema:
    return load_protos(*settings(PROTOS, "PBEnvelope"))


@pytest.fixture(scope="session")
def rover_envelope(rover_schema: ProtoSchema) -> Envelope:
    return find_envelope(rover_schema, ONEOF)


def nanopb_headers(root: Path, output: Path) -> str:
    """The headers that nanopb's generator makes, in a process of its own: nanopb fills the default pool."""
    output.mkdir(exist_ok=True)
    names = [path.relative_to(root).as_posix() for path in sorted(root.rglob("*.proto"))]
    command = [sys.executable, "-m", "nanopb.generator.nanopb_generator", "-q", "-I", str(root), "-D", str(output)]
    subprocess.run([*command, *names], cwd=root, check=True, capture_output=True, timeout=60)
    return "\n".join(path.read_text() for path in sorted(output.rglob("*.pb.h")))
