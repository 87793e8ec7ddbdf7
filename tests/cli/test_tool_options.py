"""What verbs share: which table, numbers with units, and progress for whoever looks."""

from __future__ import annotations

import argparse
import io
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from rich.progress import ProgressColumn, TextColumn

from router.cli.tool_options import hertz, progress, running_url, seconds, speed
from router.errors import TableError, UsageError
from tests.tables import PROTOS


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (seconds, "10s", 10.0),
        (seconds, "250ms", 0.25),
        (hertz, "20Hz", 20.0),
        (hertz, "0.5 Hz", 0.5),
        (speed, "2x", 2.0),
        (speed, "0.5x", 0.5),
        (speed, "max", math.inf),
    ],
)
def test_numbers_have_units(parse: Callable[[str], float], text: str, value: float) -> None:
    assert parse(text) == value


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def columns() -> Iterable[ProgressColumn]:
    return (TextColumn("{task.description} {task.completed} of {task.total}"),)


def test_progress_is_shown_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress(columns, 12) as tell:
        tell(description="sending", completed=7)
    assert "sending 7 of 12" in terminal.getvalue()


def test_without_a_terminal_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(columns, 12) as tell:
        tell(description="sending", completed=7)
    assert capsys.readouterr() == ("", "")


TABLE = f"""version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: 127.0.0.1:5000}}}}
routes: {{}}
"""


def url(table: Path) -> str:
    return running_url(argparse.Namespace(url=None, table=table))


def written(folder: Path, text: str) -> Path:
    path = folder / "table.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("http", "address"),
    [
        ("http: {address: 127.0.0.1:9108}", "127.0.0.1:9108"),
        ("http:\n  address: 0.0.0.0:80", "127.0.0.1:80"),
        ("http: {address: '${HTTP:-127.0.0.2:1}'}\nlisten: {other: {address: nonsense}}\nnonsense: 7", "127.0.0.2:1"),
    ],
)
def test_the_running_router_is_where_its_table_says(http: str, address: str, tmp_path: Path) -> None:
    assert url(written(tmp_path, f"{TABLE}{http}\n")) == f"http://{address}"


def test_a_table_that_is_extended_says_where_the_router_is(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(f"{TABLE}http: {{address: 127.0.0.1:9108}}\n")
    assert url(written(tmp_path, "extends: base.yaml\n")) == "http://127.0.0.1:9108"
    assert url(written(tmp_path, "extends: base.yaml\nhttp: {address: 127.0.0.1:1}\n")) == "http://127.0.0.1:1"


def test_a_wrong_address_is_not_asked(tmp_path: Path) -> None:
    for wrong in ("nonsense", "224.0.0.1:9108", "9108", "[127.0.0.1:9108]", "${HTTP_ADDRESS_THAT_IS_NOT_SET}", ""):
        table = written(tmp_path, f"{TABLE}http: {{address: {wrong}}}\n")
        with pytest.raises((TableError, UsageError)):
            url(table)


def test_a_table_without_http_has_no_router_to_ask(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no 'http\.address'"):
        url(written(tmp_path, TABLE))
