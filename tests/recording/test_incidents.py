"""Recordings of stops that the disk does not accept stay in memory, within a bound."""

from __future__ import annotations

import errno
import os

import pytest
from structlog.testing import capture_logs

from router.recording import incidents as module
from router.recording.channels import Channels
from router.recording.encoder import Chunk, Encoder
from router.recording.incidents import RETRY, Incident, Incidents
from tests.recording.recorder_rig import START, encoded, imu, seen


class Disk:
    """Accepts recordings unless it has an `error`."""

    def __init__(self) -> None:
        self.error: int | None = None
        self.tries = 0
        self.saved: list[Incident] = []
        self.ring: list[Chunk] = []
        self.incidents = Incidents(self.write, lambda: self.ring)

    def write(self, incident: Incident) -> None:
        self.tries += 1
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        self.saved.append(incident)

    def stop(self, route: str, *chunks: Chunk) -> None:
        self.incidents.add(Incident([route], START, {}, [*chunks]))


def chunks(count: int) -> list[Chunk]:
    encoder = Encoder(Channels())
    return [encoded(encoder, seen(imu(number), at=START + number)) for number in range(count)]


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
    disk.stop("drive", *chunks(1))
    disk.incidents.save(0)
    disk.incidents.save(RETRY - 1)
    assert disk.tries == 1
    assert {each: number for each, number in disk.incidents.unsaved.items() if number} == {reason: 1}
    disk.error = None
    disk.incidents.save(RETRY)
    assert [each.tripped for each in disk.saved] == [["drive"]]
    assert not any(disk.incidents.unsaved.values())
    disk.stop("arm", *chunks(1))
    disk.incidents.save(RETRY + 1)
    assert len(disk.saved) == 2


def test_the_oldest_datagrams_go_first_and_those_in_the_ring_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk()
    disk.error = errno.ENOSPC
    first, second, third, fourth = chunks(4)
    monkeypatch.setattr(module, "MOST_UNSAVED", sum(chunk.size_in_file for chunk in (second, third, fourth)))
    disk.stop("drive", first, second)
    disk.stop("arm", second, third, fourth)
    disk.ring = [fourth]
    disk.incidents.save(0)
    assert disk.incidents.dropped == 0
    disk.ring = []
    disk.incidents.save(RETRY)
    assert (disk.incidents.dropped, disk.incidents.lost) == (1, 0)
    monkeypatch.setattr(module, "MOST_UNSAVED", fourth.size_in_file)
    with capture_logs() as logs:
        disk.incidents.save(2 * RETRY)
    assert (disk.incidents.dropped, disk.incidents.lost, disk.incidents.unsaved["disk_full"]) == (3, 1, 1)
    assert [(each["reason"], each["why"]) for each in logs] == [("deadman-drive", "newer ones need the memory")]
    disk.error = None
    disk.incidents.save(3 * RETRY)
    assert [(each.tripped, each.chunks) for each in disk.saved] == [(["arm"], [fourth])]
