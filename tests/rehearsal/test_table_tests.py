"""The language of table tests: what is given, what is expected, and what is said when a table does something else."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent, indent

import pytest

from router.compiler.lookup import Definitions
from router.datagrams import wire_of_protos
from router.errors import Code, Diagnostic, TableError
from router.rehearsal.comparing import Failure
from router.rehearsal.coverage import Coverage
from router.rehearsal.fields import leaves, offset
from router.rehearsal.reading import TestFile, find_test_files, read_test_file
from router.rehearsal.running import run_tests
from tests.small_tables import HEAD
from tests.tables import PROTOS

DEFINITIONS = Definitions()
IMU = """
imu_info:
  source: sensor_board
  destinations: [basestation, {endpoint: recorder, when: accel_x > 1}]
  topics:
    - {topic: imu_data, type: comms/msg/ImuSensorInformation, fields: auto}
    - topic: imu/data_raw
      type: sensor_msgs/msg/Imu
      fields:
        header: {stamp: received_at, frame_id: "'imu_link'"}
        angular_velocity: {x: radians(gyro_x), y: 1 / accel_y}
"""
DRIVE = """
drive_motor:
  source: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}
  fields: auto
  destinations: [driving_board]
  ttl: 200ms
  deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], repeat: 100ms}
"""
FRAMES = """
detected_object:
  source: basestation
  collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
  topics: [{topic: seen, type: comms/msg/DetectedObjectArray, fields: {frame_id: frame_id, detections: items}}]
"""


def written(folder: Path, routes: str, tests: str, head: str = HEAD) -> TestFile:
    """`tests` are those of a test file, beside a table with these routes."""
    table = head.replace("PROTOS", str(PROTOS)) + indent(dedent(routes), "  ")
    (folder / "table.yaml").write_text(table)
    path = folder / "table.test.yaml"
    path.write_text("tests:\n" + indent(dedent(tests), "  "))
    return read_test_file(path, DEFINITIONS)


def failures(folder: Path, routes: str, tests: str, head: str = HEAD) -> list[Failure]:
    results = run_tests(written(folder, routes, tests, head))
    assert not any(result.findings for result in results)
    return [failure for result in results for failure in result.failures]


def messages(folder: Path, routes: str, tests: str, head: str = HEAD) -> list[str]:
    return [failure.message for failure in failures(folder, routes, tests, head)]


def messages_of(folder: Path, routes: str, tests: dict[str, str]) -> dict[str, list[str]]:
    """What is said of each test of one file, by its name."""
    file = written(folder, routes, "".join(f'"{name}": {test}\n' for name, test in tests.items()))
    results = run_tests(file)
    assert not any(result.findings for result in results)
    return {result.test.name: [failure.message for failure in result.failures] for result in results}


def findings(folder: Path, routes: str, tests: str) -> list[Diagnostic]:
    with pytest.raises(TableError) as caught:
        written(folder, routes, tests)
    return list(caught.value.diagnostics)


def given(fields: str, rest: str = "") -> str:
    return f"{{case: imu_info, from: sensor_board, listener: trimmed, fields: {fields}{rest}}}"


RAW = "{header: {stamp: 0 ms, frame_id: 'imu_link'}, angular_velocity: {y: 1.0}}"
QUIET = "{imu_data: any, imu/data_raw: any}"


# what passes


def test_numbers_may_be_rounded_or_have_a_tolerance(tmp_path: Path) -> None:
    within = ["~1.571", "~1.6", "1.57 +- 0.01", "1.5 ± 0.1", "~157.1e-2", "1.5707963267948966"]
    outside = ["~1.572", "~1.5", "1.58 +- 0.001", "1.57", "nan"]
    took = given("{accel_y: 1, gyro_x: 90}")
    tests = {}
    for number in (*within, *outside):
        raw = f"{{header: any, angular_velocity: {{x: {number}, y: 1}}}}"
        published = f"{{imu_data: any, imu/data_raw: {raw}}}"
        tests[number] = f"{{given: {took}, expect: {{sent: basestation, published: {published}}}}}"
    said = messages_of(tmp_path, IMU, tests)
    assert said == {number: [] for number in within} | {
        number: [f"imu/data_raw: angular_velocity.x is 1.5707963267948966, not {number}"] for number in outside
    }


def test_nan_is_expected_as_what_it_is(tmp_path: Path) -> None:
    routes = """
imu_info:
  source: sensor_board
  topics: [{topic: field, type: sensor_msgs/msg/FluidPressure, fields: {fluid_pressure: accel_x, variance: nan}}]
"""
    took = given("{accel_x: nan}")
    tests = {
        variance: f"{{given: {took}, expect: {{published: {{field: {{fluid_pressure: nan, variance: {variance}}}}}}}}}"
        for variance in ("nan", "1.5", "inf")
    }
    assert messages_of(tmp_path, routes, tests) == {
        "nan": [],
        "1.5": ["field: variance is nan, not 1.5"],
        "inf": ["field: variance is nan, not inf"],
    }


def test_variables_of_the_table_come_from_the_test_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RATE", "1 Hz")
    routes = 'imu_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: "${RATE:-100 Hz}"}]}'
    tests = f"""
        a:
          given: {given("{}", ", times: 3, every: 10ms")}
          expect: {{sent: {{basestation: {{times: 3}}}}}}
        """
    assert not failures(tmp_path, routes, tests)


PROTO = """
syntax = "proto3";
import "google/protobuf/timestamp.proto";
enum Mode { MODE_OFF = 0; MODE_ON = 1; MODE_HALF = -2; }
message Point { int32 x = 1; int32 y = 2; }
message EveryKind {
  enum State { IDLE = 0; BUSY = 1; }
  bool flag = 1;
  sint64 number = 2;
  float single = 3;
  double real = 4;
  string text = 5;
  bytes blob = 6;
  Mode mode = 7;
  State state = 8;
  Point point = 9;
  repeated float numbers = 10;
  repeated Point points = 11;
  repeated Mode modes = 12;
  optional int32 maybe = 13;
  map<string, int32> counts = 14;
  map<int32, Point> places = 15;
  oneof either { int32 left = 16; string right = 17; }
  google.protobuf.Timestamp time = 18;
}
message PBEnvelope { oneof payload { EveryKind every_kind = 1; } }
"""
EVERY_KIND = """{
    flag: true, number: -3, single: 0.1, real: 0.1, text: "any", blob: "0a ff", mode: MODE_HALF, state: State.BUSY,
    point: {x: 1}, point.y: 2, numbers: [1, 2.5, nan], points: [{}, {y: 3}], modes: [MODE_ON, 0], maybe: 0,
    counts: [{key: a, value: 1}, {key: b, value: 2}], places: [{key: 5, value: {x: 6}}], right: "", time: 250ms}"""


def every_kind(folder: Path, expected: str) -> list[str]:
    (folder / "kinds.proto").write_text(PROTO)
    head = HEAD.replace("PROTOS", str(folder))
    tests = f"""
        a:
          given: {{case: every_kind, from: left_tool, listener: exact, fields: {" ".join(EVERY_KIND.split())}}}
          expect: {{sent: {{right_tool: {{every_kind: {" ".join(expected.split())}}}}}}}
        """
    return messages(folder, "every_kind: {source: left_tool, destinations: [right_tool]}", tests, head)


def test_every_kind_of_field_can_be_given_and_expected(tmp_path: Path) -> None:
    assert every_kind(tmp_path, EVERY_KIND) == []
    assert every_kind(tmp_path, "unchanged") == []


def test_a_map_is_written_as_keys_and_values_in_any_order(tmp_path: Path) -> None:
    expected = EVERY_KIND.replace("[{key: a, value: 1}, {key: b, value: 2}]", "{b: 2, a: 1}")
    expected = expected.replace("[{key: 5, value: {x: 6}}]", "{5: {x: 6}}")
    assert every_kind(tmp_path, expected) == []
    assert every_kind(tmp_path, expected.replace("b: 2", "b: 3")) == ["right_tool: counts[1].value is 2, not 3"]
    with pytest.raises(TableError, match="'five' is not an integer"):
        every_kind(tmp_path, expected.replace("5: {", "five: {"))
    with pytest.raises(TableError, match="this is a map"):
        every_kind(tmp_path, expected.replace("{5: {x: 6}}", "7"))


def test_a_struct_is_written_as_its_fields(tmp_path: Path) -> None:
    (tmp_path / "kinds.proto").write_text(
        'syntax = "proto3"; import "google/protobuf/struct.proto";'
        "message Kind { google.protobuf.Struct object = 1; }"
        "message PBEnvelope { oneof payload { Kind kind = 1; } }"
    )
    tests = """
        a:
          given: {case: kind, from: left_tool, listener: exact, fields: {object: {fields: {a: {number_value: 1.5}}}}}
          expect: {sent: {right_tool: {kind: {object: {fields: {a: {number_value: 2.5}}}}}}}
        """
    head = HEAD.replace("PROTOS", str(tmp_path))
    said = messages(tmp_path, "kind: {source: left_tool, destinations: [right_tool]}", tests, head)
    assert said == ["right_tool: object.fields[0].value.number_value is 1.5, not 2.5"]


def test_every_kind_of_field_is_told_where_it_is_not_expected(tmp_path: Path) -> None:
    assert [
        said.removeprefix("right_tool: ").replace(", not at its default", "") for said in every_kind(tmp_path, "{}")
    ] == [
        "flag is true",
        "number is -3",
        "single is 0.1",
        "real is 0.1",
        "text is 'any'",
        "blob is 0aff",
        "mode is MODE_HALF",
        "state is BUSY",
        "point is {x: 1, y: 2}",
        "numbers is [1, 2.5, nan]",
        "points is [{}, {y: 3}]",
        "modes is [MODE_ON, MODE_OFF]",
        "maybe is 0",
        "counts is [{key: 'a', value: 1}, {key: 'b', value: 2}]",
        "places is [{key: 5, value: {x: 6}}]",
        "right is ''",
        "time is 250 ms",
    ]


def test_every_scalar_of_a_message_is_listed_by_its_path(tmp_path: Path) -> None:
    (tmp_path / "kinds.proto").write_text(PROTO)
    case = wire_of_protos(tmp_path).case("every_kind")
    message = case.message_class(point={"x": 1}, points=[{"y": 3}], places={5: {"x": 6}}, maybe=7)
    found = {
        path: text for path, text in leaves(case.type, message) if text not in {"0", "0.0", "false", "empty", "''"}
    }
    assert found == {
        "mode": "MODE_OFF",
        "state": "IDLE",
        "point.x": "1",
        "points[0].y": "3",
        "maybe": "7",
        "places[0].key": "5",
        "places[0].value.x": "6",
    }


def test_a_message_in_itself_is_followed_as_far_as_it_is_set(tmp_path: Path) -> None:
    (tmp_path / "tree.proto").write_text(
        'syntax = "proto3"; message Tree { int32 number = 1; Tree sub = 2; }'
        "message PBEnvelope { oneof payload { Tree tree = 1; } }"
    )
    case = wire_of_protos(tmp_path).case("tree")
    message = case.message_class(number=1, sub={"number": 2})
    assert list(leaves(case.type, message)) == [("number", "1"), ("sub.number", "2")]


# what fails


def test_failure_has_its_place_in_test_and_table(tmp_path: Path) -> None:
    raw = "{header: any, angular_velocity: {x: 2, y: 1}}"
    tests = f"""
        a:
          given: {given("{accel_y: 1, gyro_x: 90}")}
          expect: {{sent: basestation, published: {{imu_data: any, imu/data_raw: {raw}}}}}
        """
    (failure,) = failures(tmp_path, IMU, tests)
    assert failure.table is not None
    for span, shown in ((failure.span, "2"), (failure.table.span, "radians(gyro_x)")):
        line = Path(span.file).read_text().splitlines()[span.line - 1]
        assert line[span.column - 1 : span.end_column - 1] == shown
    assert failure.table.note == "angular_velocity.x is filled here"


DIFFERENCES = [
    (f"{{published: {QUIET}}}", "imu_info {accel_x: 0.5, accel_y: 1} is sent to basestation; it is not expected"),
    (f"{{sent: [basestation, recorder], published: {QUIET}}}", "nothing for recorder: it was withheld"),
    (f"{{sent: basestation, filtered: [basestation], published: {QUIET}}}",
     "withheld from: recorder, not basestation"),
    (f"{{sent: {{basestation: {{ph_info: {{}}}}}}, published: {QUIET}}}",
     "imu_info {accel_x: 0.5, accel_y: 1} is sent to basestation, not ph_info"),
    (f"{{sent: {{basestation: {{times: 2}}}}, published: {QUIET}}}",
     "1 for basestation, not 2: imu_info {accel_x: 0.5, accel_y: 1} is sent to basestation"),
    (f"{{sent: {{basestation: {{hex: '00'}}}}, published: {QUIET}}}",
     "basestation gets the bytes 6a 0a 0d 00 00 00 3f 15 00 00 80 3f, not 00"),
    (f"{{rejected: malformed, sent: basestation, published: {QUIET}}}", "rejected: nothing, not malformed"),
    (f"{{dropped: {{imu_data: stale}}, sent: basestation, published: {QUIET}}}",
     "dropped for imu_data: nothing, not stale"),
    ("{sent: basestation, published: {imu_data: {accel_x: 0.5}, imu/data_raw: any}}",
     "imu_data: accel_y is 1, not at its default"),
    ("{sent: basestation, published: {imu_data: unchanged}}",
     f"{RAW} is published on imu/data_raw; it is not expected"),
    (f"{{sent: basestation, published: {{imu_data: unchanged, imu/data_raw: {RAW.replace('0 ms', '5ms')}}}}}",
     "imu/data_raw: header.stamp is 0 ms, not 5 ms"),
]  # fmt: skip


def test_what_differs_is_said(tmp_path: Path) -> None:
    took = given("{accel_x: 0.5, accel_y: 1}")
    tests = {str(number): f"{{given: {took}, expect: {expect}}}" for number, (expect, _) in enumerate(DIFFERENCES)}
    said = messages_of(tmp_path, IMU, tests)
    assert said == {str(number): [message] for number, (_, message) in enumerate(DIFFERENCES)}


def test_what_is_missing_is_explained_by_its_drop(tmp_path: Path) -> None:
    tests = f"""
        a:
          given: {given("{}")}
          expect: {{sent: basestation, published: {QUIET}}}
        """
    (message,) = messages(tmp_path, IMU, tests)
    assert message.startswith("nothing for imu/data_raw: it was dropped as mapping_error (")
    assert message.endswith("table.yaml:24:53: angular_velocity.y: division by zero)")


def test_rejection_is_told_once_and_not_as_everything_that_is_missing(tmp_path: Path) -> None:
    tests = """
        a:
          given: {case: imu_info, from: "10.9.8.7:6", listener: trimmed}
          expect: {sent: basestation}
        """
    assert messages(tmp_path, IMU, tests) == ["rejected: source_mismatch, not nothing (from 10.9.8.7:6: imu_info)"]


def test_what_is_expected_beside_a_rejection_is_looked_at(tmp_path: Path) -> None:
    tests = """
        a:
          given: {case: imu_info, from: "10.9.8.7:6", listener: trimmed}
          expect: {rejected: source_mismatch, sent: basestation}
        """
    assert messages(tmp_path, IMU, tests) == ["nothing for basestation"]


def test_a_target_that_another_route_has_is_shown_as_missing_in_the_route_that_took_the_message(tmp_path: Path) -> None:
    routes = """
        ph_info: {source: sensor_board, destinations: [recorder]}
        imu_info: {source: sensor_board, destinations: [basestation]}
        """
    (failure,) = failures(tmp_path, routes, f"a: {{given: {given('{}')}, expect: {{sent: [basestation, recorder]}}}}\n")
    assert failure.message == "nothing for recorder"
    assert failure.table is not None
    assert failure.table.note == "the route that took it has no such target"
    line = Path(failure.table.span.file).read_text().splitlines()[failure.table.span.line - 1]
    assert line.lstrip().startswith("imu_info:")


def test_a_drop_that_is_not_listed_fails_though_the_target_got_others(tmp_path: Path) -> None:
    routes = "imu_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: 10}]}\n"
    tests = f"a: {{given: {given('{}', ', times: 2')}, expect: {{sent: basestation}}}}\n"
    assert messages(tmp_path, routes, tests) == ["dropped for basestation: rate_limited, not nothing"]


def test_what_happens_between_two_steps_fails(tmp_path: Path) -> None:
    tests = """
        nothing: {steps: [{given: {topic: drive_motor}, expect: any}, {at: 650ms, expect: nothing}]}
        any: {steps: [{given: {topic: drive_motor}, expect: any}, {at: 650ms, expect: any}]}
        """
    found = failures(tmp_path, DRIVE, tests)
    assert len(found) == 2
    for failure in found:
        assert failure.message == (
            "before this step, at 500 ms manual_brake {brake: true} is sent to driving_board by the deadman of "
            "drive_motor, and so on, 2 in total; no step expects it"
        )
        assert failure.table is not None
        assert failure.table.note == "sent by this deadman"


def test_what_happened_in_a_failed_step_is_told_in_order_with_its_places(tmp_path: Path) -> None:
    tests = f"""
        missing:
          given: {given("{accel_x: 0.5}")}
          expect: {{sent: [basestation, recorder], published: {QUIET}}}
        other content:
          given: {given("{accel_x: 2, accel_y: 1}")}
          expect: {{sent: {{basestation: any, recorder: {{imu_info: {{accel_x: 3, accel_y: 1}}}}}}, published: {QUIET}}}
        """
    missing, other = run_tests(written(tmp_path, IMU, tests))
    (step,) = missing.failed
    assert [line.replace(f"{tmp_path}/", "") for line in step.events] == [
        "imu_info takes a message from sensor_board",
        "imu_info {accel_x: 0.5} is sent to basestation (table.yaml:17:20)",
        "imu_info withholds a message from recorder (table.yaml:17:60)",
        "{accel_x: 0.5} is published on imu_data (table.yaml:19:10)",
        (
            "a message for imu/data_raw is dropped as mapping_error "
            "(table.yaml:24:53: angular_velocity.y: division by zero)"
        ),
    ]
    assert [step.events for step in other.failed] == [[]]


# what is no test


IN_YAML = [
    ("{expect: {rejected: no}}", Code.AMBIGUOUS_SCALAR, "truth value"),
]
IN_SHAPE = [
    ("{expect: {rejected: lost}}", Code.BAD_VALUE, "'rejected' must be one of truncated, empty"),
    ("{expects: nothing}", Code.UNKNOWN_KEY, "no key 'expects'"),
    ("{expect: sent}", Code.BAD_VALUE, "'expect' must be 'nothing', 'any', or a mapping"),
]
TEXT = "{accel_x: '1.5'}"
IN_MEANING = [
    (
        "{given: {case: imu, from: sensor_board, listener: exact}, expect: nothing}",
        Code.UNKNOWN_PAYLOAD_CASE,
        "payload case 'imu'",
    ),
    ("{given: {case: imu_info, from: sensor}, expect: nothing}", Code.UNKNOWN_ENDPOINT, "'sensor'"),
    ("{given: {case: imu_info, from: sensor_board}, expect: nothing}", Code.MISSING_KEY, "name the listener"),
    ("{given: {case: imu_info, from: sensor_board, listener: x}, expect: nothing}", Code.BAD_VALUE, "listener 'x'"),
    (
        "{given: {case: imu_info, from: 'fd00::1', listener: exact}, expect: nothing}",
        Code.BAD_VALUE,
        "nothing arrives from fd00::1 at 'exact'",
    ),
    (
        "{given: {case: imu_info, from: '[fd00::1]', listener: exact}, expect: nothing}",
        Code.UNKNOWN_ENDPOINT,
        "neither HOST[:PORT] nor a name",
    ),
    ("{given: {topic: imu_data}, expect: nothing}", Code.BAD_VALUE, "no route from the topic 'imu_data'"),
    (f"{{given: {given('{accel: 1}')}, expect: nothing}}", Code.UNKNOWN_FIELD, "has no field 'accel'"),
    (f"{{given: {given('{accel_x: 1e39}')}, expect: nothing}}", Code.BAD_VALUE, "does not fit float32"),
    (f"{{given: {given(TEXT)}, expect: nothing}}", Code.WRONG_TYPE, "the text '1.5' is not a float32"),
    (f"{{given: {given('{is_calibrated: 1}')}, expect: nothing}}", Code.WRONG_TYPE, "'1' is not a bool"),
    (f"{{given: {given('{accel_x: any}')}, expect: nothing}}", Code.BAD_VALUE, "'any' is not a number"),
    (
        "{given: {cases: {imu: {}}, from: sensor_board, listener: exact}, expect: nothing}",
        Code.UNKNOWN_PAYLOAD_CASE,
        "payload case 'imu'",
    ),
    (
        "{given: {cases: {imu_info: {}}, fields: {accel_x: 1}, from: sensor_board, listener: exact}, expect: nothing}",
        Code.UNKNOWN_KEY,
        "'fields' needs 'case'",
    ),
    (
        "{given: {cases: {imu_info: {}}, case: imu_info, from: sensor_board, listener: exact}, expect: nothing}",
        Code.BAD_VALUE,
        "as 'case' with 'fields', as 'cases' or as 'hex'",
    ),
    (
        (
            "{given: {cases: {imu_info: {}}, from: sensor_board, listener: exact}, "
            "expect: {published: {imu_data: unchanged}}}"
        ),
        Code.BAD_VALUE,
        "needs fields that are given",
    ),
    ("{expect: {sent: nobody}}", Code.UNKNOWN_ENDPOINT, "no endpoint 'nobody'"),
    ("{expect: {sent: driving_board}}", Code.UNKNOWN_ENDPOINT, "no route to the endpoint 'driving_board'"),
    ("{expect: {sent: basestation}}", Code.BAD_VALUE, "needs a datagram that is given"),
    ("{expect: {published: {imu: {}}}}", Code.BAD_VALUE, "no route that publishes on 'imu'"),
    ("{expect: {published: {imu_data: {accel: 1}}}}", Code.UNKNOWN_FIELD, "has no field 'accel'"),
    ("{expect: {published: {imu_data: unchanged}}}", Code.BAD_VALUE, "needs fields that are given"),
    ("{expect: {dropped: {basestation: lost}}}", Code.BAD_VALUE, "no reason 'lost'"),
    ("{expect: {dropped: {nobody: stale}}}", Code.BAD_VALUE, "no route to 'nobody'"),
    ("{expect: {route: imu}}", Code.BAD_VALUE, "no route 'imu'"),
    ("{expect: {filtered: nobody}}", Code.BAD_VALUE, "no route to 'nobody'"),
    ("{given: {hex: '00', from: sensor_board, listener: exact}}", Code.MISSING_KEY, "has no 'expect'"),
    ("{steps: [{at: 2s, expect: nothing}, {at: 1s, expect: nothing}]}", Code.BAD_VALUE, "1 s, earlier than the 2 s"),
    ("{steps: [{expect: nothing}], expect: nothing}", Code.UNKNOWN_KEY, "'expect' is beside 'steps'"),
    (
        f"{{steps: [{{given: {given('{}', ', times: 3, every: 1s')}, until: 1999 ms, expect: any}}]}}",
        Code.BAD_VALUE,
        "1.999 s, earlier than the 2 s",
    ),
    ("{steps: [{until: 1s, expect: any}, {at: 999 ms, expect: any}]}", Code.BAD_VALUE, "999 ms, earlier than the 1 s"),
    ("{steps: [{stop: true, expect: nothing}, {at: 1s, expect: nothing}]}", Code.BAD_VALUE, "stops the router"),
    (f"{{given: {given('{}')}, expect: {{sent: [basestation, basestation]}}}}", Code.BAD_VALUE, "named twice"),
    ("{expect: {published: {imu_data: {accel_x: 1 +- inf}}}}", Code.BAD_VALUE, "'inf' is not a tolerance"),
    ("{expect: {published: {imu_data: {accel_x: 1 +- -1}}}}", Code.BAD_VALUE, "the tolerance '-1' is negative"),
    ("{expect: {published: {imu_data: {accel_x: nan +- 1}}}}", Code.BAD_VALUE, "'nan' is not a number to be near"),
    ("{expect: {published: {imu_data: {accel_x: ~1e400}}}}", Code.BAD_VALUE, "'1e400' is not a number to be near"),
]


def test_what_is_wrong_with_a_test_is_a_finding_with_its_place(tmp_path: Path) -> None:
    for mistakes in (IN_YAML, IN_SHAPE, IN_MEANING):  # where a file has some of one kind, the next is not looked at
        tests = "".join(f"t{number}: {test}\n" for number, (test, _, _) in enumerate(mistakes))
        found = findings(tmp_path, IMU, tests)
        assert len(found) == len(mistakes)
        for finding in found:
            _, code, said = mistakes[finding.span.line - 2]
            assert finding.code is code
            assert said in finding.message
            assert finding.span.file.endswith("table.test.yaml")
        assert {finding.span.line for finding in found} == set(range(2, len(mistakes) + 2))


def test_padding_that_is_too_small_is_found_when_the_test_runs(tmp_path: Path) -> None:
    file = written(tmp_path, IMU, f"a: {{given: {given('{accel_x: 1}', ', pad: 2')}, expect: nothing}}\n")
    (result,) = run_tests(file)
    assert not result.passed
    assert [finding.code for finding in result.findings] == [Code.BAD_VALUE]


def test_payloads_that_one_datagram_cannot_hold_are_found_when_the_test_runs(tmp_path: Path) -> None:
    given_both = "{cases: {imu_info: {}, ph_info: {}}, from: sensor_board, listener: exact}"
    [result] = run_tests(written(tmp_path, IMU, f"t: {{given: {given_both}, expect: any}}\n"))
    [finding] = result.findings
    assert (finding.code, finding.message) == (Code.BAD_VALUE, "PBEnvelope cannot hold imu_info and ph_info at once")


def test_every_finding_of_a_file_is_told_at_once(tmp_path: Path) -> None:
    tests = "a: {expect: {sent: nobody}}\nb: {expect: {route: nothing_like_it}}\n"
    assert len(findings(tmp_path, IMU, tests)) == 2


def test_table_is_the_one_that_the_file_is_named_after_or_that_it_names(tmp_path: Path) -> None:
    written(tmp_path, IMU, "a: {expect: nothing}\n")
    other = tmp_path / "other.test.yaml"
    other.write_text("tests: {a: {expect: nothing}}\n")
    with pytest.raises(TableError, match="not named after a table"):
        read_test_file(other, DEFINITIONS)
    other.write_text("table: table.yaml\ntests: {a: {expect: nothing}}\n")
    assert read_test_file(other, DEFINITIONS).checked.path == tmp_path / "table.yaml"


@pytest.mark.parametrize(
    ("written_in_full", "hint"),
    [
        ("tests: {a: {given: {case:ph_info}, expect: any}}", "write `case: ph_info`, with a space after ':'"),
        ("tests: {a: {when: {case: ph_info, from: sensor_board}, expect: any}}", "did you mean 'given'?"),
        ("tests: {a: {then: any}}", "did you mean 'expect'?"),
        ("tests: {a: {given: {case: ph_info, source: sensor_board}, expect: any}}", "did you mean 'from'?"),
        ("tests: {a: {given: {case: ph_info, from: x, count: 2}, expect: any}}", "did you mean 'times'?"),
        ("tests: {a: {expect: {rejected: source_missmatch}}}", "did you mean 'source_mismatch'?"),
        ("tests: {a: {steps: [{wait: 1s, expect: any}]}}",
         "write the time since the start of the test: `at: 500ms`"),
        ("tests:\n  a:\n    expect:\n    sent: basestation", "indent its keys below it"),
        ("table: tabel.yaml\ntests: {a: {expect: any}}", "did you mean 'table.yaml'?"),
        ("variables: {BASESTATON: x}\ntests: {a: {expect: any}}", "did you mean 'BASESTATION'?"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_has_a_hint(written_in_full: str, hint: str, tmp_path: Path) -> None:
    head = HEAD.replace("PROTOS", str(PROTOS)).replace(
        "version: 1\n", "version: 1\nnode: {name: '${BASESTATION:-a}'}\n"
    )
    (tmp_path / "table.yaml").write_text(head + "  ph_info: {ignore: not of interest}\n")
    path = tmp_path / "table.test.yaml"
    path.write_text(written_in_full)
    with pytest.raises(TableError) as raised:
        read_test_file(path, DEFINITIONS)
    assert [found.hint for found in raised.value.diagnostics] == [hint]


def test_an_empty_file_is_told_what_a_test_file_is(tmp_path: Path) -> None:
    path = tmp_path / "empty.test.yaml"
    path.write_text("\n")
    with pytest.raises(TableError, match="a test file is a mapping with the key 'tests'"):
        read_test_file(path, DEFINITIONS)


def test_table_with_errors_is_told_as_validate_does(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="unknown-field"):
        written(tmp_path, IMU.replace("radians(gyro_x)", "gyro"), "a: {expect: nothing}\n")


def test_folder_stands_for_its_test_files(tmp_path: Path) -> None:
    for name in ("b.test.yaml", "a.test.yml", "a.yaml", ".c.test.yaml"):
        (tmp_path / name).touch()
    assert [path.name for path in find_test_files([tmp_path, tmp_path / "b.test.yaml"])] == [
        "a.test.yml",
        "b.test.yaml",
    ]


# services

CALLS = f"""
version: 1
extends: {Path(__file__).parent / "tables" / "services.yaml"}
"""
CALLED = "{call: arm, request: {data: true}}"


def of_services(folder: Path, *steps: str) -> TestFile:
    (folder / "calls.yaml").write_text(CALLS)
    path = folder / "calls.test.yaml"
    path.write_text("tests:\n  a:\n    steps:\n" + "".join(f"      - {step}\n" for step in steps))
    return read_test_file(path, DEFINITIONS)


def said_of_services(folder: Path, *steps: str) -> list[tuple[str, str | None]]:
    """What is said, and the text of the table with it."""
    (result,) = run_tests(of_services(folder, *steps))
    found = []
    for failure in result.failures:
        span = failure.table.span if failure.table else None
        line = Path(span.file).read_text().splitlines()[span.line - 1] if span else ""
        found.append((failure.message, line[span.column - 1 : span.end_column - 1] if span else None))
    return found


@pytest.mark.parametrize(
    ("step", "said", "place"),
    [
        (f"{{given: {CALLED}, expect: nothing}}",
         "arm_request {armed: true, id: 1} is sent to arm_board; it is not expected", "arm_board"),
        (f"{{given: {CALLED}, expect: {{sent: {{arm_board: {{arm_request: any}}}}, answered: {{arm: any}}}}}}",
         "nothing for service.arm", "reply"),
        ("{given: {case: arm_reply, from: arm_board, envelope: {req_id: 9}}, expect: nothing}",
         "dropped for service.arm: unmatched, not nothing (number 9)", "reply"),
        ("{given: {call: arm, age: 1s}, expect: {dropped: {arm_board: stale}}}",
         "{message: 'the request is too old, or arm_board cannot take its values'} answers arm; it is not expected",
         "on_timeout"),
        ("{given: {call: tool, times: 2}, expect: {sent: {arm_board: any}, answered: {tool: {message: busy}}}}",
         "service.tool: message is 'arm_board has not replied to an earlier call', not 'busy'", "on_timeout"),
        ("{given: {case: home_request, from: arm_board, fields: {fast: true}}, expect: nothing}",
         "{data: true} calls ask_home; it is not expected", "call"),
        ("{given: {case: home_request, from: arm_board, fields: {fast: true}}, expect: {called: {ask_home: {}}}}",
         "service.ask_home: data is true, not at its default", "fast"),
    ],
)  # fmt: skip
def test_a_difference_of_a_service_is_named(step: str, said: str, place: str, tmp_path: Path) -> None:
    assert said_of_services(tmp_path, step) == [(said, place)]


def test_what_happens_between_steps_includes_the_end_of_calls(tmp_path: Path) -> None:
    steps = f"{{given: {CALLED}, until: 600ms, expect: any}}", "{at: 2s, expect: nothing}"
    message = (
        "before this step, at 1 s {message: 'arm_board did not reply within 500 ms'} answers arm; no step expects it"
    )
    assert said_of_services(tmp_path, *steps) == [(message, "on_timeout")]


def test_what_on_timeout_fills_is_shown_in_place_of_the_reply(tmp_path: Path) -> None:
    asked = "{given: {case: home_request, from: arm_board, fields: {id: 7}}, expect: {called: {ask_home: any}}}"
    late = "{at: 1s, expect: {sent: {arm_board: {home_reply: {id: 8}}}}}"
    (result,) = run_tests(of_services(tmp_path, asked, late))
    (failure,) = result.failures
    assert failure.table is not None
    assert "on_timeout" in Path(failure.table.span.file).read_text().splitlines()[failure.table.span.line - 1]


def test_what_happened_says_how_calls_ended(tmp_path: Path) -> None:
    (result,) = run_tests(of_services(tmp_path, f"{{given: {CALLED}, until: 1s, expect: nothing}}"))
    (step,) = result.failed
    assert "at 1 s a call of service.arm ends as timed_out" in step.events[-1]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("{call: arn}", "calls.yaml has no service that an endpoint answers: 'arn'"),
        ("{call: ask_home}", "calls.yaml has no service that an endpoint answers: 'ask_home'"),
        ("{answer: arm}", "calls.yaml has no service that an endpoint calls: 'arm'"),
        ("{topic: service.arm}", "calls.yaml has no route from the topic 'service.arm'"),
        ("{call: arm, response: {success: true}}", "a call has no key 'response'"),
        ("{call: arm, topic: arm}", "a ROS message has no key 'call'"),
        ("{answer: ask_home, age: 1s}", "an answer has no key 'age'"),
        ("{call: arm, request: {}, hex: '00'}", "a call has 'request' or 'hex', not both"),
        ("{case: arm_reply, from: arm_board, request: {data: true}}", "a datagram has no key 'request'"),
    ],
)
def test_a_mistake_in_a_call_is_found(given: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(TableError) as raised:
        of_services(tmp_path, f"{{given: {given}, expect: any}}")
    assert [found.message for found in raised.value.diagnostics] == [message]


@pytest.mark.parametrize(
    "expected",
    ["answered: {ask_home: any}", "called: {arm: any}", "published: {service.arm: any}"],
)
def test_a_service_is_expected_in_its_direction(expected: str, tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"calls\.yaml has no "):
        of_services(tmp_path, f"{{expect: {{{expected}}}}}")


# coverage


def gaps(folder: Path, routes: str, tests: str, head: str = HEAD) -> list[tuple[str, str]]:
    """Of what, and the text of the table with it."""
    file = written(folder, routes, tests, head)
    coverage = Coverage(file.checked, file.program)
    assert all(result.passed for result in run_tests(file, coverage=coverage))
    lines = (folder / "table.yaml").read_text().splitlines()
    found = []
    for gap in coverage.gaps():
        shown = lines[gap.span.line - 1][gap.span.column - 1 : gap.span.end_column - 1]
        found.append((gap.kind, shown))
    return found


STRANGER_REJECTED = """
strangers:
  steps:
    - {given: {hex: 6a 00, from: 192.168.0.99, listener: trimmed}, expect: {rejected: source_mismatch}}
    - {given: {hex: 6a 00, from: 192.168.0.99, listener: exact}, expect: {rejected: source_mismatch}}
"""


def test_nothing_is_covered_without_a_message(tmp_path: Path) -> None:
    found = gaps(tmp_path, IMU, "a: {expect: nothing}\n")
    assert found.count(("route", "imu_info")) == 1
    assert [kind for kind, _ in found].count("target") == 4
    assert {shown for kind, shown in found if kind == "rejection"} == {"trimmed", "exact", "accel_x > 1"}


def test_condition_has_to_hold_and_to_withhold(tmp_path: Path) -> None:
    routes = "imu_info: {source: any, destinations: [{endpoint: basestation, when: accel_x > 1}]}"
    holds = f"a: {{given: {given('{accel_x: 2}')}, expect: {{sent: basestation}}}}\n"
    withholds = f"b: {{given: {given('{}')}, expect: nothing}}\n"
    assert gaps(tmp_path, routes, holds) == [("rejection", "accel_x > 1")]
    assert gaps(tmp_path, routes, withholds) == [("target", "endpoint")]
    assert gaps(tmp_path, routes, holds + withholds) == []


def test_what_nobody_compared_is_not_covered(tmp_path: Path) -> None:
    tests = f"a: {{given: {given('{accel_y: 1, gyro_x: 1}')}, expect: {{sent: basestation, published: {QUIET}}}}}\n"
    found = gaps(tmp_path, IMU, tests)
    assert [kind for kind, _ in found].count("target") == 3


def test_limits_have_to_be_reached(tmp_path: Path) -> None:
    routes = "imu_info: {source: any, destinations: [{endpoint: recorder, max_rate: 10 Hz}], ttl: 200ms}"
    within = f"a: {{given: {given('{}')}, expect: {{sent: recorder}}}}\n"
    assert [kind for kind, _ in gaps(tmp_path, routes, within)] == ["rejection"] * 2
    stale = f"b: {{given: {given('{}', ', age: 300ms')}, expect: {{dropped: {{recorder: stale}}}}}}\n"
    assert len(gaps(tmp_path, routes, within + stale)) == 1
    often = f"""
        c:
          given: {given("{}", ", times: 2")}
          expect: {{sent: recorder, dropped: {{recorder: rate_limited}}}}
        """
    assert gaps(tmp_path, routes, within + stale + dedent(often)) == []


def test_a_budget_has_to_be_exceeded(tmp_path: Path) -> None:
    head = HEAD.replace("kind: basestation}", "kind: basestation, bandwidth: 1kB/s}")
    routes = "imu_info: {source: any, destinations: [basestation]}"
    within = f"a: {{given: {given('{}')}, expect: {{sent: basestation}}}}\n"
    assert gaps(tmp_path, routes, within, head) == [("rejection", "basestation")]
    beyond = f"""
        b:
          given: {given("{accel_x: 1}", ", times: 10000")}
          expect: {{sent: {{basestation: {{times: 2}}}}, dropped: {{basestation: {{queue_full: 5902}}}}}}
        """
    assert gaps(tmp_path, routes, within + dedent(beyond), head) == []


def test_a_frame_has_to_stay_incomplete(tmp_path: Path) -> None:
    routes = FRAMES.replace("source: basestation", "source: any")
    part = "{case: detected_object, from: basestation, listener: trimmed, fields: {frame_id: 7, total_count: 1}}"
    whole = f"a: {{given: {part}, expect: {{published: {{seen: {{frame_id: 7, detections: [any]}}}}}}}}\n"
    assert [kind for kind, _ in gaps(tmp_path, routes, whole)] == ["rejection"]
    cut = part.replace("count: 1", "count: 2")
    lost = f"b: {{given: {cut}, until: 1s, expect: {{dropped: {{seen: incomplete}}}}}}\n"
    assert gaps(tmp_path, routes, whole + lost) == []


def test_every_listener_has_to_refuse_a_sender(tmp_path: Path) -> None:
    routes = "imu_info: {source: sensor_board, destinations: [basestation]}"
    sent = f"a: {{given: {given('{}')}, expect: {{sent: basestation}}}}\n"
    assert gaps(tmp_path, routes, sent) == [("rejection", "trimmed"), ("rejection", "exact")]
    assert gaps(tmp_path, routes, sent + STRANGER_REJECTED) == []


def test_deadman_is_a_target(tmp_path: Path) -> None:
    moves = "{given: {topic: drive_motor, message: {distance_to_go: 1}}, expect: {sent: {driving_board: any}}}"
    assert ("target", "deadman") in gaps(tmp_path, DRIVE, f"a: {moves}\n")
    tests = f"""
        a:
          steps:
            - {moves.replace("any", "{drive_motor: unchanged}")}
            - {{at: 500ms, expect: {{sent: {{driving_board: {{manual_brake: {{brake: true}}}}}}}}}}
        """
    assert gaps(tmp_path, DRIVE, tests) == [("rejection", "200ms")]


def test_a_service_needs_a_call_a_reply_and_one_without(tmp_path: Path) -> None:
    call = f"{{given: {CALLED}, expect: {{sent: {{arm_board: {{arm_request: {{armed: true, id: 1}}}}}}}}}}"
    reply = (
        "{given: {case: arm_reply, from: arm_board, fields: {ok: true}, envelope: {req_id: 1}}, "
        "expect: {answered: {arm: {success: true}}}}"
    )
    late = "{at: 500ms, expect: {sent: {arm_board: any}}}", "{at: 1s, expect: {answered: {arm: {message: any}}}}"
    asked = "{given: {case: home_request, from: arm_board}, expect: {called: {ask_home: {}}}}"
    response = "{given: {answer: ask_home}, expect: {sent: {arm_board: {home_reply: {}}}}}"
    unanswered = "{at: 1s, expect: {sent: {arm_board: {home_reply: {}}}}}"

    def missing(name: str, *steps: str) -> list[str]:
        file = of_services(tmp_path, *steps)
        coverage = Coverage(file.checked, file.program)
        assert all(result.passed for result in run_tests(file, coverage=coverage))
        return [gap.gap for gap in coverage.gaps() if re.search(rf"\b{name}\b", gap.gap)]

    timed_out = "no test has a call of arm that times out"
    stale = "no test has a message of service.arm that is older than this"
    no_reply = "no test checks what arm_reply delivers to service.arm"
    assert missing("arm", call, reply) == [stale, timed_out]
    assert missing("arm", call, *late) == [no_reply, stale]
    assert missing("ask_home", asked, response) == ["no test has a call of ask_home that times out"]
    assert missing("ask_home", asked, unanswered) == ["no test checks what service.ask_home delivers to arm_board"]


def test_files_of_one_table_cover_it_together(tmp_path: Path) -> None:
    routes = 'imu_info: {source: any, destinations: [{endpoint: basestation, when: "accel_x > ${LIMIT:-1}"}]}'
    first = written(tmp_path, routes, f"a: {{given: {given('{accel_x: 2}')}, expect: {{sent: basestation}}}}\n")
    path = tmp_path / "more.test.yaml"
    nothing = f"b: {{given: {given('{accel_x: 2}')}, expect: nothing}}"
    path.write_text(f"table: table.yaml\nvariables: {{LIMIT: 3}}\ntests:\n  {nothing}\n")
    second = read_test_file(path, DEFINITIONS)
    covered = [Coverage(file.checked, file.program) for file in (first, second)]
    for file, coverage in zip((first, second), covered, strict=True):
        assert all(result.passed for result in run_tests(file, coverage=coverage))
        assert not coverage.is_complete
    covered[0].add(covered[1])
    assert covered[0].is_complete


def test_times_are_shown_as_a_test_writes_them() -> None:
    shown = {0: "0 ms", 300_000_000: "300 ms", 1_999_000_000: "1.999 s", -250_000_000: "-250 ms"}
    assert {ns: offset(ns) for ns in shown} == shown
