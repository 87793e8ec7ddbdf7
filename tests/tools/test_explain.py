"""`router explain --diff`: every change of a table shows once, under the name of what it belongs to."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, OK, main
from router.compiler import Checked, check_table
from router.compiler.lookup import Definitions
from router.tools.explain import diff
from tests.tables import ROUTES

ROVER = ROUTES / "rover.yaml"
SIM = ROUTES / "sim.yaml"
OLD = f"""\
version: 1
extends: {ROVER}
http: {{address: 127.0.0.1:9108}}
foxglove: {{address: 127.0.0.1:8766}}
node: {{diagnostics: false}}
"""
INBOUND = f"""\
version: 1
extends: {ROVER}
gateways:
  dashboard:
    inbound: [{{topic: a, type: std_msgs/msg/Float32, deadman: {{timeout: TIME, send: {{data: 1}}}}}}]
"""


DEFINITIONS = Definitions()


def checked(path: Path) -> Checked:
    found = check_table(path, definitions=DEFINITIONS)
    assert not found.has_errors, found.diagnostics
    return found


def told(folder: Path, more: str, old: str = OLD) -> list[str]:
    """What a table that extends another changes: `part: -line`, `part: +line`."""
    (folder / "old.yaml").write_text(old)
    new = more if more.startswith("version") else f"version: 1\nextends: {folder / 'old.yaml'}\n{more}"
    (folder / "new.yaml").write_text(new)
    found, part = [], ""
    for line in diff(checked(folder / "old.yaml"), checked(folder / "new.yaml")):
        if line.startswith("@@"):
            part = line.rpartition("@@ ")[2]
        elif line[0] in "-+":
            found.append(f"{part}: {line[0]}{line[1:].strip()}")
    return found


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("", []),
        (
            (
                "http: {address: 127.0.0.1:9999}\nreload: {on_change: true}\nnode: {diagnostics: true}\n"
                "foxglove: {address: 127.0.0.1:8767}"
            ),
            [
                "table: -node.diagnostics: false",
                "table: -reload.on_change: false",
                "table: -http.address: 127.0.0.1:9108",
                "table: -foxglove.address: 127.0.0.1:8766",
                "table: +node.diagnostics: true",
                "table: +reload.on_change: true",
                "table: +http.address: 127.0.0.1:9999",
                "table: +foxglove.address: 127.0.0.1:8767",
            ],
        ),
        (
            "listen: {rover: {receive_buffer: 1MiB, interface: lo}}",
            [
                "listener rover: -receive_buffer: 4 MiB",
                "listener rover: +receive_buffer: 1 MiB",
                "listener rover: +interface: lo",
            ],
        ),
        (
            "endpoints: {arm_board: {address: 10.0.0.9:99, listener: rover, stale_after: 2s}}",
            [
                "endpoint arm_board: -address: 192.168.0.40:8",
                "endpoint arm_board: +address: 10.0.0.9:99",
                "endpoint arm_board: -stale_after: 5 s",
                "endpoint arm_board: +stale_after: 2 s",
                "endpoint arm_board: +listener: rover",
            ],
        ),
        (
            "endpoints: {arm_board: {stale_after: never}}",
            ["endpoint arm_board: -stale_after: 5 s", "endpoint arm_board: +stale_after: never"],
        ),
        (
            "endpoints: {x: {address: 10.0.0.9:99, kind: tool}}",
            [
                "endpoint x: +address: 10.0.0.9:99",
                "endpoint x: +kind: tool",
                "endpoint x: +trim_trailing_zeros: false",
                "endpoint x: +allow_non_finite: false",
                "endpoint x: +stale_after: 5 s",
            ],
        ),
        (
            "routes: {drive_motor: {ttl: 50ms}}",
            [
                "route drive_motor: -dropped when older than 200 ms",
                "route drive_motor: +dropped when older than 50 ms",
            ],
        ),
        (
            (
                "routes: {manual_arm: {deadman: "
                "{timeout: 400ms, send: {manual_arm: {speed: 1}}, to: [arm_board], at_start: silent}}}"
            ),
            [
                (
                    "route manual_arm: -deadman: manual_arm to arm_board when no command came for 500 ms, "
                    "again every 100 ms, and once when the router starts"
                ),
                (
                    "route manual_arm: +deadman: manual_arm {speed: 1} to arm_board when no command came for 400 ms, "
                    "again every 100 ms, but not when the router starts"
                ),
            ],
        ),
        (
            'routes: {pump_info: {destinations: [{endpoint: basestation, when: "enabled or\\n\\nspeed_rpm > 1\\n"}]}}',
            ["route pump_info: +when enabled or  speed_rpm > 1"],
        ),
        (
            "routes: {pump_info: {destinations: [{endpoint: basestation, when: enabled, max_rate: 5 Hz}]}}",
            ["route pump_info: +when enabled", "route pump_info: +at most 5 Hz, keeping the first"],
        ),
        (
            "routes: {drive_progress: {destinations: [basestation]}}",
            ["route drive_progress: +destination basestation: unchanged"],
        ),
        (
            "gateways: {dashboard: {schema_period: 1s, discovery_period: 1s}}",
            [
                "gateway dashboard: -the latest value every 200 ms; looks for topics every 5 s",
                "gateway dashboard: +the latest value every 200 ms; looks for topics every 1 s",
            ],
        ),
        (
            'gateways: {dashboard: {rates: {"/imu*": 12.5 Hz}}}',
            ["gateway dashboard: +/imu*: the latest value every 80 ms"],
        ),
    ],
)
def test_what_is_changed_shows_where_it_is(tmp_path: Path, more: str, expected: list[str]) -> None:
    found = told(tmp_path, more)
    assert [line for line in found if "disarmed" not in line] == expected


def test_a_changed_mapping_shows_by_field(tmp_path: Path) -> None:
    topics = """
routes:
  pump_info:
    topics:
      - {topic: pump_info, type: comms/msg/SensorBoardPumpInfo, qos: {depth: 5}, fields: {auto: true, speed_rpm: "7"}}
"""
    qos = "qos: reliability reliable, durability volatile, history keep_last, depth {}, liveliness system_default"
    assert set(told(tmp_path, topics)) >= {
        f"route pump_info: -{qos.format(10)}",
        f"route pump_info: +{qos.format(5)}",
        "route pump_info: -speed_rpm  uint32  <-  speed_rpm  : uint32  auto",
        "route pump_info: +speed_rpm  uint32  <-  7  : int 7",
    }


def test_a_deadman_of_a_gateway_shows(tmp_path: Path) -> None:
    new = INBOUND.replace("TIME", "2s, at_start: silent").replace("data: 1", "data: 2")
    assert told(tmp_path, new, INBOUND.replace("TIME", "500ms")) == [
        (
            "gateway dashboard: -deadman: {data: 1} when no message came for 500 ms, again every 100 ms, "
            "and once when the router starts"
        ),
        (
            "gateway dashboard: +deadman: {data: 2} when no message came for 2 s, again every 100 ms, "
            "but not when the router starts"
        ),
    ]


def test_the_same_qos_in_other_words_is_no_difference(tmp_path: Path) -> None:
    topics = """
routes:
  pump_info:
    topics: [{topic: pump_info, type: comms/msg/SensorBoardPumpInfo, qos: {depth: 10}, fields: auto}]
"""
    assert told(tmp_path, topics) == []


def test_what_is_added_one_way_is_removed_the_other() -> None:
    there, back = (list(diff(*map(checked, tables))) for tables in ((ROVER, SIM), (SIM, ROVER)))
    added = sorted(line[1:] for line in there if line.startswith("+"))
    assert "  from clients /drive_motor: comms/msg/DrivingBoardMotorMessage" in added
    assert added == sorted(line[1:] for line in back if line.startswith("-"))


def test_the_verb_prints_a_unified_diff(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "--diff", str(ROVER), str(SIM)]) == OK
    said = capsys.readouterr().out
    assert said.startswith(f"--- {ROVER}\n+++ {SIM}\n@@ ")
    assert re.search(r"^@@ .* @@ listener rover\n-  address: .*\n\+  address: .*$", said, re.MULTILINE)
    assert main(["explain", "--diff", str(ROVER), str(ROVER)]) == OK
    assert capsys.readouterr().out == f"{ROVER} does what {ROVER} does\n"


def test_a_wrong_table_is_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("version: 2\n")
    assert main(["explain", "--diff", str(ROVER), str(wrong)]) == BAD_TABLE
    said = capsys.readouterr()
    assert "error[" in said.err
    assert said.out == ""
