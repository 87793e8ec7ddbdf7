"""`router test` on the rover's own tables, as a person and as CI would run it."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest

from router.assets import asset
from router.cli import BAD_TABLE, BAD_USAGE, OK, main
from router.cli.test import FAILED
from router.compiler import check_table
from router.compiler.lookup import Definitions
from router.library import load
from router.rehearsal.reading import SCHEMA, TestFile, read_test_file
from router.rehearsal.running import run_tests
from router.table.schema import table_schema
from tests.tables import PROTOS, RIG, ROUTES

REPOSITORY = Path(__file__).parents[2]
DEFINITIONS = Definitions()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rover's protos, which are compiled once for all tables in it."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "protos").symlink_to(PROTOS)
    shutil.copytree(ROUTES, folder / "routes")
    return folder


@pytest.fixture
def rover(site: Path, unchanged: TestFile, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the rover's table with its tests, to be changed."""
    for name in ("rover.yaml", "rover.test.yaml"):
        shutil.copy(ROUTES / name, site / "routes")
    monkeypatch.chdir(site)
    monkeypatch.setattr("router.compiler.lookup.Definitions", lambda: DEFINITIONS)
    return site / "routes" / "rover.yaml"


@pytest.fixture(scope="module")
def unchanged(site: Path) -> TestFile:
    return read_test_file(site / "routes" / "rover.test.yaml", DEFINITIONS)


def change(table: Path, old: str, new: str) -> None:
    text = table.read_text(encoding="utf-8")
    assert old in text
    table.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_the_tests_of_the_rover_pass_and_cover_its_table_completely(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(RIG)
    assert main(["test", "routes", "--coverage"]) == OK
    out = capsys.readouterr().out
    covered = re.search(r"rover\.yaml: covered (\d+) of (\d+) routes, (\d+) of (\d+) targets, (\d+) of (\d+) rej", out)
    assert covered is not None
    assert covered[1] == covered[2]
    assert covered[3] == covered[4]
    assert covered[5] == covered[6]
    assert out.endswith(" tests passed, in 1 file\n")


def test_without_the_library_one_sentence_says_what_to_do(
    rover: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("router.rehearsal.rehearsal.library", lambda: load(tmp_path / "libcarrier.so"))
    assert main(["test", str(rover)]) == BAD_TABLE
    what, remedy = capsys.readouterr().err.splitlines()
    assert what == f"router test: {tmp_path}/libcarrier.so was not built, and nothing runs without it"
    assert remedy.strip() == "help: run 'make setup'"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("radians(gyro_y)", "radians(gyro_x)"),
        ("mag_z / 1e6", "mag_z / 1e3"),
        ("'imu_link'", "'imu'"),
        ("x: speed * sin(radians(heading))", "x: speed * cos(radians(heading))"),
        ("16 * vdop * vdop", "16 * hdop * vdop"),
        ("hdop > 0 and vdop > 0", "hdop > 0 or vdop > 0"),
        ("NavSatStatus.STATUS_SBAS_FIX if", "NavSatStatus.STATUS_FIX if"),
        ("pressure_kpa * 1000", "pressure_kpa * 100"),
        ("str(sensor_index)", "str(sensor_index + 1)"),
        ("gps_sensor: gps_sensor_1", "state: state"),
        ("    source: sensor_board\n    destinations: [basestation]\n", "    source: sensor_board\n"),
        ("    topics: [{topic: drive_progress", "    destinations: [basestation]\n    topics: [{topic: drive_progress"),
        ("ttl: 200ms", "ttl: 300ms"),
        ("timeout: 500ms", "timeout: 400ms"),
        ("timeout: 500ms", "timeout: 600ms"),
        ("repeat: 100ms", "repeat: 200ms"),
        ("{brake: true}", "{brake: false}"),
        ("disarmed_by: [manual_drive]", "disarmed_by: [manual_brake]"),
        ("disarmed_by: [drive_motor]", "disarmed_by: [manual_brake]"),
        ("disarmed_by: [arm_ctrl, arm_target]", "disarmed_by: [arm_ctrl]"),
        ("total_count: count", "total_count: index"),
        ("index: index", "index: count"),
        ("if hdop > 0 and", "if hdop >= 0 and"),
        ("and vdop > 0", "and vdop > 1"),
        ("  pump_info:\n", "  pump_info:\n    ttl: 100ms\n"),
        ("  control_mode:\n", "  control_mode:\n    ttl: 100ms\n"),
        ("destinations: [basestation]", "destinations: [{endpoint: basestation, max_rate: 10}]"),
    ],
)
def test_whatever_is_changed_in_the_table_some_test_notices(
    rover: Path, unchanged: TestFile, old: str, new: str
) -> None:
    change(rover, old, new)
    checked = check_table(rover, {}, DEFINITIONS)
    assert checked.program is not None
    file = replace(unchanged, checked=checked, program=checked.program)
    assert not all(result.passed for result in run_tests(file))


def test_failure_shows_both_files(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(rover, "radians(gyro_y)", "radians(gyro_x)")
    assert main(["test", "routes"]) == FAILED
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(": failed: the IMU reaches the operator as it is, and ROS in SI units")
    assert re.fullmatch(
        r"routes/rover\.test\.yaml:\d+:\d+: imu/data_raw: angular_velocity\.y is 1\.57\d*, not ~-3\.142", lines[1]
    )
    assert lines[2].endswith("angular_velocity: {x: ~1.571, y: ~-3.142, z: ~0.785}")
    assert lines[3].strip(" |") == "^" * len("~-3.142")
    assert lines[4].startswith("routes/rover.yaml:")
    assert lines[4].endswith(": angular_velocity.y is filled here")
    assert lines[6].strip(" |") == "^" * len("radians(gyro_x)")
    assert re.fullmatch(r"1 of \d+ tests failed, in 1 file", lines[-1])


def test_what_no_test_touches_is_listed_and_fails(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tests = rover.with_name("rover.test.yaml")
    change(tests, "arm_feedback: {arm_error: 3}", "arm_feedback: any")
    assert main(["test", "--coverage", "routes"]) == FAILED
    out = capsys.readouterr().out
    assert "not covered: no test checks what arm_feedback delivers to arm_feedback\n" in out
    assert "topic: arm_feedback" in out


def test_a_table_that_extends_another_needs_tests_of_what_it_changes_only(
    rover: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = rover.parents[1] / "lab" / "scale.yaml"
    table.parent.mkdir()
    topic = "{topic: scale, type: std_msgs/msg/Float32, fields: {data: force_newtons}}"
    table.write_text(f"version: 1\nextends: ../routes/rover.yaml\nroutes:\n  load_cell_info: {{topics: [{topic}]}}\n")
    tests = table.with_name("scale.test.yaml")
    tests.write_text("tests:\n  a: {expect: nothing}\n")
    assert main(["test", "--coverage", "--json", "routes", "lab"]) == FAILED
    inherited, changed = json.loads(capsys.readouterr().out)["coverage"]
    assert inherited["gaps"] == []
    lacking = [(gap["kind"], gap["file"]) for gap in changed["gaps"]]
    assert lacking == [(kind, "lab/scale.yaml") for kind in ("route", "target")]
    assert all(changed[kind]["touched"] == changed[kind]["all"] - 1 for kind in ("routes", "targets"))
    given = "given: {case: load_cell_info, from: sensor_board, fields: {force_newtons: 2}}"
    tests.write_text(f"tests:\n  a: {{{given}, expect: {{sent: basestation, published: {{scale: {{data: 2}}}}}}}}\n")
    assert main(["test", "--coverage", "routes", "lab"]) == OK
    assert "not covered" not in capsys.readouterr().out
    assert main(["test", "--coverage", "lab"]) == FAILED  # nothing has run that covers what it inherits


def test_json_has_results_and_coverage(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(rover, "pressure_kpa * 1000", "pressure_kpa * 100")
    assert main(["test", "--coverage", "--json", "routes"]) == FAILED
    data = json.loads(capsys.readouterr().out)
    (failed,) = [test for test in data["tests"] if not test["passed"]]
    (failure,) = failed["failures"]
    assert failure["message"] == "pressure/data: fluid_pressure is 10125.0, not 101250.0"
    assert failure["file"] == "routes/rover.test.yaml"
    assert failure["table"]["file"] == "routes/rover.yaml"
    (coverage,) = data["coverage"]
    assert coverage["table"] == "routes/rover.yaml"
    assert coverage["routes"]["touched"] == coverage["routes"]["all"] > 20
    assert coverage["gaps"] == []
    assert data["findings"] == []
    change(rover.with_name("rover.test.yaml"), "from: sensor_board", "from: sensor_bord")
    assert main(["test", "--json", "routes"]) == BAD_TABLE
    (found,) = json.loads(capsys.readouterr().out)["findings"]
    assert found["code"] == "unknown-endpoint"


def test_github_shows_failures_beside_the_lines(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(rover, "pressure_kpa * 1000", "pressure_kpa * 100")
    assert main(["test", "--github", "routes"]) == FAILED
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("::error file=routes/rover.test.yaml,line=")
    assert "title=pressure reaches the operator and ROS%2C in pascal" in line


def test_only_runs_the_tests_that_are_named_so(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["test", "--only", "the operator", "routes"]) == OK
    some = int(capsys.readouterr().out.split()[0])
    assert main(["test", "routes"]) == OK
    assert 1 < some < int(capsys.readouterr().out.split()[0])
    assert main(["test", "--only", "the operator", "--coverage", "routes"]) == BAD_USAGE
    assert main(["test", "--only", "the oprator", "routes"]) == BAD_USAGE
    assert "no test has 'the oprator' in its name" in capsys.readouterr().err


def test_what_is_wrong_with_a_test_file_is_exit_code_78(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tests = rover.with_name("rover.test.yaml")
    change(tests, "from: sensor_board", "from: sensor_bord")
    assert main(["test", "routes"]) == BAD_TABLE
    heard = capsys.readouterr()
    assert "error[unknown-endpoint]" in heard.err
    assert "did you mean 'sensor_board'?" in heard.err
    assert heard.out == ""


def test_route_that_is_gone_from_the_table_is_noticed(rover: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(rover, "topic: imu/mag", "topic: imu/magnetic_field")
    assert main(["test", "routes"]) == BAD_TABLE
    assert "rover.yaml has no route that publishes on 'imu/mag'" in capsys.readouterr().err


def test_folder_without_tests_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["test", str(tmp_path)]) == BAD_USAGE
    assert "no tests (*.test.yaml)" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["test", "validate"])
def test_a_folder_that_cannot_be_read_is_wrong_usage(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(_: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    assert main([verb, str(tmp_path)]) == BAD_USAGE
    assert f"the folder '{tmp_path}' cannot be read: Permission denied" in capsys.readouterr().err


SERVICES = REPOSITORY / "tests" / "rehearsal" / "tables" / "services.yaml"
LISTED = """
version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 127.0.0.1:5000}}
endpoints:
  sensor_board: {address: 192.168.0.30:8, kind: board}
  basestation: {address: 192.168.0.10:9000, kind: basestation}
routes:
  gps_info: {source: sensor_board, destinations: [{endpoint: basestation, max_rate: 10 Hz}]}
  detected_object:
    source: basestation
    collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
    topics:
      - topic: objects_of_others
        type: comms/msg/DetectedObjectArray
        fields: {frame_id: frame_id, detections: items}
"""


def test_examples_of_the_documentation_pass(tmp_path: Path, rover: Path) -> None:
    text = (REPOSITORY / "docs" / "guides" / "test-tables.md").read_text(encoding="utf-8")
    examples = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    listed = tmp_path / "listed.yaml"
    listed.write_text(LISTED.replace("PROTOS", str(PROTOS)))
    for number, example in enumerate(examples):
        table = listed if "max_rate" in example or "incomplete" in example else rover
        table = SERVICES if "call:" in example else table
        path = tmp_path / f"example-{number}.test.yaml"
        path.write_text(f"table: {table}\n{example}")
        results = run_tests(read_test_file(path, DEFINITIONS))
        assert [result.failures for result in results if not result.passed] == []
    assert len(examples) == 4


def test_schema_is_one_and_describes_every_key() -> None:
    schema = json.loads(asset(SCHEMA).read_text(encoding="utf-8"))
    jsonschema.Draft7Validator.check_schema(schema)
    for definition in schema["definitions"].values():
        for name, key in definition.get("properties", {}).items():
            assert "$ref" in key or key.get("description"), name
    assert table_schema()["$schema"] == schema["$schema"]


def test_a_wrong_table_without_tests_is_shown_as_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "table.yaml"
    table.write_text("version: 1\nlisten: 5\n", encoding="utf-8")
    assert main(["test", "-t", str(table)]) == BAD_TABLE
    assert "table.yaml:2:9: error[" in capsys.readouterr().err
