"""The rover's tables, checked once, and small tables for single tests."""

from __future__ import annotations

import linecache
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from router.compiler import Checked, check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.lookup import Definitions
from tests.tables import PROTOS, ROUTES

HEAD = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
node: {node}
listen: {listen}
endpoints: {endpoints}
"""
LISTEN = "{here: {address: 127.0.0.1:25000}}"
ENDPOINTS = "{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation}}"

CheckText = Callable[..., Checked]
"""Checks the text of a table from `routes:` on; `node`, `listen` and `endpoints` are YAML flow mappings."""


@pytest.fixture(scope="session")
def definitions() -> Definitions:
    return Definitions()


@pytest.fixture(scope="session")
def rover(definitions: Definitions) -> Checked:
    return check_table(ROUTES / "rover.yaml", {}, definitions)


@pytest.fixture(scope="session")
def rover_program(rover: Checked) -> CompiledTable:
    assert rover.diagnostics == []
    assert rover.program is not None
    return rover.program


@pytest.fixture
def check_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, definitions: Definitions) -> CheckText:
    """Write a small table to table.yaml in the working directory and check it."""
    monkeypatch.chdir(tmp_path)
    linecache.clearcache()

    def check(routes: str, node: str = "{name: router}", listen: str = LISTEN, endpoints: str = ENDPOINTS) -> Checked:
        head = HEAD.format(protos=PROTOS, node=node, listen=listen, endpoints=endpoints)
        text = head + textwrap.dedent(routes)
        (tmp_path / "table.yaml").write_text(text, encoding="utf-8")
        return check_table(Path("table.yaml"), {}, definitions)

    return check
