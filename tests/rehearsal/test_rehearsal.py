"""A rehearsal does what the router does, on a clock that is told to go, and says of everything what became of it."""

from __future__ import annotations

import random
import socket
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from router.app import Router
from router.compiler import check_table
from router.datagrams import Wire, wire_of_protos
from router.rehearsal.rehearsal import (
    START,
    Collected,
    DeadmanChanged,
    Dropped,
    Filtered,
    Published,
    Received,
    Rehearsal,
    Rejected,
    Sent,
)
from router.values import payload
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.site import wait_until
from tests.ports import free_port
from tests.small_tables import BASESTATION, HEAD, SENSOR_BOARD, STRANGER, program
from tests.tables import PROTOS

MS = 1_000_000
BRAKE = b"\xca\x01\x02\x08\x01"

DRIVE = """
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], repeat: 100ms}
"""


def rehearsal(folder: Path, routes: str, head: str = HEAD) -> Rehearsal:
    return Rehearsal(program(folder, routes, head))


WIRE = wire_of_protos(PROTOS)


def datagram(case: str, *words: str) -> bytes:
    return WIRE.encode(WIRE.case(case), payload(WIRE.case(case), words))


def test_event_names_route_and_target(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, "  imu_info: {source: sensor_board, destinations: [basestation, recorder]}\n")
    data = datagram("imu_info", "accel_x=1.5")
    made.datagram("trimmed", SENSOR_BOARD, data)
    assert made.events == [
        Received(START, "imu_info", "sensor_board"),
        Sent(START, "imu_info", "basestation", data),
        Sent(START, "imu_info", "recorder", data.rstrip(b"\0")),
    ]


def test_topic_is_published_though_nobody_subscribes(tmp_path: Path) -> None:
    topic = "{topic: imu, type: comms/msg/ImuSensorInformation, fields: auto}"
    made = rehearsal(tmp_path, f"  imu_info: {{source: sensor_board, topics: [{topic}]}}\n")
    made.datagram("trimmed", SENSOR_BOARD, datagram("imu_info", "accel_x=1.5"))
    (published,) = [event for event in made.events if isinstance(event, Published)]
    assert (published.route, published.target) == ("imu_info", "imu")
    assert published.data[4:8] == b"\0\0\xc0\x3f"


def test_rejected_datagram_tells_its_reason_and_more(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, "  imu_info: {source: sensor_board, destinations: [basestation]}\n")
    made.datagram("exact", STRANGER, datagram("imu_info"))
    assert made.events == [Rejected(START, "exact", "source_mismatch", "from 192.168.0.99:1234: imu_info")]


def test_deadman_sends_when_it_is_due(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, DRIVE)
    made.datagram("trimmed", BASESTATION, datagram("manual_drive"))
    made.events.clear()
    made.advance(START + 700 * MS)
    sent = [event for event in made.events if isinstance(event, Sent)]
    assert [event.at - START for event in sent] == [500 * MS, 600 * MS, 700 * MS]
    assert all(event.data == BRAKE and event.by_deadman for event in sent)
    assert DeadmanChanged(START + 500 * MS, "manual_drive", active=True) in made.events


def test_closing_gives_an_armed_deadman_the_last_word(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, DRIVE)
    made.datagram("trimmed", BASESTATION, datagram("manual_drive"))
    made.close()
    assert made.events[-1] == Sent(START, "manual_drive", "driving_board", BRAKE, by_deadman=True)


def test_datagram_that_waited_too_long_is_stale(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, DRIVE)
    made.datagram("trimmed", BASESTATION, datagram("manual_drive"), START - 300 * MS)
    assert made.events[-1] == Dropped(START, "manual_drive", "driving_board", "stale")


def test_condition_that_withholds_is_told(tmp_path: Path) -> None:
    to = "{endpoint: basestation, when: accel_x > 1}"
    made = rehearsal(tmp_path, f"  imu_info: {{source: sensor_board, destinations: [{to}]}}\n")
    made.datagram("trimmed", SENSOR_BOARD, datagram("imu_info"))
    assert made.events[-1] == Filtered(START, "imu_info", "basestation")


def test_what_waits_for_its_rate_is_sent_later(tmp_path: Path) -> None:
    to = "{endpoint: basestation, max_rate: 10 Hz, on_limit: latest}"
    made = rehearsal(tmp_path, f"  imu_info: {{source: sensor_board, destinations: [{to}]}}\n")
    first, second, third = (datagram("imu_info", f"accel_x={x}") for x in (1, 2, 3))
    for data in (first, second, third):
        made.datagram("trimmed", SENSOR_BOARD, data)
    made.advance(START + 1000 * MS)
    sent = [(event.at - START, event.data) for event in made.events if isinstance(event, Sent)]
    assert [data for _, data in sent] == [first, third]
    assert 0 < sent[1][0] <= 100 * MS
    assert Dropped(START, "imu_info", "basestation", "rate_limited") in made.events


def test_budget_holds_back_and_sends_when_it_is_paid(tmp_path: Path) -> None:
    head = HEAD.replace("kind: basestation}", "kind: basestation, bandwidth: 1kB/s}")
    made = rehearsal(tmp_path, "  imu_info: {source: sensor_board, destinations: [basestation]}\n", head)
    for number in range(1, 21):
        made.datagram("trimmed", SENSOR_BOARD, datagram("imu_info", f"accel_x={number}"))
    at_once = sum(isinstance(event, Sent) for event in made.events)
    made.advance(START + 1000 * MS)
    assert 0 < at_once < 20
    assert sum(isinstance(event, Sent) for event in made.events) == 20


def test_frame_that_stays_incomplete_is_dropped_when_its_time_is_up(tmp_path: Path) -> None:
    routes = """
  detected_object:
    source: basestation
    collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
    topics: [{topic: seen, type: comms/msg/DetectedObjectArray, fields: {frame_id: frame_id, detections: items}}]
"""
    made = rehearsal(tmp_path, routes)
    for index in (0, 1):
        data = datagram("detected_object", "frame_id=7", "total_count=3", f"index={index}")
        made.datagram("trimmed", BASESTATION, data)
    assert Collected(START, "detected_object", "seen") in made.events
    made.advance(START + 2000 * MS)
    assert made.events[-1] == Dropped(START + 1000 * MS, "detected_object", "seen", "incomplete", "2 of 3 parts")


def test_ros_message_that_cannot_be_read_is_dropped_with_the_error(tmp_path: Path) -> None:
    routes = """
  drive_motor:
    source: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}
    fields: auto
    destinations: [driving_board]
    deadman: {none: not in this test}
"""
    made = rehearsal(tmp_path, routes)
    made.ros("drive_motor", b"\0\1\0\0")
    (dropped,) = [event for event in made.events if isinstance(event, Dropped)]
    assert (dropped.target, dropped.reason) == ("driving_board", "mapping_error")
    assert dropped.detail


def test_same_calls_give_the_same_events(tmp_path: Path) -> None:
    made = [rehearsal(tmp_path, DRIVE) for _ in range(2)]
    for each in made:
        for step in range(20):
            each.datagram("trimmed", BASESTATION, datagram("manual_drive", f"forward_backward={step}"))
            each.advance(START + step * 70 * MS)
        each.close()
    assert made[0].events == made[1].events


def test_unknown_listener_and_topic_are_the_callers_mistake(tmp_path: Path) -> None:
    made = rehearsal(tmp_path, DRIVE)
    with pytest.raises(KeyError):
        made.datagram("nobody", BASESTATION, b"")
    with pytest.raises(KeyError):
        made.ros("nothing", b"")


# beside a router on real sockets


TABLE = """
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen: {{rover: {{address: "127.0.0.1:{listen}"}}}}
endpoints:
  sensor_board: {{address: 127.0.0.30:8, kind: board}}
  basestation: {{address: "127.0.0.1:{basestation}", kind: basestation}}
  recorder: {{address: "127.0.0.1:{recorder}", kind: tool, trim_trailing_zeros: true}}
routes:
  imu_info:
    source: sensor_board
    destinations: [{{endpoint: basestation, when: 1 / accel_x > 0.5}}, recorder]
  ph_info: {{source: any, destinations: [basestation]}}
  pump_info: {{ignore: not here}}
"""


def mixed(wire: Wire, count: int) -> list[bytes]:
    """Good ones, trimmed and padded ones, and such as are none; the same in every run."""
    chance = random.Random(6)
    made = []
    for _ in range(count):
        case = chance.choice(["imu_info", "ph_info", "pump_info", "gps_info"])
        words = [f"accel_x={chance.choice([0, 1, 5])}"] if case == "imu_info" else []
        data = wire.encode(wire.case(case), payload(wire.case(case), words))
        data = chance.choice([data, data, data.rstrip(b"\0"), data.ljust(40, b"\0"), data[:-1] + b"\xff", b"\xff\x01"])
        made.append(data)
    return made


def udp(host: str, port: int = 0) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, port))
    opened.settimeout(PATIENCE)
    return opened


def test_rehearsal_sends_and_counts_what_the_router_does(tmp_path: Path) -> None:
    with ExitStack() as opened:
        board, basestation, recorder = (
            opened.enter_context(closing(udp(host))) for host in ("127.0.0.30", "127.0.0.1", "127.0.0.1")
        )
        listen = free_port()
        path = tmp_path / "table.yaml"
        ports = {"basestation": basestation.getsockname()[1], "recorder": recorder.getsockname()[1]}
        path.write_text(TABLE.format(protos=PROTOS, listen=listen, **ports))
        made = check_table(path).program
        assert made is not None
        given = mixed(Wire(made.envelope), 200)
        run = Rehearsal(made)
        for data in given:
            run.datagram("rover", board.getsockname(), data)
        sent = [event for event in run.events if isinstance(event, Sent)]
        with Router(made) as router:
            for data in given:
                board.sendto(data, ("127.0.0.1", listen))
            for receiver, name in ((basestation, "basestation"), (recorder, "recorder")):
                expected = [event.data for event in sent if event.target == name]
                assert [receiver.recv(2048) for _ in expected] == expected
            # Nothing answers the last ones, and the kernel may not have delivered them yet.
            wait_until(lambda: router.total("datagrams_received") == len(given))
        kinds = Counter(type(event) for event in run.events)
        assert router.total("datagrams_sent") == kinds[Sent]
        assert router.total("messages_filtered") == kinds[Filtered]
        assert router.total("datagrams_rejected") == kinds[Rejected]
        assert router.total("messages_dropped") > 0
        assert len(kinds) >= 5
