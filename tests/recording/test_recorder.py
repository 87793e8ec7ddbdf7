"""The recorder: when it writes what to which file, and what it does when the disk does not take it."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from threading import Event, Thread
from time import monotonic, sleep, time_ns
from types import SimpleNamespace
from typing import Any

import pytest
from structlog.testing import capture_logs

from router.compiler.metrics import UNSAVED_REASONS
from router.errors import StartError
from router.recording import incidents as incidents_module
from router.recording import recorder as recorder_module
from router.recording import writer as writer_module
from router.recording.about import tripped_in
from router.recording.encoder import Encoder, Message, Packer
from router.recording.mirror import TRIPPED, Action, MirroredDatagram
from router.recording.reader import RecordedAction, Recording
from router.recording.recorder import Recorder, RecordError, Ring
from router.recording.writer import MessageWriter
from tests.recording.recorder_rig import (
    START,
    FakeMirror,
    again,
    batched,
    imu,
    read,
    recorder,
    seen,
    settings,
    table,
    wire,
)

PATIENCE = 20.0
NOTHING_UNSAVED = {**{f"recordings_unsaved {reason}": 0 for reason in UNSAVED_REASONS}, "recordings_lost": 0}


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "PERIOD", 10_000_000)
    monkeypatch.setattr(recorder_module, "AFTERMATH", 0)


@contextmanager
def running_recorder(directory: Path, **changed: Any) -> Iterator[tuple[Recorder, FakeMirror]]:
    mirror = FakeMirror()
    with closing(recorder(mirror, settings(directory, **changed))) as made:
        yield made, mirror


def counted(made: Recorder) -> dict[str, float]:
    return {" ".join((name, *labels)): value for name, series in made.samples().items() for labels, value in series}


def show(made: Recorder, mirror: FakeMirror, batch: list[MirroredDatagram]) -> None:
    """Shows it, and waits until it was written."""
    before = counted(made)["recorded_datagrams"] + counted(made)["record_dropped write_error"]
    mirror.show(batch)
    deadline = monotonic() + PATIENCE
    while counted(made)["recorded_datagrams"] + counted(made)["record_dropped write_error"] < before + len(batch):
        assert monotonic() < deadline, "it was never written"
        sleep(0.01)


def until(condition: Callable[[], object], otherwise: str) -> None:
    deadline = monotonic() + PATIENCE
    while not condition():
        assert monotonic() < deadline, otherwise
        sleep(0.01)


def about(path: Path) -> dict[str, str]:
    with closing(Recording(path)) as recording:
        assert sum(1 for _ in recording.everything()) > 0
        return recording.about


def actions(path: Path) -> list[RecordedAction]:
    with closing(Recording(path)) as recording:
        return [each for each in recording.everything() if isinstance(each, RecordedAction)]


def files(directory: Path) -> list[Path]:
    return sorted(directory.iterdir())


def now(*datagrams: bytes) -> list[MirroredDatagram]:
    return seen(*datagrams, at=time_ns())


def test_all_that_was_seen_is_in_the_file_when_it_is_closed(tmp_path: Path) -> None:
    batches = [now(imu(1), b"bad"), now(imu(2), imu(3))]
    with running_recorder(tmp_path / "new" / "recordings") as (made, mirror):
        for batch in batches:
            mirror.show(batch)
    [path] = files(tmp_path / "new" / "recordings")
    recording = Recording(path)
    assert [again(each) for each in recording.datagrams()] == [each for batch in batches for each in batch]
    assert recording.is_whole
    assert recording.about == {"reason": "continuous", "table": "rover.yaml", "protos_sha256": "0" * 64, "routes": "{}"}
    assert counted(made) == {
        "recorded_datagrams": 4,
        "recorded_bytes": sum(len(each.data) for batch in batches for each in batch),
        "record_dropped overflow": 0,
        "record_dropped write_error": 0,
        **NOTHING_UNSAVED,
    }


def test_what_was_seen_is_on_disk_soon_and_can_be_read_while_it_goes_on(tmp_path: Path) -> None:
    with running_recorder(tmp_path) as (made, mirror):
        show(made, mirror, batch := now(imu()))
        assert [again(each) for each in read(files(tmp_path)[0])] == batch


def test_nothing_seen_makes_no_file(tmp_path: Path) -> None:
    with running_recorder(tmp_path):
        pass
    assert files(tmp_path) == []


def test_a_file_that_would_become_too_large_is_followed_by_another(tmp_path: Path) -> None:
    noise = [now(os.urandom(10_000)) for _ in range(5)]
    with running_recorder(tmp_path, max_size=25_000) as (made, mirror):
        for batch in noise:
            show(made, mirror, batch)
    assert [len(read(path)) for path in files(tmp_path)] == [2, 2, 1]
    assert all(path.stat().st_size <= 25_000 for path in files(tmp_path))


def test_a_file_is_closed_when_it_is_old_enough_though_nothing_comes(tmp_path: Path) -> None:
    with running_recorder(tmp_path, max_age=1) as (made, mirror):
        show(made, mirror, now(imu()))
        deadline = monotonic() + PATIENCE
        while not _is_whole(files(tmp_path)[0]):
            assert monotonic() < deadline, "it was never closed"
            sleep(0.01)
        show(made, mirror, now(imu()))
    assert [len(read(path)) for path in files(tmp_path)] == [1, 1]


def _is_whole(path: Path) -> bool:
    recording = Recording(path)
    list(recording.datagrams())
    return recording.is_whole


def test_the_oldest_recordings_go_and_files_of_others_stay(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(bytes(100_000))
    (tmp_path / "rover_holiday.mcap").write_bytes(bytes(100_000))
    (tmp_path / "other_000001_20200101T000000.000000Z.mcap").write_bytes(bytes(100_000))
    old = tmp_path / "rover_000001_20200101T000000.000000Z_deadman-drive_motor.mcap"
    old.write_bytes(bytes(10_000))
    with running_recorder(tmp_path, max_size=25_000, retention=60_000) as (made, mirror):
        for _ in range(8):
            show(made, mirror, now(os.urandom(10_000)))
    ours = [path for path in files(tmp_path) if path.stat().st_size < 100_000]
    assert len(files(tmp_path)) - len(ours) == 3
    assert old not in ours
    assert sum(path.stat().st_size for path in ours) <= 60_000
    assert [len(read(path)) for path in ours] == [2, 2]


def test_the_newest_recordings_stay_even_if_the_clock_was_set_back(tmp_path: Path) -> None:
    """As on a computer without a battery for its clock."""
    old = tmp_path / "rover_000007_20990101T000000.000000Z.mcap"
    old.write_bytes(bytes(30_000))
    with running_recorder(tmp_path, max_size=25_000, retention=60_000) as (made, mirror):
        batches = [now(os.urandom(10_000)) for _ in range(8)]
        for batch in batches:
            show(made, mirror, batch)
    assert old not in files(tmp_path)
    assert [again(each) for path in files(tmp_path) for each in read(path)] == [
        each for batch in batches[4:] for each in batch
    ]


def test_recordings_are_numbered_over_all_runs(tmp_path: Path) -> None:
    (tmp_path / "rover_999999_20200101T000000.000000Z_http.mcap").touch()
    (tmp_path / "other_1000007_20200101T000000.000000Z.mcap").touch()
    for _ in range(2):
        with running_recorder(tmp_path) as (made, mirror):
            show(made, mirror, now(imu()))
    names = [path.name.rpartition("_")[0] for path in files(tmp_path)]
    assert {"rover_1000000", "rover_1000001"} <= set(names)


def test_the_last_datagrams_are_saved_when_somebody_asks(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=60 * 10**9) as (made, mirror):
        mirror.show(first := now(imu(1), b"bad"))
        path = made.save("http")
        assert path.name.endswith("_http.mcap")
        assert [again(each) for each in read(path)] == first
        mirror.show(second := now(imu(2)))
        again_saved = made.save("signal")
        assert [again(each) for each in read(again_saved)] == first + second
        assert [Recording(each).about["reason"] for each in (path, again_saved)] == ["http", "signal"]
    assert len(files(tmp_path)) == 2
    assert counted(made)["recorded_datagrams"] == 0


def test_what_is_older_than_last_is_not_saved(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=1) as (made, mirror):
        mirror.show(now(imu(1)))
        made.save("first")  # has it written before the next comes
        mirror.show(second := now(imu(2)))
        assert [again(each) for each in read(made.save("second"))] == second


def test_of_a_flood_the_memory_keeps_less(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=60 * 10**9, max_size=25_000) as (made, mirror):
        for _ in range(5):
            mirror.show(last := now(os.urandom(10_000)))
            path = made.save("it")
    assert [again(each) for each in read(path)][-1:] == last
    assert path.stat().st_size < 25_000 + 1000


def test_a_deadman_that_trips_has_it_saved_once_in_the_time_that_is_kept(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=3600 * 10**9) as (made, mirror):
        mirror.show(now(imu(1)))
        made.deadman_tripped("drive_motor")
        until(lambda: files(tmp_path), "it was never saved")
        made.deadman_tripped("drive_motor")
        made.deadman_tripped("arm_target")
        made.save("in between")
        assert len(files(tmp_path)) == 2
        mirror.show(now(imu(2)))
    found = {path.name.partition("Z_")[2]: path for path in files(tmp_path)}
    assert found.keys() == {"deadman-drive_motor.mcap", "in-between.mcap", "deadman-drive_motor-arm_target.mcap"}
    assert len(read(last := found["deadman-drive_motor-arm_target.mcap"])) == 2  # saved at the end
    assert tripped_in(about(last)) == ["drive_motor", "arm_target"]


def test_a_stop_is_saved_with_what_follows_it_and_under_the_names_of_all_who_tripped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "AFTERMATH", 300_000_000)
    with running_recorder(tmp_path, continuous=False, last=3600 * 10**9) as (made, mirror):
        before = time_ns()
        made.deadman_tripped("winch")
        after = time_ns()
        mirror.act([Action(time_ns(), TRIPPED, "winch")])
        made.deadman_tripped("arm")
        until(lambda: files(tmp_path), "it was never saved")
    [path] = files(tmp_path)
    assert path.name.endswith("_deadman-winch-arm.mcap")
    at = datetime.strptime(path.name.split("_")[2], "%Y%m%dT%H%M%S.%fZ").replace(tzinfo=timezone.utc).timestamp()
    assert before / 1e9 - 1e-6 <= at <= after / 1e9  # when it stopped, not when that was saved
    assert [(each.action.what, each.action.route) for each in actions(path)] == [("tripped", "winch")]


def test_a_stop_that_a_full_disk_does_not_accept_waits_in_memory_and_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(incidents_module, "RETRY", 50_000_000)
    real = os.write
    with capture_logs() as logs, running_recorder(tmp_path, continuous=False, last=50_000_000) as (made, mirror):
        monkeypatch.setattr(os, "write", _full_after_the_head)
        for route in ("drive", "arm"):
            mirror.show(now(imu(1), imu(2)))
            made.deadman_tripped(route)
            waiting = len(("drive", "arm")[: 1 + (route == "arm")])
            until(lambda: counted(made)["recordings_unsaved disk_full"] == waiting, "it is not said")  # noqa: B023
            assert files(tmp_path) == []
            sleep(0.1)  # longer than `last`: no datagram is in the ring any more
        monkeypatch.setattr(os, "write", real)
        until(lambda: counted(made)["recordings_unsaved disk_full"] == 0, "they are not saved")
        assert [len(read(path)) for path in files(tmp_path)] == [2, 2]
    assert [path.name.partition("Z_")[2] for path in files(tmp_path)] == ["deadman-drive.mcap", "deadman-arm.mcap"]
    assert counted(made)["recordings_lost"] == 0
    told = [(each["log_level"], each["event"].partition(";")[0]) for each in logs]
    saved = ("info", "saved the last datagrams")
    assert told == [("error", "cannot save the recording of a stop"), saved, saved]


def test_a_stop_that_was_never_written_is_said_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with capture_logs() as logs, running_recorder(tmp_path, continuous=False, last=10**11) as (made, mirror):
        mirror.show(now(imu(1), imu(2)))
        monkeypatch.setattr(os, "write", _full_after_the_head)
        made.deadman_tripped("drive")
    monkeypatch.undo()
    assert files(tmp_path) == []
    assert counted(made)["recordings_lost"] == 1
    [lost] = [each for each in logs if "is lost" in each["event"]]
    assert (lost["log_level"], lost["reason"], lost["had"]) == ("error", "deadman-drive", "2 datagrams")


def test_where_there_is_no_room_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Filling the disk every 10 s would disturb other programs."""
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10))
    monkeypatch.setattr(os, "write", _fault)
    with running_recorder(tmp_path, continuous=False, last=10**11) as (made, mirror):
        mirror.show(now(imu(1)))
        with pytest.raises(RecordError, match="No space left"):
            made.save("http")
        monkeypatch.undo()


def test_a_stop_is_saved_with_the_answers_of_all_boards_that_it_awaits(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=10**6) as (made, mirror):
        mirror.show(now(imu(1)))
        made.deadman_tripped("drive", ["left", "right"])
        made.deadman_tripped("arm", ["arm"])
        made.board_answered("drive", "left", "stopped after 0.43 s")
        made.board_answered("drive", "left", "stopped after 0.90 s")  # it moved again
        made.board_answered("drive", "right", "did not obey for 2.00 s")
        sleep(0.1)
        assert files(tmp_path) == []
        made.deadman_released("arm")
        until(lambda: files(tmp_path), "it was never saved")
        mirror.show(now(imu(2)))
        made.deadman_tripped("mast", ["mast"])
    notes = {path.name.partition("Z_")[2]: about(path).get("obeyed") for path in files(tmp_path)}
    assert notes == {
        "deadman-drive-arm.mcap": "drive: left stopped after 0.43 s; drive: right did not obey for 2.00 s",
        "deadman-mast.mcap": None,  # at the end
    }


def test_a_board_that_does_not_answer_delays_a_recording_for_some_seconds_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "LONGEST_AFTERMATH", 100_000_000)
    with running_recorder(tmp_path, continuous=False, last=10**11) as (made, mirror):
        mirror.show(now(imu(1)))
        made.deadman_tripped("drive", ["left"])
        until(lambda: files(tmp_path), "it was never saved")


def test_a_stop_at_the_end_is_saved_in_time_with_its_newest_datagrams(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "MOST_AT_STOP", 25_000)
    monkeypatch.setattr(recorder_module, "AFTERMATH", 3600 * 10**9)
    batches = [now(os.urandom(10_000)) for _ in range(5)]
    with capture_logs() as logs, running_recorder(tmp_path, continuous=False, last=3600 * 10**9) as (made, mirror):
        for batch in batches:
            mirror.show(batch)
        made.deadman_tripped("drive")
    assert [again(each) for each in read(files(tmp_path)[0])] == [*batches[3], *batches[4]]
    assert [each["log_level"] for each in logs] == ["warning", "info"]


def test_without_last_there_is_nothing_to_save(tmp_path: Path) -> None:
    with running_recorder(tmp_path) as (made, _):
        made.deadman_tripped("drive_motor")
        with pytest.raises(RecordError, match="a `last`"):
            made.save("http")


@pytest.mark.parametrize("last", [None, 10**9])
def test_a_directory_that_cannot_be_is_an_error_of_the_start(last: int | None, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StartError, match=r"table.yaml:3:1: cannot record to .*: (Not a directory|File exists)"):
        recorder(FakeMirror(), settings(tmp_path / "file", last=last))


def _read_only(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
    return errno.EROFS


def _without_folder(number: int, monkeypatch: pytest.MonkeyPatch) -> int:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "mkdir", fail)
    return number


@pytest.mark.parametrize(
    "failure",
    [_read_only, *(partial(_without_folder, number) for number in (errno.ENOSPC, errno.EROFS, errno.EIO))],
    ids=["read-only", "full and empty", "read-only and empty", "broken and empty"],
)
def test_a_disk_that_has_failed_prevents_no_start(
    failure: Callable[[pytest.MonkeyPatch], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as recording, capture_logs() as logs:
        with monkeypatch.context() as failing:
            number = failure(failing)
            made, mirror = recording.enter_context(running_recorder(tmp_path / "new"))
        assert [(line["log_level"], line["problem"]) for line in logs] == [("error", os.strerror(number))]
        show(made, mirror, shown := now(imu(1)))
    assert [again(each) for path in files(tmp_path / "new") for each in read(path)] == shown


def test_a_disk_that_is_full_loses_counts_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "_RETRY", 1)
    real = os.write
    with running_recorder(tmp_path) as (made, mirror):
        show(made, mirror, first := now(imu(1)))
        monkeypatch.setattr(os, "write", _full)
        show(made, mirror, now(imu(2), imu(3)))
        monkeypatch.setattr(os, "write", real)
        show(made, mirror, third := now(imu(4)))
    assert counted(made)["record_dropped write_error"] == 2
    assert [again(each) for path in files(tmp_path) for each in read(path)] == first + third


def test_what_cannot_be_saved_leaves_no_empty_file_and_can_be_saved_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.write
    with running_recorder(tmp_path, continuous=False, last=10**11) as (made, mirror):
        mirror.show(batch := now(imu(1), imu(2)))
        monkeypatch.setattr(os, "write", _full_after_the_head)
        with pytest.raises(RecordError, match="No space left"):
            made.save("http")
        assert files(tmp_path) == []
        monkeypatch.setattr(os, "write", real)
        assert [again(each) for each in read(made.save("http"))] == batch


def test_where_the_directory_is_removed_it_is_made_again(tmp_path: Path) -> None:
    directory = tmp_path / "recordings"
    with running_recorder(directory, last=10**11) as (made, mirror):
        show(made, mirror, now(imu(1)))
        shutil.rmtree(directory)
        show(made, mirror, batch := now(imu(2)))
        [path] = files(directory)
        assert [again(each) for each in read(path)] == batch
        assert len(read(made.save("http"))) == 2


def test_what_came_before_a_reload_is_saved_as_it_was_known_then(tmp_path: Path) -> None:
    with running_recorder(tmp_path, continuous=False, last=10**11) as (made, mirror):
        mirror.show(now(imu(1)))
        mirror.program = SimpleNamespace(table=table(endpoints={}), envelopes=wire().envelopes, protos_sha256="1" * 64)
        mirror.show([each._replace(endpoint="", reason="source_mismatch") for each in now(imu(2))])
        saved = made.save("http")
    assert [(each.endpoint, each.reason) for each in read(saved)] == [("sensor_board", ""), ("", "source_mismatch")]


def test_what_comes_after_the_end_is_refused(tmp_path: Path) -> None:
    with running_recorder(tmp_path, last=10**9) as (made, _):
        pass
    made.deadman_tripped("drive_motor")
    with pytest.raises(RecordError, match="shutting down"):
        made.save("http")


def _full(descriptor: int, data: bytes) -> int:
    raise OSError(28, "No space left on device")


def _full_after_the_head(descriptor: int, data: bytes, real: Callable[[int, bytes], int] = os.write) -> int:
    return real(descriptor, data[:500]) if bytes(data[:1]) == b"\x89" else _full(descriptor, data)


@pytest.mark.parametrize("write", [_full, _full_after_the_head])
def test_a_disk_that_is_full_from_the_start_gets_no_empty_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[int, bytes], int]
) -> None:
    monkeypatch.setattr(writer_module, "_RETRY", 1)
    with running_recorder(tmp_path) as (made, mirror):
        monkeypatch.setattr(os, "write", write)
        show(made, mirror, now(imu(1)))
        show(made, mirror, now(imu(2)))
        assert files(tmp_path) == []
        monkeypatch.undo()


def test_a_disk_that_becomes_read_only_is_no_fault_of_the_router(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    with capture_logs() as logs, running_recorder(tmp_path) as (made, mirror):
        monkeypatch.setattr(os, "write", _full_after_the_head)
        monkeypatch.setattr(Path, "unlink", refuse)  # so the empty file stays
        show(made, mirror, now(imu(1)))
        monkeypatch.undo()
    assert [each["log_level"] for each in logs] == ["error"]
    assert counted(made)["record_dropped write_error"] == 1


def test_what_a_slow_disk_has_no_room_for_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_recorder(tmp_path) as (made, mirror):
        monkeypatch.setattr(recorder_module, "MOST_QUEUED", 0)
        mirror.show(now(imu(1), imu(2)))
        deadline = monotonic() + PATIENCE
        while counted(made)["record_dropped overflow"] < 2:
            assert monotonic() < deadline, "it was never counted"
            sleep(0.01)
        monkeypatch.undo()
        show(made, mirror, now(imu(3)))
    assert len(read(files(tmp_path)[0])) == 1


@pytest.mark.parametrize(
    ("owner", "name"),
    [(Encoder, "messages"), (MessageWriter, "add"), (MessageWriter, "flush")],
    ids=str,
)
def test_a_fault_costs_what_it_met_which_is_counted_and_told_once(
    owner: type, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where memory is short. Nothing of it waits for ever, as if the disk were slow."""
    with capture_logs() as logs, running_recorder(tmp_path) as (made, mirror):
        show(made, mirror, first := now(imu(1)))
        with monkeypatch.context() as faulty:
            faulty.setattr(owner, name, _fault)
            for _ in range(3):
                show(made, mirror, now(imu(2), imu(3)))
        assert counted(made)["record_dropped write_error"] == 6
        show(made, mirror, last := now(imu(4)))
        assert made._queued == 0
    assert [each["log_level"] for each in logs if "please report it" in each["event"]] == ["critical"]
    assert [again(each) for path in files(tmp_path) for each in read(path)] == first + last


def test_a_fault_in_saving_is_told_to_who_asked_and_the_next_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running_recorder(tmp_path, last=10**11) as (made, mirror):
        mirror.show(batch := now(imu(1)))
        with monkeypatch.context() as faulty:
            faulty.setattr(Recorder, "_write_file", _fault)
            with pytest.raises(RecordError, match="prevented saving; please report it: LookupError"):
                made.save("http")
            made.deadman_tripped("drive_motor")
        assert [again(each) for each in read(made.save("http"))] == batch


def _fault(*_: object) -> None:
    raise LookupError


def test_what_comes_while_saving_takes_its_time_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running_recorder(tmp_path, last=10**11) as (made, mirror):
        show(made, mirror, now(imu(1)))
        show(made, mirror, now(imu(2)))
        written: list[float] = []
        waiting = now(imu(3))

        class Slow(MessageWriter):
            """Used by the recorder's thread for what is saved."""

            def add(self, messages: Iterable[Message]) -> None:
                super().add(messages)
                written.append(counted(made)["recorded_datagrams"])
                mirror.show(waiting)
                sleep(0.02)

        monkeypatch.setattr(recorder_module, "MessageWriter", Slow)
        made.save("http")
    assert written == [2, 3]


def test_a_disk_that_hangs_holds_up_a_stop_for_a_moment_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hanging, go_on = Event(), Event()

    def hang(_: int) -> None:
        hanging.set()
        go_on.wait(PATIENCE)

    monkeypatch.setattr(recorder_module, "STOP_SECONDS", 0.1)
    with capture_logs() as logs, running_recorder(tmp_path) as (made, mirror):
        monkeypatch.setattr(os, "fdatasync", hang)
        mirror.show(batch := now(imu(1), imu(2)))
        assert hanging.wait(PATIENCE)
    assert [each["log_level"] for each in logs] == ["error"]
    assert [again(each) for each in read(files(tmp_path)[0])] == batch
    go_on.set()
    made._thread.join(PATIENCE)


def test_a_file_that_is_no_longer_at_its_path_is_followed_by_another(tmp_path: Path) -> None:
    """As where its file system was unmounted lazily: it has all its names, and can be written to."""
    directory = tmp_path / "recordings"
    with capture_logs() as logs, running_recorder(directory) as (made, mirror):
        show(made, mirror, first := now(imu(1)))
        directory.rename(tmp_path / "elsewhere")
        directory.mkdir()
        show(made, mirror, second := now(imu(2)))
    for folder, batch in ((tmp_path / "elsewhere", first), (directory, second)):
        [path] = files(folder)
        assert _is_whole(path)
        assert [again(each) for each in read(path)] == batch
    assert [each["log_level"] for each in logs] == ["warning"]
    assert counted(made)["record_dropped write_error"] == 0


def test_who_asks_while_it_ends_is_answered_at_once(tmp_path: Path) -> None:
    answers: list[object] = []

    def ask(made: Recorder) -> None:
        try:
            while True:
                answers.append(made.save("http"))
        except RecordError as error:
            answers.append(str(error))

    with running_recorder(tmp_path, continuous=False, last=10**9) as (made, mirror):
        mirror.show(now(imu(1)))
        asking = [Thread(target=ask, args=(made,)) for _ in range(4)]
        for thread in asking:
            thread.start()
        while not answers:
            sleep(0.001)
    for thread in asking:
        thread.join(PATIENCE)
    assert [answer for answer in answers if not isinstance(answer, Path)] == ["the router is shutting down"] * 4


def test_a_ring_has_what_came_in_its_time() -> None:
    ring, packer = Ring(10, 1 << 20), Packer()
    for time in range(0, 30, 3):
        ring.add(batched(packer, seen(b"x"), clocks=(START, time)))
    assert [each.monotonic for each in ring.batches()] == [18, 21, 24, 27]


def test_a_ring_never_takes_more_than_it_may_but_for_the_last_batch() -> None:
    ring, packer = Ring(10**9, 10_000), Packer()
    for time in range(100):
        ring.add(batched(packer, seen(os.urandom(1000)), clocks=(START, time)))
        assert sum(each.size for each in ring.batches()) <= 10_000
    assert len(ring.batches()) > 5
    ring.add(batched(packer, seen(*[os.urandom(16_000) for _ in range(4)]), clocks=(START, 100)))
    assert len(ring.batches()) == 1
