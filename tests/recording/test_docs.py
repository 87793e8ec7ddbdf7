"""What docs/guides/record-and-replay.md shows is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from router.compiler import check_table
from tests.recording.recorder_rig import START, imu, recorded, seen
from tests.tables import ROUTES

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "record-and-replay.md"


def example(language: str) -> str:
    [text] = re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert isinstance(text, str)
    return text


def test_the_program_that_reads_a_recording_without_ours_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded(tmp_path / "it.mcap", seen(imu(1.5), b"bad"))
    monkeypatch.chdir(tmp_path)
    exec(example("python"), {})  # noqa: S102 - what is tested
    assert capsys.readouterr().out == f"{START} 10.0.0.3:5000 1.5\n"


def test_the_keys_of_the_table_have_the_defaults_that_are_shown(tmp_path: Path) -> None:
    found = []
    for text in (example("yaml"), "record: {directory: ../recordings, continuous: true, last: 60s}\n"):
        path = tmp_path / "table.yaml"
        path.write_text(f"extends: {ROUTES / 'rover.yaml'}\n{text}")
        checked = check_table(path)
        assert checked.table is not None
        assert checked.table.record is not None
        found.append(checked.table.record)
    shown, default = found
    assert (shown.max_size, shown.max_age, shown.retention) == (default.max_size, default.max_age, default.retention)
    assert shown.continuous
    assert shown.directory.resolve() == tmp_path.parent / "recordings"
