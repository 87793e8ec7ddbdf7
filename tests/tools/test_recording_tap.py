"""`router record` beside a router: what it says when it cannot, and a file that is complete whatever ends it."""

from __future__ import annotations

import socket
from contextlib import closing
from pathlib import Path

import pytest

from router.cli import main
from router.errors import UsageError
from router.observe.tap import Lost
from router.tools import recording_tap as module
from router.tools.recording_tap import TapRecording
from tests.ports import free_port
from tests.recording.recorder_rig import again, imu, read, seen, table, wire
from tests.tables import RIG

TABLE = table()
BATCH = seen(imu(1), b"bad", imu(2))


def recording(path: Path) -> TapRecording:
    return TapRecording(path, wire().envelope, TABLE)


def test_what_the_tap_shows_is_in_the_file_and_what_it_lost_is_counted(tmp_path: Path) -> None:
    with closing(recording(tmp_path / "it.mcap")) as made:
        made.take(BATCH[:1])
        made.take([Lost(7), *BATCH[1:]])
        made.take([])
    assert (made.datagrams, made.missed) == (3, 7)
    assert [again(each) for each in read(tmp_path / "it.mcap")] == BATCH
    assert made.size == (tmp_path / "it.mcap").stat().st_size


def test_what_came_is_written_before_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PERIOD", 0)
    with closing(recording(tmp_path / "it.mcap")) as made:
        made.take(BATCH)
        assert [again(each) for each in read(tmp_path / "it.mcap")] == BATCH


def test_a_file_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "it.mcap").write_text("mine")
    with pytest.raises(UsageError, match="exists; choose another name"):
        recording(tmp_path / "it.mcap")
    assert (tmp_path / "it.mcap").read_text() == "mine"


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot write .*: No such file or directory"):
        recording(tmp_path / "nowhere" / "it.mcap")


@pytest.mark.parametrize("words", [[], ["--last"]])
def test_a_router_that_does_not_run_is_told(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(RIG)
    url = f"http://127.0.0.1:{free_port(kind=socket.SOCK_STREAM)}"
    assert main(["record", *words, "--url", url]) == 1
    assert f"router record: no router answers at {url}" in capsys.readouterr().err


def test_the_last_minute_goes_where_the_router_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "--last", "-o", "it.mcap"]) == 2
    assert "--last writes to the directory of the table's 'record'" in capsys.readouterr().err
