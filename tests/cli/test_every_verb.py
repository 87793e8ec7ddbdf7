"""What holds for every verb: help with examples, a wrong table, no table, a closed pipe, a narrow terminal."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, BROKEN_PIPE, OK, VERBS, main

ROOT = Path(__file__).parents[2]

ARGUMENTS = {
    "graph": "-o routes.svg",
    "replay": "it.mcap --against other.yaml",
    "send": "battery --to 127.0.0.1:9",
    "call": "arm",
    "listen": "envelope://9",
    "show": "it.mcap",
    "new": "SensorBoardDose --number 99 --board sensor",
    "schema": "lock",
}
"""What a verb needs besides a table."""

WITHOUT_TABLE = {"init", "demo", "show"}
WITH_SHIPPED_PROTOS = {"send", "listen"}
"""Without a table they take the protos that come with the router, unless a place is a name."""


def words(verb: str) -> list[str]:
    return [verb, *shlex.split(ARGUMENTS.get(verb, ""))]


def helped(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as caught:
        main([*words, "--help"])
    assert caught.value.code == OK
    return capsys.readouterr().out


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty working directory."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("ROUTER_TABLE", raising=False)
    monkeypatch.setattr("signal.pthread_sigmask", lambda *_: None)  # of `run`: it would hold for later tests
    monkeypatch.setattr("router.cli.run.configure_log", lambda *_, **__: None)
    yield
    left = {path.name for path in Path.cwd().iterdir()}
    assert left <= {"wrong.yaml", "it.mcap", "robot"}


@pytest.mark.parametrize("verb", VERBS)
def test_its_help_has_examples_that_fit_80_columns(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    told = helped(capsys, verb)
    assert max(map(len, told.splitlines())) <= 80
    examples = told.partition("\nexamples:\n")[2].splitlines()
    assert examples
    for example in examples:
        assert example.startswith(("  router ", "  until router "))


@pytest.mark.parametrize("verb", VERBS)
def test_its_help_is_readable_in_40_columns(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    written = helped(capsys, verb).partition("\nplaces:\n")[0].partition("\nexamples:\n")[0]
    written = written.partition("\n\n")[2]  # behind the usage, where argparse breaks no option with its values
    assert [line for line in written.splitlines() if len(line) > 40] == []


def test_all_verbs_in_40_columns(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    assert main([]) == OK
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 40


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb not in WITHOUT_TABLE])
def test_a_wrong_table_is_shown_with_its_place(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("wrong.yaml").write_text("version: 1\nlisten: 5\n")
    code = main([*words(verb), "-t", "wrong.yaml"])
    told = "".join(capsys.readouterr())
    if verb in {"status", "top", "reload", "replay", "test"}:  # nothing to ask, to read or to run
        assert code in {BAD_TABLE, BAD_USAGE}
        assert told
    else:
        assert code == (1 if verb == "doctor" else BAD_TABLE)
        assert "wrong.yaml:2:9" in told


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb not in {*WITHOUT_TABLE, "replay"}])
def test_a_table_that_the_environment_names_and_is_not_there_is_said(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROUTER_TABLE", "gone.yaml")
    assert main(words(verb)) == BAD_TABLE
    assert "gone.yaml" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    "words",
    [
        *(words(verb) for verb in VERBS if verb not in {*WITHOUT_TABLE, *WITH_SHIPPED_PROTOS, "replay"}),
        ["tap", "--count", "1"],
        ["send", "imu_info", "--to", "rover"],
        ["listen", "envelope://basestation"],
    ],
    ids=" ".join,
)
def test_without_any_table_it_says_how_to_name_one(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == BAD_USAGE
    how = "name a table with -t TABLE or ROUTER_TABLE, or write a first one: `router init DIR`"
    assert capsys.readouterr().err == f"router {words[0]}: there is no routes/rover.yaml here\nhelp: {how}\n"


@pytest.mark.parametrize("verb", [None, "validate"])
@pytest.mark.parametrize("closing", ["| true", ">&-", "2>&-"])
def test_who_does_not_read_its_help_is_no_reason_to_complain(verb: str | None, closing: str) -> None:
    router = shlex.join([sys.executable, "-m", "router", *([verb] if verb else []), "--help"])
    script = f"set -o pipefail; {{ sleep 0.1; {router}; }} {closing}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["/bin/bash", "-c", script], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) in {(OK, ""), (BROKEN_PIPE, "")}
