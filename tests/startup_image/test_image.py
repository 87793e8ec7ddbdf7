"""An image of a program loads at any address, is the same in every process, and does what the program does."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from router.app import Router
from router.carrier.forwarding_threads import ForwardingThreads
from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import Counters
from router.types.protobuf import PayloadCase
from tests.acceptance.payloads import FRAME, WIRE, sample
from tests.acceptance.site import udp, wait_until
from tests.ports import free_port
from tests.startup_image.test_head_start import head_start
from tests.tables import PROTOS, ROUTES

ROOT = Path(__file__).parents[2]
LISTENERS = {"trimmed": "127.0.1.5", "exact": "127.0.1.6"}
SOURCES = {
    name: f"127.0.1.{number}"
    for name, number in (
        ("sensor_board", 30), ("driving_board", 222), ("basestation", 10), ("tool", 60), ("recorder", 61),
        ("stranger", 99),
    )
}  # fmt: skip

TABLE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen:
  trimmed: {{address: "127.0.1.5:{trimmed}", framing: zero_trimmed}}
  exact: {{address: "127.0.1.6:{exact}", framing: exact}}
endpoints:
  sensor_board: {{address: "127.0.1.30:{sensor_board}", kind: board}}
  driving_board: {{address: "127.0.1.222:{driving_board}", kind: board}}
  basestation: {{address: "127.0.1.10:{basestation}", kind: basestation, bandwidth: 1MB/s}}
  tool: {{address: "127.0.1.60:{tool}", kind: tool, trim_trailing_zeros: true}}
  recorder: {{address: "127.0.1.61:{recorder}", kind: tool}}
routes:
  manual_drive:
    source: [basestation, tool]
    ttl: 1h
    destinations: [driving_board, {{endpoint: recorder, max_rate: 0.001 Hz}}]
    deadman: {{timeout: 1h, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], disarmed_by: [drive_motor]}}
  drive_motor:
    source: basestation
    ttl: 1h
    destinations:
      - endpoint: driving_board
        when: "distance_to_go > 0.5 and source == 'basestation'"
        max_rate: 1000000 Hz
        on_limit: latest   # so commands of manual_drive may supersede held ones
    deadman: {{timeout: 1h, send: {{manual_brake: {{brake: true}}}}, to: [driving_board], disarmed_by: [manual_drive]}}
  manual_brake: {{source: any, destinations: [driving_board]}}
  detected_object:
    source: [tool, basestation]
    collect: {{by: frame_id, count: total_count, order: index, timeout: 1h}}
    topics:
      - {{topic: image/objects, type: comms/msg/DetectedObjectArray, fields: {{frame_id: frame_id, detections: items}}}}
  ph_info:
    - source: sensor_board
      destinations:
        - {{endpoint: tool, max_rate: 0.001 Hz, on_limit: latest}}
        - {{endpoint: basestation, when: ph_value > 7}}
      topics:
        - {{topic: image/ph, type: std_msgs/msg/String, qos: {{durability: transient_local}},
           fields: {{data: "'acid' if ph_value < 7 else 'other'"}}}}
    - {{source: tool, destinations: [basestation]}}
  imu_info: {{source: sensor_board, topics: [{{topic: image/imu, type: comms/msg/ImuSensorInformation, fields: auto}}]}}
"""
DIGEST = """\
import sys, zlib, marshal
from pathlib import Path
from router.compiler import check_table
from router.image.writer import write_image
for path in sys.argv[1:]:
    image = write_image(check_table(Path(path)).program)
    print(path, len(image.memory), zlib.crc32(marshal.dumps(image.parts())))
"""


def table(folder: Path) -> tuple[Path, Mapping[str, int]]:
    ports = {name: free_port() for name in ("trimmed", "exact", *SOURCES)}
    path = folder / "table.yaml"
    path.write_text(TABLE.format(protos=PROTOS, **ports))
    return path, ports


def test_an_image_is_the_same_in_every_process(tmp_path: Path) -> None:
    paths = [table(tmp_path)[0], ROUTES / "rover.yaml", ROUTES / "legacy.yaml"]

    def digest(seed: str) -> str:
        command = [sys.executable, "-c", DIGEST, *map(str, paths)]
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert digest("1") == digest("2")


_RECEIVED = "datagrams_received"
BRAKE = WIRE.envelopes.first.message_class(manual_brake={"brake": True}).SerializeToString()


@dataclass
class Outcome:
    """What arrived, by endpoint, and what was counted, but for times and for brakes, which time repeats."""

    received: Mapping[str, Sequence[bytes]]
    counted: Mapping[str, int]


def test_a_head_start_receives_sends_and_counts_as_the_program_of_its_image(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    path, ports = table(tmp_path)
    checked = check_table(path)
    assert checked.program, "\n".join(map(str, checked.diagnostics))
    datagrams = [
        *(form for case in WIRE.envelopes.first.cases.values() for form in sample(case.name, _filled(case)).variants),
        *(b"", b"\xff", FRAME * b"\x0a"),
    ]
    every = [(source, listener, each) for each in datagrams for source in SOURCES for listener in LISTENERS]
    sent = [each for each in every if each[:2] != ("tool", "exact")]

    def outcome(run: Callable[[CompiledTable], AbstractContextManager[ForwardingThreads]]) -> Outcome:
        program = checked.program_in(Counters())
        assert program
        indexes = {
            series: at
            for series, at in program.counters.series()
            if not series.metric.endswith("_seconds") and not series.metric.startswith("deadman_datagrams")
        }
        with ExitStack() as opened:
            sockets = {name: opened.enter_context(udp(host, ports[name])) for name, host in SOURCES.items()}
            with run(program) as carrier:
                for number, (source, listener, datagram) in enumerate(sent, 1):
                    sockets[source].sendto(datagram, (LISTENERS[listener], ports[listener]))
                    wait_until(partial(_has_received, carrier, program, number))
            got = {name: sorted(each for each in arrived(it) if each != BRAKE) for name, it in sockets.items()}
        return Outcome(got, {f"{metric}{labels}": carrier.counts[at] for (metric, labels), at in indexes.items()})

    @contextmanager
    def by_image(program: CompiledTable) -> Iterator[ForwardingThreads]:
        started = head_start(program)
        try:
            yield started.forwarding.threads
        finally:
            started.close()

    @contextmanager
    def by_program(program: CompiledTable) -> Iterator[ForwardingThreads]:
        with Router(program) as router:
            yield router._runtime.plane._threads

    of_image, of_program = outcome(by_image), outcome(by_program)
    assert of_image.received == of_program.received
    assert {name: n for name, n in of_image.counted.items() if n != of_program.counted[name]} == {}
    assert all(of_image.received[name] for name in ("driving_board", "basestation", "tool"))


def test_a_router_takes_over_all_that_a_head_start_has_opened(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    path, ports = table(tmp_path)
    checked = check_table(path)
    assert checked.program
    started = head_start(checked.program)
    opened = dict(started.image._opened)
    kinds = {symbol[0] for symbol, *_ in started.image.image.openings}
    assert kinds == {"deadman", "limit", "pacer", "deferral", "collector"}
    with Router(checked.program, head_start=started) as router, udp(SOURCES["tool"], ports["tool"]) as tool:
        running = router._runtime.plane.image
        assert running
        assert running._opened == opened
        assert router.reload().ok
        datagram = sample("ph_info", _filled(WIRE.envelopes.first.cases["ph_info"])).datagram
        with udp(SOURCES["basestation"], ports["basestation"]) as basestation:
            tool.sendto(datagram, (LISTENERS["exact"], ports["exact"]))
            assert basestation.recv(2000) == datagram


def _has_received(carrier: ForwardingThreads, program: CompiledTable, datagrams: int) -> bool:
    counts = carrier.counters(program.counters.size)
    return datagrams <= sum(counts[at] for series, at in program.counters.series() if series.metric == _RECEIVED)


def _filled(case: PayloadCase) -> Any:
    """With a number in each field that takes one."""
    message = case.message_class()
    for field in message.DESCRIPTOR.fields:
        if field.cpp_type not in (field.CPPTYPE_MESSAGE, field.CPPTYPE_STRING) and not field.is_repeated:
            setattr(message, field.name, 1)
    return message


def arrived(opened: socket.socket) -> list[bytes]:
    opened.setblocking(False)
    found = []
    with suppress(BlockingIOError):
        while True:
            found.append(opened.recv(2000))
    return found
