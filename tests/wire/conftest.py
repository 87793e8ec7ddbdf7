"""The wire types of `protos/`, compiled once."""

from __future__ import annotations

import pytest

from router.errors import Located, SourceSpan
from router.table.model import EnvelopeSettings
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.tables import PROTOS

_HERE = SourceSpan(__file__)
_SETTINGS = EnvelopeSettings(
    protos=Located(PROTOS, _HERE), message=Located("PBEnvelope", _HERE), oneof=Located("payload", _HERE)
)


@pytest.fixture(scope="session")
def schema() -> ProtoSchema:
    return load_protos(_SETTINGS)


@pytest.fixture(scope="session")
def envelope(schema: ProtoSchema) -> Envelope:
    return find_envelope(schema, _SETTINGS)
