"""Another table every second, while datagrams, commands and frames come: nothing is lost, doubled or braked in vain.

For ten minutes: `STORM_SECONDS=600 .venv/bin/python -m pytest -o faulthandler_timeout=900 -m slow` with this file.
"""

from __future__ import annotations

import os
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.tools.running_router import post
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import RouterProcess, wait_until
from tests.ports import free_port
from tests.ros.peers import Publisher, Subscriber
from tests.tables import PROTOS

SECONDS = float(os.environ.get("STORM_SECONDS", "40"))
HOSTS = {"sensor": "127.0.0.30", "station": "127.0.0.31", "driving": "127.0.0.32", "arm": "127.0.0.33"}
HOSTS["radio"] = "127.0.0.34"
BRAKE = WIRE.envelopes.first.message_class(manual_brake={"brake": True}).SerializeToString()
PARTS, BURST = 3, 20
MOST_GROWTH = 0.05
ENOUGH = 120
"""Reloads from which on memory is looked at: the allocator of the first ones fills its arenas."""

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
http: {{address: "127.0.0.1:{http}"}}
listen:
  rover: {{address: "127.0.0.1:{listen}", receive_buffer: 4MiB}}
{listener}endpoints:
{endpoints}routes:
  ph_info:
    source: sensor
    destinations: [{{endpoint: station{ph}}}]
    topics: [{ph_topic}]
  imu_info: {{source: sensor, destinations: [radio]}}
  manual_drive:
    source: station
    destinations: [arm{manual}]
    ttl: 2s
    deadman: {{timeout: {patience}, send: {{manual_brake: {{brake: true}}}}, to: [arm], repeat: 100ms}}
  drive_motor:
    source: {{topic: storm_drive, type: comms/msg/DrivingBoardMotorMessage, queue_depth: {depth}}}
    fields: auto
    destinations: [{{endpoint: driving{drive}}}]
    {guard}
  detected_object:
    source: sensor
    collect: {{by: frame_id, count: total_count, order: index, timeout: 5s}}
    topics:
      - topic: storm_objects
        type: comms/msg/DetectedObjectArray
        qos: {{reliability: reliable, depth: 1000}}
        fields: {{frame_id: frame_id, detections: items}}
{more}"""
LIMITS = "", ", max_rate: 1000000 Hz", ", max_rate: 1000000 Hz, on_limit: latest"
GUARDED = "deadman: {timeout: %s, send: {manual_brake: {brake: true}}, to: [driving], repeat: 100ms}\n    ttl: 2s"
MORE = "  pump_info: {source: sensor, destinations: [radio, station], topics: [%s]}\n"
FLOAT = "{topic: %s, type: std_msgs/msg/Float32, qos: {durability: %s}, fields: {data: %s}}"


@dataclass
class Storm:
    """The tables: each choice is made anew for each."""

    boards: dict[str, socket.socket]
    path: Path
    http: int = field(default_factory=lambda: free_port(kind=socket.SOCK_STREAM))
    listen: int = field(default_factory=free_port)
    second: int = field(default_factory=free_port)
    choice: random.Random = field(default_factory=lambda: random.Random(7))
    is_guarded: bool = True
    last_words: int = 0
    """How often the deadman of `drive_motor` has gone, armed."""

    def write_first(self) -> None:
        """One with a deadman for `drive_motor`."""
        self.is_guarded = False
        while not self.is_guarded:
            self.write()
        self.last_words = 0

    def write(self) -> None:
        self.path.write_text(self._table())
        os.utime(self.path, (time.time() - 60,) * 2)  # or the reload waits until it rests

    def _table(self) -> str:
        one = self.choice.choice
        was_guarded, self.is_guarded = self.is_guarded, one([True, True, False])
        self.last_words += was_guarded and not self.is_guarded
        bandwidth = one(["", ", bandwidth: 20kB/s", ", bandwidth: 1MB/s"])
        endpoints = "".join(
            f'  {name}: {{address: "{host}:{self.boards[name].getsockname()[1]}", '
            f"kind: {'tool' if name == 'radio' else 'basestation' if name == 'station' else 'board'}"
            f"{bandwidth if name == 'radio' else ''}}}\n"
            for name, host in HOSTS.items()
        )
        return TABLE.format(
            protos=PROTOS,
            http=self.http,
            listen=self.listen,
            listener=one(["", f'  second: {{address: "127.0.0.1:{self.second}"}}\n']),
            endpoints=endpoints,
            ph=one([*LIMITS, ", when: ph_value >= 0"]),
            ph_topic=one(["", FLOAT % ("storm_ph", one(["volatile", "transient_local"]), "ph_value")]),
            manual=one(["", ", radio"]),
            patience=one(["2s", "3s"]),
            depth=one([900, 1000]),
            drive=one(LIMITS),
            guard=GUARDED % one(["2s", "3s"]) if self.is_guarded else "deadman: {none: the storm takes it away}",
            more=one(["", MORE % "", MORE % (FLOAT % ("storm_pump", "transient_local", "1.0"))]),
        )


class Sending:
    """Calls `send` with 0, 1, 2, ... so many times per second."""

    def __init__(self, rate: float, send: Callable[[int], object]) -> None:
        self.count = 0
        self._period, self._send = 1 / rate, send
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.wait(max(0.0, due - time.monotonic())):
            due += self._period
            self._send(self.count)
            self.count += 1

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()


class Reading:
    """What a subscriber prints."""

    def __init__(self, subscriber: Subscriber) -> None:
        self.lines: list[str] = []
        self._subscriber = subscriber
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while line := self._subscriber.line():
            self.lines.append(line)


class Receiving:
    """What a board receives."""

    def __init__(self, board: socket.socket) -> None:
        self.datagrams: list[bytes] = []
        self._board, self._ended = board, threading.Event()
        board.settimeout(0.2)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                self.datagrams.append(self._board.recv(4096))
            except TimeoutError:
                if self._ended.is_set():
                    return

    def of(self, case: str, number: Callable[[Any], float]) -> list[float]:
        """The numbers in the payloads of a case."""
        envelopes = map(WIRE.envelopes.first.message_class.FromString, self.datagrams)
        return [number(getattr(each, case)) for each in envelopes if each.WhichOneof("payload") == case]

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()


@contextmanager
def bound(host: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        opened.bind((host, 0))
        yield opened


def memory(router: RouterProcess) -> int:
    """kB of this process alone."""
    rollup = Path(f"/proc/{router.process.pid}/smaps_rollup").read_text()
    return int(next(line.split()[1] for line in rollup.splitlines() if line.startswith("Private_Dirty")))


def start_sending(boards: dict[str, socket.socket], drives: Publisher, listen: int) -> dict[str, Sending]:
    """All that comes, by name."""

    def by(board: str, **payload: Any) -> None:
        data = WIRE.envelopes.first.message_class(**payload).SerializeToString()
        boards[board].sendto(data, ("127.0.0.1", listen))

    def burst(number: int) -> None:
        for each in range(BURST):
            by("sensor", imu_info={"accel_x": BURST * number + each})

    def frame(number: int) -> None:
        order = list(range(PARTS))
        random.Random(number).shuffle(order)
        for index in order:
            by("sensor", detected_object={"frame_id": number % 65536, "total_count": PARTS, "index": index})
            time.sleep(0.01)

    return {
        "ph": Sending(500, lambda number: by("sensor", ph_info={"ph_value": number})),
        "imu": Sending(20, burst),
        "manual": Sending(50, lambda number: by("station", manual_drive={"turn": number})),
        "drive": Sending(50, lambda number: drives.publish([b"\0\1\0\0" + struct.pack("<ff", number, 1)])),
        "frame": Sending(10, frame),
    }


def reload_every_second(storm: Storm, router: RouterProcess) -> list[int]:
    """The memory after each."""
    used, until = [], time.monotonic() + SECONDS
    while (began := time.monotonic()) < until:
        storm.write()
        answer = post(f"http://127.0.0.1:{storm.http}", "/-/reload", 60)
        assert answer.ok, answer.body
        used.append(memory(router))
        time.sleep(max(0.0, began + 1 - time.monotonic()))
    return used


@pytest.mark.slow
def test_a_storm_of_reloads(tmp_path: Path) -> None:
    with ExitStack() as opening:
        boards = {name: opening.enter_context(bound(host)) for name, host in HOSTS.items()}
        storm = Storm(boards, tmp_path / "table.yaml")
        storm.write_first()
        router = opening.enter_context(RouterProcess(tmp_path, storm.path))
        subscriber = opening.enter_context(closing(Subscriber("storm_objects", "comms/msg/DetectedObjectArray")))
        drives = opening.enter_context(closing(Publisher("storm_drive", "comms/msg/DrivingBoardMotorMessage")))
        assert drives.line() == subscriber.line() == "matched"
        time.sleep(1)  # the router learns of the subscriber
        frames = Reading(subscriber).lines
        receiving = {name: Receiving(boards[name]) for name in HOSTS}
        sending = start_sending(boards, drives, storm.listen)
        used = reload_every_second(storm, router)
        for each in sending.values():
            each.stop()
        count = {name: each.count for name, each in sending.items()}
        wait_until(lambda: len(receiving["radio"].of("imu_info", lambda imu: imu.accel_x)) >= BURST * count["imu"])
        wait_until(lambda: len(frames) >= count["frame"])
        for board in receiving.values():
            board.stop()
        log = router.log()
    assert receiving["station"].of("ph_info", lambda ph: ph.ph_value) == list(range(count["ph"]))
    assert receiving["radio"].of("imu_info", lambda imu: imu.accel_x) == list(range(BURST * count["imu"]))
    assert receiving["arm"].of("manual_drive", lambda drive: drive.turn) == list(range(count["manual"]))
    assert receiving["driving"].of("drive_motor", lambda drive: drive.distance_to_go) == list(range(count["drive"]))
    assert len(frames) == len(set(frames)) == count["frame"]
    for name, last_words in (("arm", 0), ("driving", storm.last_words)):
        of_start = next(index for index, data in enumerate(receiving[name].datagrams) if data != BRAKE)
        assert of_start >= 1
        assert receiving[name].datagrams.count(BRAKE) == of_start + last_words
    assert [line for line in log if line["event"].startswith(("message dropped", "no commands arrive"))] == []
    if len(used) > ENOUGH:
        quarter = len(used) // 4
        assert mean(used[-quarter:]) / mean(used[quarter : 2 * quarter]) < 1 + MOST_GROWTH
