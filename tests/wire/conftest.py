"""The wire types of `protos/`, compiled once."""

from __future__ import annotations

import pytest

from router.errors import SourceSpan
from router.table.model import EnvelopeSettings, Located
from router.types.protobuf import Envelope, ProtoSchema, find_envelope, load_protos
from tests.tables import PROTOS

_HERE = SourceSpan(__file__)


@pytest.fixture(scope="session")
def schema() -> ProtoSchema:
    return load_protos(PROTOS)


@pytest.fixture(scope="session")
def envelope(schema: ProtoSchema) -> Envelope:
    settings = EnvelopeSettings(
        protos=Located(schema.root, _HERE), message=Located("PBEnvelope", _HERE), oneof=Located("payload", _HERE)
    )
    return find_envelope(schema, settings)
