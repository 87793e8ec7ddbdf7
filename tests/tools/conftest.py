from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from router.tools.wire import Wire, wire_of_protos
from router.types.protobuf import PayloadCase

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def protos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `every_kind.proto` alone."""
    folder = tmp_path_factory.mktemp("protos")
    shutil.copy(HERE / "every_kind.proto", folder)
    return folder


@pytest.fixture(scope="session")
def wire(protos: Path) -> Wire:
    return wire_of_protos(protos)


@pytest.fixture(scope="session")
def every_kind(wire: Wire) -> PayloadCase:
    return wire.case("every_kind")
