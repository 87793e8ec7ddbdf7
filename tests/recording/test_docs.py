"""What docs/guides/record-and-replay.md and docs/reference/recordings.md show is so."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from router.compiler import check_table
from router.recording.channels import DATAGRAMS, MOST_CHANNELS, Holds
from tests.recording.recorder_rig import START, imu, recorded, seen
from tests.tables import ROUTES

DOCS = Path(__file__).parents[2] / "docs"


def example(page: str, language: str) -> str:
    """The only block of this language on the page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    [text] = re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert isinstance(text, str)
    return text


def test_the_program_that_reads_a_recording_without_ours_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded(tmp_path / "it.mcap", seen(imu(1.5), b"bad"))
    monkeypatch.chdir(tmp_path)
    exec(example("reference/recordings.md", "python"), {})  # noqa: S102 - what is tested
    assert capsys.readouterr().out == f"{START} 10.0.0.3:5000 1.5\n"


def test_the_keys_of_the_table_have_the_defaults_that_are_shown(tmp_path: Path) -> None:
    found = []
    shown_text = example("guides/record-and-replay.md", "yaml")
    for text in (shown_text, "record: {directory: ../recordings, continuous: true, last: 60s}\n"):
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


def test_what_channels_hold_is_listed() -> None:
    text = (DOCS / "reference" / "recordings.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \| (?:the payload case|`raw|`sent/|`router/)", text, re.MULTILINE) == [
        hold.value for hold in Holds
    ]
    assert f"Beyond {MOST_CHANNELS:,} channels" in text
    assert f"on `{DATAGRAMS}`" in text
