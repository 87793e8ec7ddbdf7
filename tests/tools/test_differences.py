"""Two tables compared: every change is told once, with its place, and what means the same is no difference."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, OK, main
from router.compiler import Checked, check_table
from router.tools.differences import differences
from tests.tables import ROUTES

ROVER = ROUTES / "rover.yaml"
SIM = ROUTES / "sim.yaml"
OLD = f"""\
version: 1
extends: {ROVER}
metrics: {{address: 127.0.0.1:9108}}
foxglove: {{address: 127.0.0.1:8766}}
node: {{diagnostics: false}}
"""
Told = Callable[[str], list[str]]


def checked(path: Path) -> Checked:
    found = check_table(path)
    assert not found.has_errors, found.diagnostics
    return found


@pytest.fixture
def told(tmp_path: Path) -> Told:
    """What a table that extends another does otherwise, without the places."""
    old = tmp_path / "old.yaml"
    old.write_text(OLD)

    def compare(more: str) -> list[str]:
        path = tmp_path / "new.yaml"
        path.write_text(f"version: 1\nextends: {old}\n{more}")
        found = differences(checked(old), checked(path))
        return [f"{each.subject}{each.part and ', '}{each.part}: {each.text}" for each in found]

    return compare


def test_a_table_differs_in_nothing_from_itself(told: Told) -> None:
    assert told("") == []


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("metrics: {address: 127.0.0.1:9999}", ["table: metrics.address is 127.0.0.1:9999, was 127.0.0.1:9108"]),
        ("reload: {on_change: true}", ["table: reload.on_change is true, was false"]),
        ("node: {diagnostics: true}", ["table: node.diagnostics is true, was false"]),
        ("foxglove: {address: 127.0.0.1:8767}", ["table: foxglove.address is 127.0.0.1:8767, was 127.0.0.1:8766"]),
        ("listen: {rover: {receive_buffer: 1MiB}}", ["listener rover: receive_buffer is 1 MiB, was 4 MiB"]),
        ("endpoints: {arm_board: {stale_after: 2s}}", ["endpoint arm_board: stale_after is 2 s, was 5 s"]),
        ("endpoints: {arm_board: {stale_after: never}}", ["endpoint arm_board: stale_after is never, was 5 s"]),
        ("endpoints: {arm_board: {budget: 10kB/s}}", ["endpoint arm_board: budget is 10 kB/s, was none"]),
        ("listen: {rover: {coalesce: 250us}}", ["listener rover: coalesce is 250 us, was 1 ms"]),
        ("endpoints: {x: {address: 10.0.0.9:99, kind: tool}}", ["endpoint x: added, 10.0.0.9:99"]),
        ("routes: {drive_motor: {ttl: 50ms}}", ["route drive_motor: ttl is 50 ms, was 200 ms"]),
        (
            (
                "routes: {manual_arm: {deadman: "
                "{timeout: 400ms, send: {manual_arm: {speed: 1}}, to: [arm_board], at_start: silent}}}"
            ),
            [
                "route manual_arm, deadman: timeout is 400 ms, was 500 ms",
                "route manual_arm, deadman: send is {manual_arm: {speed: 1}}, was {manual_arm: {}}",
                "route manual_arm, deadman: at_start is silent, was send",
            ],
        ),
        (
            'routes: {pump_info: {destinations: [{endpoint: basestation, when: "enabled or\\n\\nspeed_rpm > 1\\n"}]}}',
            ["route pump_info, destination basestation: when is enabled or speed_rpm > 1, was none"],
        ),
        (
            "routes: {pump_info: {destinations: [{endpoint: basestation, when: enabled, max_rate: 5 Hz}]}}",
            [
                "route pump_info, destination basestation: when is enabled, was none",
                "route pump_info, destination basestation: max_rate is 5 Hz, was none",
            ],
        ),
        (
            "routes: {drive_progress: {destinations: [basestation]}}",
            ["route drive_progress, destination basestation: added"],
        ),
        ("routes: {drive_progress: {ignore: not wanted}}", ["route drive_progress: ignore is not wanted, was none"]),
        ("gateways: {dashboard: {publish_period: 1s}}", ["gateway dashboard: publish_period is 1 s, was 200 ms"]),
        ("gateways: {dashboard: {publish_period: each}}", ["gateway dashboard: publish_period is each, was 200 ms"]),
        (
            'gateways: {dashboard: {rates: {"/imu*": 12.5 Hz}}}',
            ["gateway dashboard: rates is /imu*: 12.5 Hz, was none"],
        ),
        ("gateways: {more: {transport: {tcp: 127.0.0.1:8000}}}", ["gateway more: added, tcp"]),
        (
            "gateways: {dashboard: {inbound: [{topic: a, type: std_msgs/msg/Float32}]}}",
            ["gateway dashboard, inbound a: added, std_msgs/msg/Float32"],
        ),
    ],
)
def test_what_is_changed_is_told_once(told: Told, more: str, expected: list[str]) -> None:
    said = told(more)
    if "ignore" in more:
        expected = [
            *expected,
            "route drive_progress: source is none, was driving_board",
            "route drive_progress, topic drive_progress: removed",
        ]
    assert sorted(line for line in said if "hands_over_to" not in line and "repeat" not in line) == sorted(expected)


def test_a_changed_mapping_is_told_by_field(told: Told) -> None:
    topics = """
routes:
  pump_info:
    topics:
      - {topic: pump_info, type: comms/msg/SensorBoardPumpInfo, qos: {depth: 5}, fields: {auto: true, speed_rpm: "7"}}
"""
    assert told(topics) == [
        "route pump_info, topic pump_info: qos.depth is 5, was 10",
        "route pump_info, topic pump_info: speed_rpm is 7, was speed_rpm",
    ]


def test_a_deadman_of_a_gateway_is_told_in_the_words_of_a_table(tmp_path: Path) -> None:
    text = f"""\
version: 1
extends: {ROVER}
gateways:
  dashboard:
    inbound: [{{topic: a, type: std_msgs/msg/Float32, deadman: {{timeout: TIME, send: {{data: 1}}}}}}]
"""
    (tmp_path / "old.yaml").write_text(text.replace("TIME", "500ms"))
    (tmp_path / "new.yaml").write_text(text.replace("TIME", "2s, at_start: silent").replace("data: 1", "data: 2"))
    found = differences(checked(tmp_path / "old.yaml"), checked(tmp_path / "new.yaml"))
    assert [each.text for each in found] == [
        "deadman.timeout is 2 s, was 500 ms",
        "deadman.send is {data: 2}, was {data: 1}",
        "deadman.at_start is silent, was send",
    ]


def test_the_same_in_other_words_is_no_difference(told: Told) -> None:
    topics = """
routes:
  control_mode:
    topics: [{topic: control_mode, type: comms/msg/BasestationControlMode, qos: {depth: 10}, fields: {mode: mode}}]
"""
    assert told(topics) == []


def test_a_record_that_is_new_is_told_with_its_folder_as_a_person_writes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "routes"
    folder.mkdir()
    plain = f"version: 1\nextends: {ROUTES / 'legacy.yaml'}\n"
    (folder / "old.yaml").write_text(plain)
    (folder / "new.yaml").write_text(plain + "record: {directory: ../recordings}\n")
    (found,) = differences(checked(folder / "old.yaml"), checked(folder / "new.yaml"))
    assert (found.subject, found.text) == ("record", "added, recordings")


def test_what_is_added_one_way_is_removed_the_other() -> None:
    there, back = (differences(*tables) for tables in ((checked(ROVER), checked(SIM)), (checked(SIM), checked(ROVER))))
    added = {(each.subject, each.part) for each in there if each.text.startswith("added")}
    removed = {(each.subject, each.part) for each in back if each.text == "removed"}
    assert added == removed == {("gateway dashboard", "inbound drive_motor")}
    changed = {each.text for each in there if " is " in each.text}
    swapped = {re.sub(r"(.*) is (.*), was (.*)", r"\1 is \3, was \2", each.text) for each in back}
    assert changed <= swapped


def test_the_verb_prints_a_line_each_with_its_place(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "--diff", str(ROVER), str(SIM)]) == OK
    line = r"^listener rover: address is .*, was .*  \(.*sim\.yaml:\d+:\d+\)$"
    assert re.search(line, capsys.readouterr().out, re.MULTILINE)
    assert main(["explain", "--diff", str(ROVER), str(ROVER)]) == OK
    assert capsys.readouterr().out == f"{ROVER} does what {ROVER} does\n"


def test_a_wrong_table_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("version: 2\n")
    assert main(["explain", "--diff", str(ROVER), str(wrong)]) == BAD_TABLE
    said = capsys.readouterr()
    assert "error[" in said.err
    assert said.out == ""
