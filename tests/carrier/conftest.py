"""The carrier's library, built from the current sources, and libraries with functions for tests."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest

from router.carrier.build import LIBRARY, build, is_current
from router.compiler.lookup import Definitions
from router.library import load
from tests.carrier import building
from tests.carrier import deferring as of_deferrals
from tests.carrier import delivering as of_delivery
from tests.carrier import evaluating as of_machine
from tests.carrier.building import sanitized_library

SANITIZED = "CARRIER_TESTED_WITH_SANITIZERS"
"""An environment variable. `make test-all` sets it together with those that the sanitizers need."""


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path of the library."""
    made = tmp_path_factory.mktemp("carrier") / LIBRARY.name
    if SANITIZED in os.environ:
        return sanitized_library(made)
    return LIBRARY if is_current() else build(made)


@pytest.fixture(scope="session")
def library(built: Path) -> ctypes.CDLL:
    """The loaded library."""
    return load(built)


@pytest.fixture(scope="session")
def seams(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The functions of seams.c."""
    return building.seams(tmp_path_factory.mktemp("carrier") / "seams.so")


@pytest.fixture(scope="session")
def definitions() -> Definitions:
    return Definitions()


@pytest.fixture(scope="session")
def delivering(built: Path, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The functions of delivering.c, which deliver messages."""
    made = tmp_path_factory.mktemp("carrier") / "delivering.so"
    return of_delivery.delivering(made, built, is_sanitized=SANITIZED in os.environ)


@pytest.fixture(scope="session")
def deferring(built: Path, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The functions of deferring.c, which hold messages back."""
    made = tmp_path_factory.mktemp("carrier") / "deferring.so"
    return of_deferrals.deferring(made, built, is_sanitized=SANITIZED in os.environ)


@pytest.fixture(scope="session")
def evaluating(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The functions of evaluating.c, which run the machine."""
    made = tmp_path_factory.mktemp("carrier") / "evaluating.so"
    return of_machine.evaluating(made, is_sanitized=SANITIZED in os.environ)
