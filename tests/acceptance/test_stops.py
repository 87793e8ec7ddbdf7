"""Why a robot stopped is found in the recording alone, and so is the disk that did not accept it."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from time import sleep

import pytest

from router.recording.reader import RecordedAction, Recording
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import BARE, ROOT, RouterProcess, Site, site, wait_until
from tests.recording.recorder_rig import imu

DRIVE, ARM, BRAKE = b"\xc2\x01\x00", bytes.fromhex("d20100"), bytes.fromhex("ca01020801")
TABLE = (
    BARE
    + """\
record: {{directory: recordings, continuous: false, last: 60s}}
routes:
  imu_info: {{source: sensor_board, destinations: [basestation]}}
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 10s
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board]}}
  manual_arm:
    source: basestation
    destinations: [arm_board]
    ttl: 10s
    deadman: {{timeout: 700ms, send: {{manual_arm: {{}}}}, to: [arm_board]}}
"""
)


def show(*words: object) -> str:
    """What `router show` prints, far from any table."""
    command = [sys.executable, "-m", "router", "show", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True).stdout


def saved(folder: Path) -> list[Path]:
    return sorted((folder / "recordings").glob("*.mcap"))


def drive_and_stop(place: Site) -> None:
    for number in range(20):
        place.send("basestation", DRIVE, ARM)
        place.send("sensor_board", imu(number))
        sleep(0.02)
    place.send("arm_board", DRIVE, DRIVE)


def test_a_stop_is_explained_by_its_recording(tmp_path: Path) -> None:
    with site(tmp_path, HOSTS) as place, RouterProcess(tmp_path, place.table(TABLE)) as router:
        drive_and_stop(place)
        wait_until(lambda: bool(saved(tmp_path)), "the recording")
        assert router.stop(signal.SIGTERM) == 0
    [path] = saved(tmp_path)
    assert path.stem.endswith("_deadman-manual_drive-manual_arm")
    first, second = show(path, "--why").rstrip().split("\n\n")
    assert "the deadman of manual_drive tripped and braked driving_board, 5" in first.splitlines()[0]
    assert (
        "cause     2 manual_drive from arm_board were rejected: source_mismatch; basestation was silent from" in first
    )
    assert "by manual_drive from basestation: (all default)" in first
    assert "sent      manual_brake to driving_board, " in first
    assert "released  not in this recording" in first
    assert "the deadman of manual_arm tripped and braked arm_board, 7" in second.splitlines()[0]
    assert "cause     basestation was silent from" in second
    assert len(show(path, "--case", "manual_brake").splitlines()) >= 10
    with closing(Recording(path)) as recording:
        everything = list(recording.everything())
    assert [each.data for each in everything if not isinstance(each, RecordedAction)] == [
        *(data for number in range(20) for data in (DRIVE, ARM, imu(number))),
        DRIVE,
        DRIVE,
    ]
    sent = [each.action for each in everything if isinstance(each, RecordedAction) and each.action.what == "sent"]
    assert [each.data for each in sent] == [DRIVE, ARM] * 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Path:
    """A mounted disk of 64 KiB that is full."""
    disk = tmp_path / "recordings"
    disk.mkdir()
    mount = ["/bin/mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting needs a privileged user")
    (disk / "filler").write_bytes(bytes(60_000))
    return disk


def test_a_stop_that_does_not_fit_on_the_disk_is_told_and_saved_later(small_disk: Path, tmp_path: Path) -> None:
    try:
        with site(tmp_path, HOSTS) as place, RouterProcess(tmp_path, place.table(TABLE)) as router:
            drive_and_stop(place)
            unsaved = 'recordings_unsaved{reason="disk_full"}'
            wait_until(lambda: place.samples().get(unsaved) == 1, "the disk is full")
            assert saved(tmp_path) == []
            status = [sys.executable, "-m", "router", "status", "--url", f"http://127.0.0.1:{place.metrics}"]
            told = subprocess.run(status, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
            assert told.returncode != 0
            assert "the recording of a stop is only in memory: disk_full" in told.stdout + told.stderr
            (small_disk / "filler").unlink()
            wait_until(lambda: place.samples().get(unsaved) == 0, "another attempt")
            [path] = saved(tmp_path)
            assert "the deadman of manual_drive tripped" in show(path, "--why")
            assert router.stop(signal.SIGTERM) == 0
    finally:
        subprocess.run(["/bin/umount", small_disk], check=True)
