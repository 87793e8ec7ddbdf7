"""The wire types of `protos/`, compiled once."""

from __future__ import annotations

import pytest

from router.errors import Located, SourceSpan
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.tables import PROTOS

_HERE = SourceSpan(__file__)


@pytest.fixture(scope="session")
def schema() -> ProtoSchema:
    return load_protos(Located(PROTOS, _HERE), Located("PBEnvelope", _HERE))


@pytest.fixture(scope="session")
def envelope(schema: ProtoSchema) -> Envelope:
    return find_envelope(schema, Located("payload", _HERE))
