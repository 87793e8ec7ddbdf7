"""A running router that records: everything that it received, before routing, whatever happens to it."""

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
from tests.acceptance.site import ROOT, RouterProcess, Site, site, total, wait_until
from tests.recording.recorder_rig import imu

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
metrics: {{address: 127.0.0.1:{metrics}}}
record: {{directory: recordings, last: 60s}}
listen:
  rover: {{address: 127.0.0.5:{listen}}}
endpoints:
{endpoints}routes:
  imu_info: {{source: sensor_board, destinations: [basestation]}}
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 10s
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}, to: [driving_board]}}
"""
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


def test_everything_is_recorded_before_it_is_routed(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, router):
        place.send("sensor_board", *ALL_KINDS)
        place.send("arm_board", imu(4))  # which may not
        wait_until(lambda: received(place) == len(ALL_KINDS) + 1)
        port = place.endpoints["sensor_board"].getsockname()[1]
        wait_until(lambda: place.samples()["recorded_datagrams_total"] == len(ALL_KINDS) + 1, "the chunk")
        assert total(place.scrape(), "record_dropped") == 0
        assert router.stop(signal.SIGTERM) == 0
    [path] = files(tmp_path)
    found = read(path)
    expected = [data[: 16 * 1024 + 1] for data in ALL_KINDS]  # of what is too long, as much as says so
    assert [each.data for each in found] == [*expected, imu(4)]
    assert [each.endpoint for each in found] == ["sensor_board"] * len(ALL_KINDS) + ["arm_board"]
    assert found[0].peer == (HOSTS["sensor_board"], port)
    assert {each.listener for each in found} == {"rover"}


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


def test_a_stop_in_good_order_loses_nothing(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, router):
        send(place, 1000)
        assert router.stop(signal.SIGTERM) == 0
        [end] = router.events("router stopped")
    [path] = files(tmp_path)
    recording = Recording(path)
    assert len(list(recording.datagrams())) == end["datagrams_received"]
    assert recording.is_whole


def test_the_last_minute_is_saved_by_signal_by_command_and_by_a_deadman(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, router):
        place.send("sensor_board", imu(1))
        wait_until(lambda: received(place) == 1)
        router.process.send_signal(signal.SIGUSR1)
        wait_until(lambda: any(path.stem.endswith("_signal") for path in files(tmp_path)), "the signal's file")
        words = [sys.executable, "-m", "router", "record", str(tmp_path / "table.yaml"), "--last"]
        told = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True)
        assert [each.data for each in read(Path(told.stdout.strip()))] == [imu(1)]
        place.send("basestation", DRIVE)
        wait_until(lambda: any("_deadman-manual_drive" in path.stem for path in files(tmp_path)), "the deadman's file")
        assert router.stop(signal.SIGTERM) == 0
        saved = {line["reason"]: line["file"] for line in router.events("saved the last datagrams")}
    assert saved.keys() == {"signal", "http", "deadman-manual_drive"}
    assert [each.data for each in read(Path(saved["deadman-manual_drive"]))] == [imu(1), DRIVE]


def test_another_process_records_a_running_router(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, _):
        words = ["record", str(tmp_path / "table.yaml"), "-o", str(tmp_path / "it.mcap")]
        recorder = subprocess.Popen(
            [sys.executable, "-m", "router", *words],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert recorder.stderr is not None
        assert "recording the router at" in recorder.stderr.readline()
        place.send("sensor_board", *ALL_KINDS)
        wait_until(lambda: len(read(tmp_path / "it.mcap")) == len(ALL_KINDS), "the datagrams")
        recorder.send_signal(signal.SIGINT)
        told, _ = recorder.communicate(timeout=PATIENCE)
        assert recorder.returncode == 0
    assert f"it.mcap: {len(ALL_KINDS)} datagrams" in told
    own, others = read(files(tmp_path)[0]), read(tmp_path / "it.mcap")
    assert [each[:1] + each[2:] for each in own] == [each[:1] + each[2:] for each in others]  # but for the clocks


def test_what_is_replayed_into_a_router_is_routed_as_it_was(tmp_path: Path) -> None:
    with recording_router(tmp_path) as (place, router):
        place.send("sensor_board", *(imu(at) for at in range(100)))
        wait_until(lambda: received(place) == 100)
        before = place.waiting()
        assert router.stop(signal.SIGTERM) == 0
    [path] = files(tmp_path)
    with recording_router(tmp_path) as (again, _):
        words = [sys.executable, "-m", "router", "replay", path, "--table", tmp_path / "table.yaml", "--rate", "10x"]
        told = subprocess.run(
            [*map(str, words)], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=True
        )
        assert told.stdout == "sent 100 datagrams\n"
        assert told.stderr == ""
        wait_until(lambda: received(again) == 100)
        wait_until(lambda: total(again.scrape(), "datagrams_sent") == 100)
        assert Counter(again.waiting()["basestation"]) == Counter(before["basestation"])
