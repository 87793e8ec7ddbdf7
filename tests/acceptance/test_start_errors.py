"""What keeps a router from starting: exit code 78 and a line that says where in the table, what, and what to do."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.acceptance.site import BARE, RouterProcess, Site, site

BAD_TABLE = 78


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path) as around:
        yield around


def refusal(place: Site, table: Path, **environment: str) -> str:
    router = RouterProcess(place.folder, table, **environment)
    assert router.wait() == BAD_TABLE, router.text()
    assert "Traceback" not in router.text()
    assert not router.events("router started")
    return router.text()


def test_a_metrics_port_that_is_taken(place: Site) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place.metrics = taken.getsockname()[1]
        table = place.table()
        text = refusal(place, table)
    assert f"{table}:4:12: metrics cannot be served at 127.0.0.1:{place.metrics}" in text
    assert f"(pid {os.getpid()}) has the port" in text


OTHER_COMMS = """\
class SensorBoardPHInfo:
    @classmethod
    def get_fields_and_field_types(cls):
        return {"ph_value": "double"}


def __getattr__(name):
    raise AttributeError(name)
"""


def test_comms_interfaces_that_are_not_those_of_the_table(place: Site) -> None:
    """Another build of `comms` is installed: its bytes would be read as nonsense."""
    package = place.folder / "other" / "comms" / "msg"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    (package / "__init__.py").write_text(OTHER_COMMS)
    topic = "{{topic: ph_data, type: comms/msg/SensorBoardPHInfo, fields: auto}}"
    table = place.table(BARE + f"routes: {{{{ph_info: {{{{source: sensor_board, topics: [{topic}]}}}}}}}}\n")
    text = refusal(place, table, PYTHONPATH=str(package.parent.parent))
    assert f"{table}:12:59: comms/msg/SensorBoardPHInfo as installed is not what the table was compiled for" in text
    assert "installed: double ph_value" in text
