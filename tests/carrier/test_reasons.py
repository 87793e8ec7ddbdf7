"""What is told of a loss: every reason has a line in the log, with what shows that the message is refused rightly."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from ctypes import sizeof
from pathlib import Path
from struct import pack
from typing import Any

import pytest
from structlog.testing import capture_logs

from router.carrier.events import CountedReport, EventReader
from router.carrier.simulation import Simulation
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import DROP_REASONS, INTENDED_REASONS, REJECT_REASONS, Report
from router.compiler.refusals import _WORDS, DROP_REASON_NAMES, REJECTIONS
from router.datagrams import wire_of_protos
from router.declared import EventKind, LostEvent, Refused
from router.image.names import Names
from router.library import library
from router.observe.reports import Reporter
from router.table.addresses import Address
from tests.boards.board import REQUIRED
from tests.small_tables import BASESTATION, HEAD, MS, SECOND, SENSOR_BOARD, STRANGER, enveloped, program

START = 1_750_000_000 * SECOND
PROTO = """\
syntax = "proto3";
enum Mode { IDLE = 0; DRIVING = 1; }
message Note {
  string text = 1; int32 number = 2; repeated int32 numbers = 3; double real = 4; int64 big = 5; Mode mode = 6;
  repeated double reals = 7; bytes data = 8;
}
message PBEnvelope { oneof payload { Note note = 1; Note other = 2; } }
"""


def told(program: CompiledTable, *, ahead: int = 0, do: Callable[[Simulation], None]) -> list[Report]:
    simulation = Simulation(library(), START)
    simulation.adopt(program)
    simulation.set_clock(ahead)
    do(simulation)
    return [record.report for record in simulation.records() if isinstance(record, CountedReport)]


@pytest.fixture
def notes(tmp_path: Path) -> Callable[[str], CompiledTable]:
    """The program of a table with these routes, whose payloads are `Note`."""
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "notes.proto").write_text(PROTO)
    return lambda routes: program(tmp_path, routes, protos=tmp_path / "protos")


def note(folder: Path, **fields: Any) -> bytes:
    message = wire_of_protos(folder / "protos").envelopes.first.message_class(note=fields)
    return bytes(message.SerializeToString())


TO_ROS: Mapping[str, tuple[str, str, dict[str, Any], str]] = {
    "padding": ("std_msgs/msg/String", "{data: text}", {"text": "ab\0\0"},
                "data: the text of 4 bytes has a NUL after 'ab': strip it with strip(...)"),
    "integer": ("std_msgs/msg/Int32", "{data: round(real)}", {"real": 2147483648.0},
                "data: 2147483648 does not fit int32"),
    "range": ("std_msgs/msg/UInt8", "{data: round(real)}", {"real": -1.0}, "data: -1 does not fit uint8"),
    "no integer": ("std_msgs/msg/Int32", "{data: round(real)}", {"real": float("nan")}, "data: nan is not an integer"),
    "64 bits": ("std_msgs/msg/Int64", "{data: round(real)}", {"real": 1e20}, "data: 1e+20 does not fit 64 bits"),
    "overflow": ("std_msgs/msg/Int64", "{data: big * big}", {"big": 1 << 40}, "data: the result does not fit 64 bits"),
    "division": ("std_msgs/msg/Float64", "{data: 1 / number}", {}, "data: division by zero"),
    "whole division": ("std_msgs/msg/Int64", "{data: big // number}", {"big": 1}, "data: division by zero"),
    "result": ("std_msgs/msg/Float64", "{data: sqrt(real)}", {"real": -1.5},
               "data: the function has no result for -1.5"),
    "power": ("std_msgs/msg/Float64", "{data: real ** 8}", {"real": 1e300}, "data: the power has no finite result"),
    "float32": ("std_msgs/msg/Float32", "{data: float32(real)}", {"real": 1e39}, "data: 1e+39 does not fit float32"),
    "bounds": ("std_msgs/msg/Int32", "{data: 'clamp(wrap(big, number, 9))'}", {"number": 10},
               "data: the low bound 10 is above the high bound 9"),
    "element": ("std_msgs/msg/Int32", "{data: 'numbers[2]'}", {"numbers": [1, 2]},
                "data: there is no element [2]: the list has 2"),
    "count": ("sensor_msgs/msg/Imu", "{orientation_covariance: reals}", {"reals": [0.0] * 8},
              "orientation_covariance: 8 elements, but 9 are required"),
    "lengths": ("std_msgs/msg/Float64MultiArray", "{data: reals + numbers}", {"reals": [1.0], "numbers": [1, 2]},
                "data: lists side by side have 1 and 2 elements"),
}  # fmt: skip


@pytest.mark.parametrize("name", TO_ROS)
def test_a_datagram_that_fills_no_topic_says_where_and_why(
    name: str, notes: Callable[[str], CompiledTable], tmp_path: Path
) -> None:
    type_name, fields, values, said = TO_ROS[name]
    routes = f"  note: {{source: sensor_board, topics: [{{topic: made, type: {type_name}, fields: {fields}}}]}}\n"
    made = notes(routes)
    data = note(tmp_path, **values)
    (report,) = told(made, do=lambda simulation: simulation.datagram("exact", SENSOR_BOARD, data, START))
    assert report.reason == ("non_finite" if name == "no integer" else "mapping_error")
    place, _, rest = report.detail.removeprefix(f"{tmp_path}/").partition(": ")
    assert place.startswith("table.yaml:14:")
    assert rest == said


HEADER = b"\0\1\0\0"
FROM_ROS: Mapping[str, tuple[str, str, bytes, str]] = {
    "text": ("std_msgs/msg/String", "{text: data}", b"\5\0\0\0caf\xe9\0",
             "text: 'caf\\xe9' is not UTF-8: fix its publisher"),
    "name": ("std_msgs/msg/String", "{mode: data}", b"\7\0\0\0FLYING\0",
             "mode: 'FLYING' names no value of the enum"),
    "integer": ("std_msgs/msg/Float64", "{number: round(data)}", pack("<d", -3e9),
                "number: -3000000000 does not fit int32"),
    "octets": ("std_msgs/msg/Float64MultiArray", "{data: round(data)}", pack("<4I2d", 0, 0, 2, 0, 1, 256),
               "data: 256 does not fit uint8"),
    "malformed": ("std_msgs/msg/Float64", "{real: data}", b"\5",
                  "a malformed message: it ends too early, or has another type"),
}  # fmt: skip


@pytest.mark.parametrize("name", FROM_ROS)
def test_a_message_from_ros_that_fills_no_datagram_says_where_and_why(
    name: str, notes: Callable[[str], CompiledTable], tmp_path: Path
) -> None:
    type_name, fields, given, said = FROM_ROS[name]
    source = f"{{topic: given, type: {type_name}}}"
    made = notes(f"  note: {{source: {source}, fields: {fields}, destinations: [basestation]}}\n")
    (report,) = told(made, do=lambda simulation: simulation.message("given", HEADER + given, START))
    assert (report.place, report.target, report.reason) == ("note", "basestation", "mapping_error")
    assert report.detail.removeprefix(f"{tmp_path}/").partition(": ")[2] == said


# ---- ages

AGED = """\
  drive_motor:
    source: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}
    fields: auto
    destinations: [driving_board]
    ttl: 200ms
    deadman: {none: for tests}
  ph_info:
    source: {topic: twist, type: geometry_msgs/msg/TwistStamped}
    fields: {ph_value: float32(twist.linear.x)}
    destinations: [basestation]
    ttl: 500ms
  gps_info:
    source: sensor_board
    destinations: [{endpoint: basestation, max_rate: 1 Hz, on_limit: latest}]
    ttl: 300ms
"""
SECONDS_1970 = 12
TWIST = HEADER + pack("<iI", SECONDS_1970, 0) + pack("<I4x", 1) + pack("<6d", *[0.0] * 6)
GPS = enveloped(gps_info={"latitude": 1})


def test_a_stale_message_says_what_its_age_counts_from(tmp_path: Path) -> None:
    def happen(simulation: Simulation) -> None:
        simulation.message("twist", TWIST, START)
        simulation.message("drive_motor", HEADER + bytes(64), START - 1500 * MS)
        simulation.message("drive_motor", HEADER + bytes(64), START - 300 * SECOND)
        simulation.datagram("exact", SENSOR_BOARD, GPS, START - 301 * MS)
        for _ in range(2):
            simulation.datagram("exact", SENSOR_BOARD, GPS, START)
        simulation.advance(START + SECOND)

    clock = "the publisher's clock"
    reports = told(program(tmp_path, AGED), do=happen)
    assert [(each.place, each.reason, each.detail) for each in reports] == [
        ("ph_info", "stale", "the stamp is 55 years old, but ttl is 500 ms: is the publisher on simulated time?"),
        ("drive_motor", "stale", f"sent 1.5 s ago by {clock}, but ttl is 200 ms"),
        ("drive_motor", "stale", f"sent 5 minutes ago by {clock}, but ttl is 200 ms: is {clock} right?"),
        ("gps_info", "stale", "it arrived 301 ms ago, but ttl is 300 ms"),
        ("gps_info", "stale", "500 ms old when it could be sent, but ttl is 300 ms"),
    ]  # fmt: skip


# ---- every reason

LOSING = """\
  imu_info:
    source: sensor_board
    topics:
      - {topic: quotient, type: std_msgs/msg/Float32, fields: {data: 1 / accel_x}}
      - {topic: octet, type: std_msgs/msg/UInt8, fields: {data: clamp(round(accel_y))}}
  gps_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: 1 Hz}], ttl: 300ms}
  manual_drive: {source: basestation, destinations: [driving_board], deadman: {none: for tests}}
  load_cell_info: {source: sensor_board, destinations: [recorder]}
  pressure_info: {source: sensor_board, destinations: [basestation], order: round(pressure_kpa / temperature_c)}
  detected_object:
    source: basestation
    collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
    topics: [{topic: seen, type: comms/msg/DetectedObjectArray, fields: {frame_id: frame_id, detections: items}}]
  pump_info: {ignore: for tests}
  manual_arm:
    source: basestation
    destinations: [{endpoint: driving_board, max_rate: 5 Hz, on_limit: latest}]
    ttl: 500ms
    deadman: {timeout: 500ms, send: {manual_arm: {}}, disarmed_by: manual_drive}
"""
LARGE = bytes.fromhex("c201") + b"\xa6\x1f" + bytes.fromhex("1005") + b"\xfa\x3e\xa0\x1f" + bytes(4000)
"""A `manual_drive` with a field of 4000 bytes that no board knows."""
REQUIRING = b"\x0a\0"
"""A `drive` without the fields that REQUIRED requires."""
PART = {"frame_id": 1, "total_count": 2, "index": 0}


def from_board(*datagrams: bytes, age: int = 0) -> Callable[[Simulation], None]:
    def happen(simulation: Simulation) -> None:
        for each in datagrams:
            simulation.datagram("exact", SENSOR_BOARD, each, START - age)
        simulation.advance(START + 20 * SECOND)

    return happen


def from_basestation(*datagrams: bytes) -> Callable[[Simulation], None]:
    def happen(simulation: Simulation) -> None:
        for each in datagrams:
            simulation.datagram("exact", BASESTATION, each, START)
        simulation.advance(START + 20 * SECOND)

    return happen


IMU = enveloped(imu_info={"accel_x": 1, "accel_y": float("nan")})
DROPPED: Mapping[str, Callable[[Simulation], None]] = {
    "mapping_error": from_board(enveloped(imu_info={"accel_y": 1})),
    "non_finite": from_board(IMU),
    "too_large": from_basestation(LARGE),
    "stale": from_board(GPS, age=SECOND),
    "rate_limited": from_board(GPS, GPS),
    "queue_full": from_board(*[enveloped(load_cell_info={"force_newtons": 1})] * 5000),
    "incomplete": from_basestation(enveloped(detected_object=PART)),
    "superseded": from_basestation(*[enveloped(manual_arm={})] * 2, enveloped(manual_drive={})),
    "missing_field": from_basestation(REQUIRING),
    "out_of_order": from_board(*[enveloped(pressure_info={"pressure_kpa": kpa, "temperature_c": 1}) for kpa in (9, 7)]),
}
BRAKE, DRIVE = enveloped(manual_brake={"brake": True}), enveloped(manual_drive={"forward_backward": 5})
REJECTED: Mapping[str, Callable[[Simulation], None]] = {
    "truncated": from_board(bytes(1 << 15)),
    "empty": from_board(b""),
    "malformed": from_board(b"\x0a\x7f"),
    "no_payload": lambda simulation: simulation.datagram("trimmed", SENSOR_BOARD, bytes(7), START),
    "unknown_case": from_board(b"\xea\x77\x00"),
    "unhandled": from_board(enveloped(arm_pos={})),
    "ignored": from_board(enveloped(pump_info={})),
    "source_mismatch": lambda simulation: simulation.datagram("exact", STRANGER, GPS, START),
}
SUPERSEDED: Mapping[str, tuple[bytes, int, str]] = {
    "before a routed one": (BRAKE + DRIVE, 1, "manual_brake, then manual_drive"),
    "in pieces": (DRIVE + DRIVE + BRAKE + BRAKE, 1, "manual_drive, then manual_brake"),
    "by one that comes again": (DRIVE + BRAKE + DRIVE, 2, "manual_drive, then manual_brake, then manual_drive"),
    "by one without a route": (DRIVE + BRAKE, 1, "manual_drive, then manual_brake"),
    "by one that is ignored": (DRIVE + enveloped(pump_info={}), 1, "manual_drive, then pump_info"),
}
"""What a datagram has, the number of its superseded payloads, and what is told of them."""
WITHOUT_A_STAGE = {
    "send_buffer_full": LostEvent(error=errno.EAGAIN),
    "send_error": LostEvent(error=errno.EACCES),
    "publish_error": LostEvent(),
}
"""Sockets and the middleware cause these; here they are events as native threads write them."""
OF_LINKS = {"bad_frame", "bad_checksum"}
"""Only links have them: `tests/app/test_links.py`."""


def test_every_reason_that_is_counted_is_caused_here() -> None:
    assert {*DROPPED, *WITHOUT_A_STAGE} == {*DROP_REASON_NAMES} == {*DROP_REASONS} - {"loop"}
    assert {*REJECTED} | OF_LINKS == {*REJECTIONS} == {*REJECT_REASONS}
    assert {*Refused} - {Refused.UNTOLD} == {*_WORDS}


def logged(reports: Sequence[Report]) -> Sequence[Mapping[str, Any]]:
    with capture_logs() as lines:
        reporter = Reporter({"basestation": Address("127.0.0.1", 9)}.get)
        for each in reports:
            reporter.report(each)
        reporter.close()
    return lines


@pytest.mark.parametrize("reason", DROPPED)
def test_every_loss_has_a_line_with_what_shows_it(reason: str, tmp_path: Path) -> None:
    head = HEAD.replace("trim_trailing_zeros: true", "bandwidth: 1kB/s")
    made = program(tmp_path, LOSING, head)
    if reason == "missing_field":
        made = program(tmp_path, "  drive: {source: basestation, destinations: driving_board}\n", protos=REQUIRED)
    reports = told(made, do=DROPPED[reason])
    lines = logged([each for each in reports if each.kind == "drop"])
    if reason in INTENDED_REASONS:
        assert not lines
        return
    line = lines[0]
    assert line["event"] == "message dropped"
    assert line["reason"] == reason
    assert line["route"]
    assert line["target"]
    assert line.get("detail") or reason in {"queue_full", "superseded"}


def test_a_loss_by_order_says_the_numbers_or_where_there_is_none(tmp_path: Path) -> None:
    first, again, nowhere = [{"pressure_kpa": 9, "temperature_c": celsius} for celsius in (1, 1, 0)]
    board = from_board(*[enveloped(pressure_info=values) for values in (first, again, nowhere)])
    reports = told(program(tmp_path, LOSING), do=board)
    assert [(each.reason, each.detail.partition(": ")[2] or each.detail) for each in reports] == [
        ("out_of_order", "9 again"),
        ("mapping_error", "order: division by zero"),
    ]


@pytest.mark.parametrize("reason", WITHOUT_A_STAGE)
def test_so_has_every_loss_on_the_way_out(reason: str) -> None:
    names = Names()
    event = WITHOUT_A_STAGE[reason]
    event.size, event.kind, event.reason = sizeof(event), EventKind.LOST, DROP_REASON_NAMES.index(reason)
    event.route, event.target = names.number("gps_info"), names.number("basestation")
    why = b"" if event.error else b"no memory\0"
    reader = EventReader(names, lambda *_: "", lambda *_: "", lambda *_: "")
    read = reader.read(EventKind.LOST, memoryview(bytearray(event) + why))
    assert isinstance(read, CountedReport)
    (line,) = logged([read.report])
    assert (line["route"], line["target"], line["reason"]) == ("gps_info", "basestation", reason)
    assert line.get("error") or line.get("detail")


@pytest.mark.parametrize("reason", REJECTED)
def test_every_rejection_has_a_line_with_its_sender(reason: str, tmp_path: Path) -> None:
    lines = logged(told(program(tmp_path, LOSING), do=REJECTED[reason]))
    if reason in INTENDED_REASONS:
        assert not lines
        return
    (line,) = lines
    assert (line["event"], line["reason"]) == ("datagram rejected", reason)
    assert line["listener"] in {"exact", "trimmed"}
    assert str(line["detail"]).startswith("from 192.168.0.")


@pytest.mark.parametrize("name", SUPERSEDED)
def test_payloads_that_a_later_one_replaces_are_counted_and_told_with_their_sender(name: str, tmp_path: Path) -> None:
    data, count, payloads = SUPERSEDED[name]
    made = program(tmp_path, LOSING)
    simulation = Simulation(library(), START)
    simulation.adopt(made)
    simulation.datagram("exact", BASESTATION, data, START)
    reports = [record.report for record in simulation.records() if isinstance(record, CountedReport)]
    host, port = BASESTATION
    (line,) = logged([each for each in reports if each.kind == "supersede"])
    assert line["event"] == "datagram has several payloads; only the last one counts"
    assert (line["listener"], line["detail"]) == ("exact", f"from {host}:{port}: {payloads}")
    assert simulation.counters(made.counters.size)[made.counters.index("superseded_members", "exact")] == count


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(DRIVE, id="one payload"),
        pytest.param(DRIVE + DRIVE, id="one in two pieces"),
        pytest.param(DRIVE + b"\xea\x77\x00" + DRIVE, id="with an unknown field between them"),
        pytest.param(DRIVE + b"\xea\x77\x00", id="with an unknown field after it"),
        pytest.param(bytes.fromhex("0805") + DRIVE, id="after a case of the wrong wire type"),
    ],
)
def test_one_payload_supersedes_none(data: bytes, tmp_path: Path) -> None:
    reports = told(
        program(tmp_path, LOSING), do=lambda simulation: simulation.datagram("exact", BASESTATION, data, START)
    )
    assert reports == []
