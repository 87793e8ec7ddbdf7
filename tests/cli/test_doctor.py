"""`router doctor`: what it prints, and its exit code."""

from __future__ import annotations

import io
import socket
from pathlib import Path

import pytest

from router.cli import main
from router.cli.doctor import shown
from router.tools.doctor_checks import warning
from tests.ports import free_port
from tests.tables import ROUTES


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    metrics, foxglove = free_port(kind=socket.SOCK_STREAM), free_port(kind=socket.SOCK_STREAM)
    path.write_text(
        f"extends: {ROUTES}/sim.yaml\n"
        f"http: {{address: 127.0.0.1:{metrics}}}\n"
        f"foxglove: {{address: 127.0.0.1:{foxglove}}}\n"
        f"record: {{directory: {tmp_path}, last: 60s}}\n"
        f"listen: {{rover: {{address: 127.0.0.1:{free_port()}}}}}\n"
        "gateways: {dashboard: {ignore: its port is fixed}}\n"
    )
    return path


def test_before_a_start_that_will_work_it_is_silent(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--pre-start", "-t", str(table)]) == 0
    assert capsys.readouterr().out == ""


def test_on_a_terminal_the_grade_is_coloured_and_lines_are_wrapped_at_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("COLUMNS", "40")
    found = warning("clock", "it is three seconds late", "set it with /a/long/path/that/stays/whole")
    assert shown(found, Terminal()).splitlines() == [
        "\x1b[33mwarning \x1b[0m clock      it is three seconds",
        " " * 20 + "late",
        " " * 20 + "-> set it with",
        " " * 23 + "/a/long/path/that/stays/whole",
    ]
    assert shown(found, io.StringIO()).splitlines() == [
        "warning  clock      it is three seconds late",
        " " * 20 + "-> set it with /a/long/path/that/stays/whole",
    ]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True
