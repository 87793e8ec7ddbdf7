"""A running router that records: everything that it received, also what it rejected, whatever happens to it."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import sleep

from router.recording.reader import Recorded, Recording
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import HOSTS
from tests.acceptance.site import BARE, ROOT, RouterProcess, Site, site, total, wait_until
from tests.recording.recorder_rig import imu

TABLE = (
    BARE
    + """\
record: {{directory: recordings, last: 60s}}
routes:
  imu_info: {{source: sensor_board, destinations: [basestation]}}
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 10s
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board]}}
"""
)
DRIVE = b"\xc2\x01\x00"
ALL_KINDS = [imu(1), b"", b"no envelope", imu(2).rstrip(b"\0") + bytes(9), b"\xff" * 20_000, imu(3)]


@contextmanager
def recording_router(folder: Path) -> Iterator[tuple[Site, RouterProcess]]:
    with site(folder, HOSTS) as place, RouterProcess(folder, place.table(TABLE)) as router:
        yield place, router


def files(folder: Path) -> list[Path]:
    return sorted((folder / "recordings").glob("*.mcap"))


def read(path: Path) -> list[Recorded]:
    return list(Recording(path).datagrams())


def received(place: Site) -> int:
    return total(place.scrape(), "datagrams_received")


def send(place: Site, number: int) -> None:
    for at in range(number):
        place.send("sensor_board", imu(at))
        if at % 50 == 49:
            sleep(0.01)


def router_command(*words: object) -> list[str]:
    return [sys.executable, "-m", "router", *map(str, words)]


def said(*words: object) -> str:
    """What a verb prints that does nothing wrong."""
    done = subprocess.run(
        router_command(*words), cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert done.stderr == ""
    return done.stdout


def test_everything_is_recorded_with_what_was_decided_here_and_by_another_process(tmp_path: Path) -> None:
    """And a stop in good order loses nothing."""
    recorder = None
    with recording_router(tmp_path) as (place, router):
        table, other = tmp_path / "table.yaml", tmp_path / "it.mcap"
        recorder = subprocess.Popen(
            router_command("record", "-t", table, "-o", other),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert recorder.stderr is not None
        assert "recording the router at" in recorder.stderr.readline()
        place.send("sensor_board", *ALL_KINDS)
        place.send("arm_board", imu(4))  # which may not
        number = len(ALL_KINDS) + 1
        wait_until(lambda: place.samples()["recorded_datagrams_total"] == number, "the chunk")
        wait_until(lambda: len(read(other)) == number, "the datagrams of the other")
        recorder.send_signal(signal.SIGTERM)
        told, _ = recorder.communicate(timeout=PATIENCE)
        assert recorder.returncode == 0
        assert f"it.mcap: {number} datagrams" in told
        assert total(place.scrape(), "record_dropped") == 0
        port = place.endpoints["sensor_board"].getsockname()[1]
        send(place, 1000)
        assert router.stop(signal.SIGTERM) == 0
        [end] = router.events("router stopped")
    [path] = files(tmp_path)
    recording = Recording(path)
    everything = list(recording.datagrams())
    assert len(everything) == end["datagrams_received"]
    assert recording.is_whole
    found = everything[:number]
    expected = [data[: 16 * 1024 + 1] for data in ALL_KINDS]  # of what is too long, as much as says so
    assert [each.data for each in found] == [*expected, imu(4)]
    assert [each.endpoint for each in found] == ["sensor_board"] * len(ALL_KINDS) + ["arm_board"]
    reasons = ["", "empty", "malformed", "", "truncated", "", "source_mismatch"]
    assert [each.reason for each in found] == reasons
    assert found[0].peer == (HOSTS["sensor_board"], port)
    assert {each.listener for each in found} == {"rover"}
    others = read(other)
    assert [each[:1] + each[2:] for each in found] == [each[:1] + each[2:] for each in others]  # but for the clocks


def test_a_kill_under_load_leaves_all_but_the_last_moment(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, router):
        send(place, 2000)
        wait_until(lambda: received(place) == 2000)
        recorded = place.samples()["recorded_datagrams_total"]
        send(place, 500)
        router.process.kill()
        router.wait()
    [path] = files(tmp_path)
    recording = Recording(path)
    found = [each.data for each in recording.datagrams()]
    assert recording.ends_early
    assert len(found) >= recorded
    assert found == [imu(at) for at in [*range(2000), *range(500)]][: len(found)]


def test_the_last_minute_is_saved_by_signal_by_command_and_by_a_deadman_and_can_be_replayed(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    with recording_router(tmp_path) as (place, router):
        place.send("sensor_board", *(imu(at) for at in range(100)))
        wait_until(lambda: received(place) == 100)
        routed = place.waiting()["basestation"]
        router.process.send_signal(signal.SIGUSR1)
        wait_until(lambda: any(path.stem.endswith("_signal") for path in files(tmp_path)), "the signal's file")
        told = Path(said("record", "-t", table, "--last").strip())
        assert [each.data for each in read(told)] == [imu(at) for at in range(100)]

        before = received(place)
        assert said("replay", told, "--table", table, "--speed", "10x") == "sent 100 datagrams\n"
        wait_until(lambda: received(place) - before == 100)
        wait_until(lambda: total(place.scrape(), "datagrams_sent", route="imu_info") == 200)
        assert Counter(place.waiting()["basestation"]) == Counter(routed)

        place.send("basestation", DRIVE)
        wait_until(lambda: any("_deadman-manual_drive" in path.stem for path in files(tmp_path)), "the deadman's file")
        assert router.stop(signal.SIGTERM) == 0
        saved = {line["reason"]: line["file"] for line in router.events("saved the last datagrams")}
    assert saved.keys() == {"signal", "http", "deadman-manual_drive"}
    last = [each.data for each in read(Path(saved["deadman-manual_drive"]))]
    assert (len(last), last[-1]) == (201, DRIVE)
