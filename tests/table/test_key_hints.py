"""One finding for each mistake of people who know YAML, ROS or another program, and what to write instead."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.table import load_table
from tests.table.tables import GATEWAY, GOOD, load

TABLE = f"""\
{GOOD}gateways:
{GATEWAY}"""


def findings(folder: Path, *edits: tuple[str, str]) -> list[tuple[str, str]]:
    """Message and hint of what a good table has wrong after each first text was replaced by the second."""
    text = TABLE
    for written, instead in edits:
        assert written in text
        text = text.replace(written, instead, 1)
    return [(found.message, found.hint) for found in load(folder, text)[1]]


@pytest.mark.parametrize(
    ("written", "instead", "hint"),
    [
        ("source_port: 9", "source_port: '9'", "write it without quotes: 9"),
        ("version: 1", "version: '1'", "write it without quotes: 1"),
        ("{address: 192.168.0.30:8, kind: board, source_port: 9}", "192.168.0.30:8",
         "write `sensor_board: {address: 192.168.0.30:8, kind: board}`"),
        ("http: {address: 127.0.0.1:9108}", "http: 9108", "write `http: {address: IP:9108}`"),
        ("exclude: [\"/rover/camera/**\"]", "exclude: \"/**\"", "write `exclude: [/**]`"),
        ("ph_info: {ignore: nobody needs it}", "ph_info: ignore", "write `ph_info: {ignore: why}`"),
        ("ph_info: {ignore: nobody needs it}", "ph_info: {enabled: false}",
         "to disable it, write only `ignore: why`"),
        ("{address: 192.168.0.30:8, kind", "{address: 192.168.0.30, port: 8, kind",
         "write the IP address and port together: `address: 192.168.0.30:8`"),
        ("    priority: command\n", "    description: by hand\n", "write descriptions as comments: `# ...`"),
        ("deadman: {timeout: 300 ms, send: {manual_brake: {brake: true, by.who: \"'router'\"}}, ",
         "deadman: {timeout: 300 ms, manual_brake: {brake: true}, ",
         "put a payload case under 'send': `send: {manual_brake: ...}`"),
        ("deadman: {none: nothing moves because of it}", "deadman: {none: true}", "say why in words: `none: TEXT`"),
        ("[basestation, {endpoint: basestation, when: accel_x > 1, max_rate: 30 Hz}]", "{basestation: {max_rate: 5}}",
         "write a list: [{endpoint: basestation, ...}]"),
        ("[basestation, {endpoint: basestation, when: accel_x > 1, max_rate: 30 Hz}]",
         "{endpoint: basestation, ttl: 1 s}", "move it to the route"),
        ("orientation_covariance: [-1, 0, accel_y]", "orientation_covariance: [[-1, 0], [0, 1]]",
         "write one list of 4 values, row by row"),
        ("qos: {profile: sensor_data, depth: 5, deadline: 500ms}", "qos: best_effort",
         "write `qos: {reliability: best_effort}`"),
        ("qos: {profile: sensor_data, depth: 5, deadline: 500ms}", "latched: true",
         "write `qos: {durability: transient_local}`"),
        ("linear_acceleration: {x: accel_x, y: 9.81}", "linear_acceleration: {x accel_x}",
         "write `x: accel_x`, with a ':'"),
        ("accel_x, y: 9.81}", "{map: state, OK, else: 0}}", "add its value: `OK: VALUE`"),
        ("{protos: ../protos, message: PBEnvelope, oneof", "{protos:../protos, message: PBEnvelope, oneof",
         "write `protos: ../protos`, with a space after ':'"),
        ("protos: ../protos", "protos: $PROTOS", 'write "${PROTOS}"'),
        ("protos: ../protos", "protos: ~/protos", 'write "${HOME}/protos"'),
        ("127.0.0.1:9108", "$(HTTP)", 'write "${HTTP}"'),
    ],
)  # fmt: skip
def test_a_mistake_is_found_once_with_what_to_write(written: str, instead: str, hint: str, tmp_path: Path) -> None:
    assert [said for _, said in findings(tmp_path, (written, instead))] == [hint]


@pytest.mark.parametrize(
    ("written", "instead"),
    [
        ("source_port: 9", 'source_port: "${NOWHERE:-9}"'),
        ("kind: board, source_port: 9}", 'kind: board, source_port: 9, trim_trailing_zeros: "${NOWHERE:-false}"}'),
        ("{ignore: nobody needs it}", "{ignore: '${NOWHERE:-7}'}"),
    ],
)
def test_a_value_with_a_variable_has_the_type_that_its_key_takes(written: str, instead: str, tmp_path: Path) -> None:
    assert findings(tmp_path, (written, instead)) == []


def test_words_that_a_key_takes_are_named(tmp_path: Path) -> None:
    said = "'priority' must be one of 'command', 'telemetry', 'bulk', not the number 1"
    assert findings(tmp_path, ("priority: command", "priority: 1")) == [(said, "")]


@pytest.mark.parametrize(
    ("written", "instead", "empty"),
    [
        ("        fields:\n          auto: true\n", "        fields:\n        auto: true\n", "'fields'"),
        (GOOD[GOOD.index("    deadman: {timeout: 300") : GOOD.index("  detected_object:")],
         "    deadman:\n      timeout: 1s\n      send:\n        manual_brake:\n        brake: true\n",
         "'manual_brake'"),
    ],
)  # fmt: skip
def test_what_stands_beside_an_empty_key_has_no_findings_of_its_own(
    written: str, instead: str, empty: str, tmp_path: Path
) -> None:
    rest = ("          header.stamp: received_at\n          header.frame_id: \"'imu_link'\"\n"
            "          linear_acceleration: {x: accel_x, y: 9.81}\n"
            "          orientation_covariance: [-1, 0, accel_y]\n")  # fmt: skip
    [(message, hint)] = findings(tmp_path, (rest, ""), (written, instead))
    assert message.startswith(empty)
    assert hint == "indent its keys below it"


def test_a_misspelt_name_of_the_extended_table_is_named(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(TABLE)
    over = tmp_path / "over.yaml"
    over.write_text("extends: base.yaml\ngateways: {vr_headst: {publish_period: 1s}}\n")
    assert [found.hint for found in load_table(over, {})[1]] == ["did you mean 'vr_headset'?"]
