"""`router explain` prints everything that decides what becomes of a message."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main
from tests.tables import ROUTES

BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
TABLE = """\
version: 1
extends: {base}
endpoints: {{laptop: {{address: 127.0.0.99:9999, kind: tool}}}}
routes:
  imu_info:
    destinations: [basestation, {{endpoint: laptop, when: is_calibrated, max_rate: 5 Hz}}]
    topics:
      - {{topic: x, type: std_msgs/msg/Float32, when: "accel_x > 1 or accel_y > 1", fields: {{data: accel_x * 2}}}}
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(base=BASE))
    return path


def explained(capsys: pytest.CaptureFixture[str], table: Path, *words: str) -> str:
    assert main(["explain", *words, "--table", str(table)]) == OK
    return capsys.readouterr().out


def test_a_route_is_told_with_its_targets_their_conditions_and_mappings(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explained(capsys, table, "imu_info", "--no-code") == (
        f"imu_info: SensorBoardIMUInfo, field 13 of PBEnvelope  ({table}:5:3)\n"
        "  largest encoding: 51 bytes, 53 in its envelope\n"
        "  source: sensor_board (127.0.0.30)\n"
        "\n"
        f"  destination basestation (127.0.0.10:9000): unchanged  ({table}:6:20)\n"
        "\n"
        f"  destination laptop (127.0.0.99:9999): unchanged  ({table}:6:34)\n"
        "    when is_calibrated\n"
        "    at most 5 Hz, keeping the first\n"
        "\n"
        f"  topic x: std_msgs/msg/Float32  ({table}:8:10)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    CDR: 8 bytes\n"
        "    when accel_x > 1 or accel_y > 1\n"
        "    data  float32  <-  accel_x * 2  : float32\n"
        "\n"
    )


def test_routes_of_one_case_are_told_with_their_own_places_and_auto_with_the_element(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rover = ROUTES / "rover.yaml"
    told = explained(capsys, rover, "detected_object", "--no-code")
    places = re.findall(r"^detected_object_from_ros\w*: .*:(\d+):7\)$", told, re.MULTILINE)
    written = rover.read_text(encoding="utf-8").splitlines()
    assert [written[int(line) - 1].strip() for line in places] == ["- source: ros"] * 2
    assert re.search(r"^    id +uint32 +<-  item\.id +: uint32 +auto$", told, re.MULTILINE)
    assert re.search(r"^    index +uint32 +<-  index +: uint32$", told, re.MULTILINE)


def test_a_hand_over_is_told_on_both_sides(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    says = "deadman: {timeout: 500ms, send: {arm_ctrl: {}}, to: [laptop], hands_over_to: [imu_info]}"
    with table.open("a") as more:
        more.write(f"  arm_ctrl:\n    source: basestation\n    destinations: [laptop]\n    {says}\n")
    assert (
        "  deadman: arm_ctrl to laptop when no command came for 500 ms, again every 100 ms, "
        "and once when the router starts\n"
        "    disarmed by commands of imu_info\n"
    ) in explained(capsys, table, "arm_ctrl")
    code = explained(capsys, table, "imu_info")
    assert f"({table}:6:34)\n    disarms the deadman of arm_ctrl\n" in code
    assert code.count("feed_laptop(now)") == 1
    assert "feed_basestation" not in code


def test_the_code_that_runs_is_shown(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "\ndef route_imu_info(" in explained(capsys, table, "imu_info")


def test_without_a_case_all_are_explained(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = explained(capsys, table)
    assert "imu_info: SensorBoardIMUInfo" in out
    assert "  ignored: not part of this test\n" in out


def test_an_unknown_case_is_wrong_usage(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "imu", "--table", str(table)]) == BAD_USAGE
    assert f"{table} has no route or gateway 'imu'" in capsys.readouterr().err


def test_a_bad_table_is_told_instead(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(table.read_text().replace("accel_x * 2", "accel_q"))
    assert main(["explain", "--table", str(table)]) == BAD_TABLE
    assert "error[unknown-field]" in capsys.readouterr().err


def test_a_source_is_told_with_the_listener_that_believes_it(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(table.read_text().replace("laptop:", "sensor_board: {listener: rover}, laptop:", 1))
    assert "  source: sensor_board (127.0.0.30 by listener rover)\n" in explained(
        capsys, table, "imu_info", "--no-code"
    )
