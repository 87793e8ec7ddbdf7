"""Routes from ROS, ages, deadmen, elements and frames, through the engine: what is sent and what is counted."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest

from router.compiler.program import Program
from router.rehearsal.cdr import serialize as cdr
from router.types.ros import ros_interfaces
from tests.engine.rig import BASESTATION, DRIVING_BOARD, HEAD, SENSOR_BOARD, Rig, program
from tests.engine.wire import I32, framed, rover_envelope, tag

MS = 1_000_000
SECOND = 1000 * MS
HOUR = 3600 * SECOND

ROUTES = """\
  drive_motor:
    source:
      - {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}
      - {topic: backup, type: comms/msg/DrivingBoardMotorMessage, when: turning_radius > 0}
    fields: auto
    destinations:
      - {endpoint: driving_board, when: distance_to_go < 100}
      - {endpoint: recorder, fields: {distance_to_go: float32(1 / distance_to_go)}}
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board, recorder], repeat: 100ms}
  rover_localization:
    source: {topic: pose, type: geometry_msgs/msg/PointStamped}
    fields: {x: float32(point.x), y: float32(point.y)}
    destinations: [basestation]
    ttl: 200ms
  detected_object:
    - source: {topic: detections, type: comms/msg/DetectedObjectArray}
      for_each: detections
      fields: {auto: true, frame_id: frame_id, total_count: count, index: index}
      destinations: [{endpoint: basestation, when: item.confidence > 0.5}]
    - source: basestation
      collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
      destinations: [recorder]
      topics:
        - topic: objects
          type: comms/msg/DetectedObjectArray
          fields: {frame_id: frame_id, detections: items}
        - {topic: how_many, type: std_msgs/msg/UInt32, fields: {data: count}, when: id != 13}
  manual_drive:
    - source: basestation
      destinations: [driving_board]
      ttl: 200ms
      deadman: {none: "a test of ages alone"}
    - source: sensor_board
      destinations: [recorder]
  imu_info:
    source: sensor_board
    destinations: [{endpoint: recorder, max_rate: 10 Hz, on_limit: latest}]
    topics: [{topic: accel, type: std_msgs/msg/Float32, fields: {data: accel_x}, max_rate: 10 Hz, on_limit: latest}]
  ph_info:
    source: sensor_board
    destinations: [slow]
"""
HEAD_MORE = "  slow: {address: 192.168.0.70:9000, kind: tool, bandwidth: 1kB/s}\nroutes:\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Program:
    head = HEAD.replace("routes:\n", HEAD_MORE)
    return program(tmp_path_factory.mktemp("both"), ROUTES, head)


@pytest.fixture
def rig(made: Program) -> Rig:
    return Rig(made)


def enveloped(**payload: object) -> bytes:
    message: bytes = rover_envelope().message_class(**payload).SerializeToString()
    return message


def ros(type_name: str, **values: Any) -> bytes:
    message = ros_interfaces().get(type_name)
    assert message is not None
    return cdr(message, values)


def drive(distance: float, radius: float = 1.0) -> bytes:
    return ros("comms/msg/DrivingBoardMotorMessage", distance_to_go=distance, turning_radius=radius)


def pose(stamp_ns: int) -> bytes:
    stamp = {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}
    header = {"stamp": stamp, "frame_id": "map"}
    return ros("geometry_msgs/msg/PointStamped", header=header, point={"x": 1.0, "y": 2.0, "z": 3.0})


def detections(*confidences: float) -> bytes:
    part = {
        "frame_id": 0,
        "total_count": 0,
        "index": 0,
        "type": 1,
        "bbox": dict.fromkeys(("x", "y", "width", "height"), 1),
    }
    items = [{**part, "id": number, "confidence": value} for number, value in enumerate(confidences)]
    order = ("frame_id", "total_count", "index", "id", "type", "bbox", "confidence")
    items = [{name: item[name] for name in order} for item in items]
    return ros("comms/msg/DetectedObjectArray", frame_id=7, detections=items)


def part(frame: int, count: int, index: int, number: int = 0) -> bytes:
    return enveloped(detected_object={"frame_id": frame, "total_count": count, "index": index, "id": number})


BRAKE = enveloped(manual_brake={"brake": True})


# ---- routes from ROS


def test_a_ros_message_is_sent_to_each_destination_as_its_mapping_says(rig: Rig) -> None:
    rig.take("drive_motor", drive(2.0))

    recorded = enveloped(drive_motor={"distance_to_go": 0.5}).rstrip(b"\0")  # its endpoint wants zeros trimmed
    assert rig.sent == [
        ("driving_board", enveloped(drive_motor={"distance_to_go": 2.0, "turning_radius": 1.0})),
        ("recorder", recorded),
    ]
    assert rig.count("messages_received", "drive_motor", "drive_motor") == 1
    assert rig.count("sent_bytes", "drive_motor", "recorder") == len(recorded)
    rig.assert_counters_balance()


def test_what_fails_for_one_destination_leaves_the_other_alone(rig: Rig) -> None:
    rig.take("drive_motor", drive(0.0))

    assert [name for name, _ in rig.sent] == ["driving_board"]
    assert rig.dropped("drive_motor", "recorder") == {"mapping_error": 1}
    rig.assert_counters_balance()


def test_the_condition_of_a_topic_holds_for_all_destinations_and_its_own_for_one(rig: Rig) -> None:
    rig.take("backup", drive(2.0, radius=-1.0))
    rig.take("drive_motor", drive(500.0))

    assert [name for name, _ in rig.sent] == ["recorder"]
    assert rig.count("messages_filtered", "drive_motor", "driving_board") == 2
    assert rig.count("messages_filtered", "drive_motor", "recorder") == 1
    rig.assert_counters_balance()


@pytest.mark.parametrize("damaged", [b"", b"\0\0\0\0" + bytes(8), drive(2.0)[:-1], b"\0\1\0\0"])
def test_bytes_that_are_no_such_message_are_lost_for_every_destination(rig: Rig, damaged: bytes) -> None:
    rig.take("drive_motor", damaged)

    assert rig.sent == []
    assert rig.dropped("drive_motor", "driving_board") == {"mapping_error": 1}
    assert rig.dropped("drive_motor", "recorder") == {"mapping_error": 1}
    rig.assert_counters_balance()


# ---- ages


def test_a_ros_message_that_the_middleware_held_too_long_is_stale(rig: Rig) -> None:
    rig.arrived_before = 200 * MS
    rig.take("drive_motor", drive(2.0))
    rig.arrived_before = 201 * MS
    rig.take("drive_motor", drive(3.0))

    assert len(rig.sent) == 2
    assert rig.dropped("drive_motor", "driving_board") == {"stale": 1}
    assert rig.dropped("drive_motor", "recorder") == {"stale": 1}
    rig.assert_counters_balance()


def test_a_datagram_that_waited_in_the_socket_is_stale(rig: Rig) -> None:
    datagram = enveloped(manual_drive={"forward_backward": 5})
    rig.receive(datagram, BASESTATION)
    rig.arrived_before = 2 * SECOND
    rig.receive(datagram, BASESTATION)

    assert rig.sent == [("driving_board", datagram)]
    assert rig.dropped("manual_drive_from_basestation", "driving_board") == {"stale": 1}
    rig.assert_counters_balance()


def test_the_age_counts_from_the_stamp_where_there_is_one(rig: Rig) -> None:
    rig.take("pose", pose(rig.WALL + rig.now - 199 * MS))
    rig.take("pose", pose(rig.WALL + rig.now - 250 * MS))
    rig.take("pose", pose(0))  # nobody filled it in
    rig.take("pose", pose(rig.WALL + rig.now + HOUR))  # by a clock that is ahead
    rig.arrived_before = SECOND
    rig.take("pose", pose(rig.WALL + rig.now + HOUR))

    assert len(rig.sent) == 3
    assert rig.dropped("rover_localization", "basestation") == {"stale": 2}
    rig.assert_counters_balance()


# ---- deadmen


def test_a_deadman_sends_in_place_of_commands_until_they_are_back(rig: Rig) -> None:
    rig.pass_time(SECOND)
    assert rig.sent == []  # no command yet

    rig.take("drive_motor", drive(2.0))
    rig.sent.clear()
    rig.pass_time(499 * MS)
    assert rig.sent == []
    rig.pass_time(1 * MS)
    assert rig.sent == [("driving_board", BRAKE), ("recorder", BRAKE.rstrip(b"\0"))]
    assert rig.changes == [("drive_motor", True)]
    assert rig.count("deadman_active", "drive_motor") == 1

    rig.pass_time(250 * MS)
    assert len(rig.sent) == 6
    rig.take("drive_motor", drive(2.0))
    assert rig.changes == [("drive_motor", True), ("drive_motor", False)]
    assert (rig.count("deadman_active", "drive_motor"), rig.count("deadman_trips", "drive_motor")) == (0, 1)
    assert rig.count("deadman_datagrams_sent", "drive_motor", "driving_board") == 3
    rig.assert_counters_balance()


@pytest.mark.parametrize("unsent", ["filtered", "stale", "damaged"])
def test_what_is_not_sent_is_no_command(rig: Rig, unsent: str) -> None:
    """For neither destination: the recorder gets no infinite distance either."""
    rig.take("drive_motor", drive(2.0))
    rig.sent.clear()
    for _ in range(10):
        rig.pass_time(50 * MS)
        rig.arrived_before = SECOND if unsent == "stale" else 0
        if unsent == "filtered":
            rig.take("backup", drive(2.0, radius=-1.0))
        else:
            rig.take("drive_motor", b"" if unsent == "damaged" else drive(2.0))

    assert ("driving_board", BRAKE) in rig.sent
    rig.assert_counters_balance()


# ---- elements and frames


def test_each_element_is_a_message_of_its_own(rig: Rig) -> None:
    rig.take("detections", detections(0.9, 0.1, 0.8))

    assert rig.sent == [
        (
            "basestation",
            enveloped(
                detected_object={
                    "frame_id": 7, "total_count": 3, "index": index, "id": index, "type": 1,
                    "bbox": {"x": 1, "y": 1, "width": 1, "height": 1},
                    "confidence": struct.unpack("<f", struct.pack("<f", confidence))[0],
                }
            ),
        )
        for index, confidence in [(0, 0.9), (2, 0.8)]
    ]  # fmt: skip
    assert rig.count("messages_received", "detected_object_from_ros", "detections") == 3
    assert rig.count("messages_filtered", "detected_object_from_ros", "basestation") == 1
    rig.assert_counters_balance()


def test_an_empty_list_sends_nothing_and_is_no_message(rig: Rig) -> None:
    rig.take("detections", detections())

    assert rig.sent == []
    assert rig.count("messages_received", "detected_object_from_ros", "detections") == 0
    rig.assert_counters_balance()


def test_a_frame_is_published_once_when_it_is_complete_and_forwarded_as_it_came(rig: Rig) -> None:
    datagrams = [part(1, 3, 2, 12), part(1, 3, 0, 10), part(1, 3, 0, 10), part(1, 3, 1, 11), part(1, 3, 1, 11)]
    for datagram in datagrams:
        rig.receive(datagram, BASESTATION)

    assert [data for _, data in rig.sent] == [datagram.rstrip(b"\0") for datagram in datagrams]
    (topic, data), (other, number) = rig.published
    assert (topic, other) == ("objects", "how_many")
    ids = [struct.unpack_from("<I", data, 12 + 40 * place + 12)[0] for place in range(3)]
    assert (struct.unpack_from("<II", data, 4), ids) == ((1, 3), [10, 11, 12])
    assert struct.unpack_from("<I", number, 4) == (3,)
    route = "detected_object_from_basestation"
    assert rig.count("messages_collected", route, "objects") == 2
    assert rig.count("messages_filtered", route, "objects") == 2
    rig.assert_counters_balance()


def test_an_incomplete_frame_is_counted_when_its_time_is_up(rig: Rig) -> None:
    rig.receive(part(1, 3, 0), BASESTATION)
    rig.receive(part(1, 3, 1), BASESTATION)
    rig.pass_time(SECOND)

    assert rig.published == []
    assert rig.dropped("detected_object_from_basestation", "objects") == {"incomplete": 1}
    rig.assert_counters_balance()


@pytest.mark.parametrize(("count", "index", "reason"), [(0, 0, "mapping_error"), (3, 3, "mapping_error"),
                                                        (4_000_000_000, 5, "incomplete")])  # fmt: skip
def test_numbers_that_make_no_frame_are_lost_for_every_topic(rig: Rig, count: int, index: int, reason: str) -> None:
    rig.receive(part(1, count, index), BASESTATION)

    for topic in ("objects", "how_many"):
        assert rig.dropped("detected_object_from_basestation", topic) == {reason: 1}
    assert len(rig.sent) == 1
    rig.assert_counters_balance()


# ---- several routes of one case, and what is served later


def test_the_sender_decides_between_the_routes_of_a_case(rig: Rig) -> None:
    datagram = enveloped(manual_drive={"turn": -3})
    rig.receive(datagram, SENSOR_BOARD)
    rig.receive(datagram, BASESTATION)
    rig.receive(datagram, DRIVING_BOARD)

    assert rig.sent == [("recorder", datagram.rstrip(b"\0")), ("driving_board", datagram)]
    assert rig.rejected() == "source_mismatch"
    rig.assert_counters_balance()


def test_the_latest_of_what_a_rate_holds_back_goes_when_it_may(rig: Rig) -> None:
    datagrams = [framed(13, tag(1, I32) + struct.pack("<f", value)) for value in (1.0, 2.0, 3.0)]
    for datagram in datagrams:
        rig.receive(datagram)
        rig.pass_time(MS)
    assert [data for _, data in rig.sent] == datagrams[:1]
    rig.pass_time(SECOND)

    assert [data for _, data in rig.sent] == [datagrams[0], datagrams[2]]
    assert [struct.unpack_from("<f", data, 4) for _, data in rig.published] == [(1.0,), (3.0,)]
    assert rig.dropped("imu_info", "accel") == {"rate_limited": 1}
    rig.assert_counters_balance()


def test_a_command_that_reaches_only_others_than_the_deadman_stops_does_not_feed_it(tmp_path: Path) -> None:
    routes = """\
  manual_drive:
    source: basestation
    destinations: [{endpoint: driving_board, when: turn < 10}, recorder]
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board]}
"""
    rig = Rig(program(tmp_path, routes))
    rig.receive(enveloped(manual_drive={"turn": 1}), BASESTATION)
    for _ in range(10):
        rig.pass_time(50 * MS)
        rig.receive(enveloped(manual_drive={"turn": 11}), BASESTATION)

    assert rig.changes == [("manual_drive", True)]
    assert rig.sent[-2:] == [("driving_board", BRAKE), ("recorder", enveloped(manual_drive={"turn": 11}))]
