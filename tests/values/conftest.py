"""A payload with a field of every kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.datagrams import wire_of_protos
from router.types.protobuf import PayloadCase

PROTOS = Path(__file__).parents[1] / "protos"


@pytest.fixture(scope="session")
def every_kind() -> PayloadCase:
    return wire_of_protos(PROTOS).case("every_kind")
