"""A rehearsal does what the router does, on a clock that is told to go, and says of everything what became of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.engine.wire import wire_of_protos
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
from tests.engine.rig import BASESTATION, HEAD, SENSOR_BOARD, STRANGER, program
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
    to = "{endpoint: basestation, max_rate: 10 Hz, keep: latest}"
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
    head = HEAD.replace("kind: basestation}", "kind: basestation, budget: 1kB/s}")
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
    source: ros
    topics: [{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}]
    fields: auto
    destinations: [driving_board]
    deadman: not in this test
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
