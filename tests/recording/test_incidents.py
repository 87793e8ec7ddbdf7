"""Recordings of stops that the disk does not accept stay in memory, within a bound."""

from __future__ import annotations

import errno
import os

import pytest
from structlog.testing import capture_logs

from router.recording import incidents as module
from router.recording.incidents import RETRY, Incident, Incidents
from tests.recording.recorder_rig import START


class Disk:
    """Accepts recordings unless it has an `error`."""

    def __init__(self) -> None:
        self.error: int | None = None
        self.tries = 0
        self.saved: list[Incident] = []
        self.incidents = Incidents(self.write)

    def write(self, incident: Incident) -> None:
        self.tries += 1
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        self.saved.append(incident)

    def stop(self, route: str, size: int = 1) -> None:
        self.incidents.add(Incident([route], START, bytes(size), 1))


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (errno.ENOSPC, "disk_full"),
        (errno.EDQUOT, "disk_full"),
        (errno.EROFS, "read_only"),
        (errno.EACCES, "no_permission"),
        (errno.EIO, "disk_error"),
    ],
)
def test_what_waits_is_counted_by_the_reason_and_tried_again_from_time_to_time(error: int, reason: str) -> None:
    disk = Disk()
    disk.error = error
    disk.stop("drive")
    disk.incidents.save(0)
    disk.incidents.save(RETRY - 1)
    assert disk.tries == 1
    assert {each: number for each, number in disk.incidents.unsaved.items() if number} == {reason: 1}
    disk.error = None
    disk.incidents.save(RETRY)
    assert [each.tripped for each in disk.saved] == [["drive"]]
    assert not any(disk.incidents.unsaved.values())
    disk.stop("arm")
    disk.incidents.save(RETRY + 1)
    assert len(disk.saved) == 2


def test_the_oldest_recordings_go_first_and_the_last_one_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_UNSAVED", 3)
    disk = Disk()
    disk.error = errno.ENOSPC
    disk.stop("drive", 1)
    disk.stop("arm", 2)
    disk.incidents.save(0)
    assert (disk.incidents.dropped, disk.incidents.lost) == (0, 0)
    disk.stop("mast", 4)
    with capture_logs() as logs:
        disk.incidents.save(RETRY)
    assert (disk.incidents.dropped, disk.incidents.lost, disk.incidents.unsaved["disk_full"]) == (2, 2, 1)
    assert [(each["reason"], each["why"]) for each in logs] == [
        ("deadman-drive", "newer ones need the memory"),
        ("deadman-arm", "newer ones need the memory"),
    ]
    disk.error = None
    disk.incidents.save(2 * RETRY)
    assert [each.tripped for each in disk.saved] == [["mast"]]
