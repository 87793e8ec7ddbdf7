from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main

BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def routes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder `routes` in the working directory, with one good table."""
    folder = tmp_path / "routes"
    folder.mkdir()
    text = BASE.read_text(encoding="utf-8").replace("../protos", str(BASE.parents[1] / "protos"))
    (folder / "good.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    return folder


def test_a_good_table_is_ok_in_one_line(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "routes/good.yaml"]) == OK
    assert capsys.readouterr().out == "routes/good.yaml: ok (3 payload cases, 1 topic, 2 endpoints)\n"


def test_gateways_are_counted_where_there_are_some(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (routes / "good.yaml").open("a") as more:
        more.write("gateways: {dashboard: {transport: {websocket: 127.0.0.1:8765}}}\n")
    assert main(["validate", "routes/good.yaml"]) == OK
    assert capsys.readouterr().out.endswith("2 endpoints, 1 gateway)\n")


def test_a_folder_stands_for_its_tables(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("second.yml", "x.test.yaml", ".hidden.yaml", "notes.txt", "below/third.yaml"):
        (routes / name).parent.mkdir(exist_ok=True)
        shutil.copy(routes / "good.yaml", routes / name)
    for arguments in (["routes"], ["routes", "routes/good.yaml"]):
        assert main(["validate", *arguments]) == OK
        lines = capsys.readouterr().out.splitlines()
        assert [line.partition(":")[0] for line in lines] == ["routes/good.yaml", "routes/second.yml"]


def test_a_folder_without_a_table_is_wrong_usage(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (routes / "empty").mkdir()
    assert main(["validate", "routes/empty"]) == BAD_USAGE
    assert "has no route table" in capsys.readouterr().err


def test_a_table_that_is_not_there_is_a_finding(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "routes/god.yaml"]) == BAD_TABLE
    assert "routes/god.yaml:1:1: error[bad-file]" in capsys.readouterr().out


def test_all_tables_are_checked_and_counted_once(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (routes / "bad.yaml").write_text("extends: good.yaml\nnode: {name: 5}\n")
    (routes / "worse.yaml").write_text("extends: bad.yaml\n")
    assert main(["validate", "routes"]) == BAD_TABLE
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("routes/good.yaml: ok")
    [wrong] = [line for line in lines if "error[" in line]
    assert wrong.startswith("routes/bad.yaml:2:14: error[wrong-type]: 'name' must be letters, digits and '_'")
    assert lines[-1] == "1 error in 3 tables"


def test_strict_makes_warnings_errors(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (routes / "good.yaml").read_text().replace("  ph_info: {ignore: not part of this test}\n", "")
    (routes / "good.yaml").write_text(text)
    assert main(["validate", "routes"]) == OK
    assert "1 warning in 1 table" in capsys.readouterr().out
    assert main(["validate", "--strict", "routes"]) == BAD_TABLE
    assert "error[uncovered-payload-case]" in capsys.readouterr().out


def test_json_is_a_list_of_findings_and_nothing_else(routes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", "--json", "routes"]) == OK
    assert json.loads(capsys.readouterr().out) == []
    (routes / "bad.yaml").write_text("a: [")
    assert main(["validate", "--json", "routes"]) == BAD_TABLE
    [finding] = json.loads(capsys.readouterr().out)
    assert (finding["file"], finding["code"]) == ("routes/bad.yaml", "bad-yaml")
