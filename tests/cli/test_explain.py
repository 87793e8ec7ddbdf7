"""`router explain` prints everything that decides what becomes of a message."""

from __future__ import annotations

import re
from contextlib import closing
from itertools import permutations
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
    ttl: 1s
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
    assert explained(capsys, table, "imu_info") == (
        f"imu_info: SensorBoardIMUInfo, field 13 of PBEnvelope  ({table}:5:3)\n"
        "  largest encoding: 51 bytes, 53 in its envelope\n"
        "  source: sensor_board (127.0.0.30)\n"
        "\n"
        f"  destination basestation (127.0.0.10:9000): unchanged  ({table}:7:20)\n"
        "    dropped when older than 1 s\n"
        "\n"
        f"  destination laptop (127.0.0.99:9999): unchanged  ({table}:7:34)\n"
        "    when is_calibrated\n"
        "    dropped when older than 1 s\n"
        "    at most 5 Hz, keeping the first\n"
        "\n"
        f"  topic x: std_msgs/msg/Float32  ({table}:9:10)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    only while a node subscribes\n"
        "    when accel_x > 1 or accel_y > 1\n"
        "    dropped when older than 1 s\n"
        "    data  float32  <-  accel_x * 2  : float32\n"
        "    CDR: 8 bytes\n"
        "\n"
    )


PROTO = """\
syntax = "proto3";
message Reading { float value = 1; uint32 part = 2; }
message Order { string name = 1; repeated float samples = 2; bytes key = 3; repeated string words = 4; int32 n = 5; }
message PBEnvelope {
  oneof payload { Reading frame = 1; Reading newest = 2; Reading sharing = 3; Order order = 4; Reading plain = 5; }
}
"""
OPTIONS = """\
Order.name max_size:16
Order.samples max_count:4 fixed_count:true
Order.key max_size:6 fixed_length:true
Order.words max_count:1 max_size:2
"""
OWN = """\
version: 1
envelope: {protos: ., message: PBEnvelope, oneof: payload}
listen: {here: {address: "127.0.0.1:25000"}}
endpoints:
  board: {address: "127.0.0.2:8", kind: board}
  radio: {address: "127.0.0.3:8", kind: basestation, bandwidth: 8 kB/s, trim_trailing_zeros: true}
routes:
  frame:
    source: board
    collect: {by: part, count: 2, order: part, timeout: 50ms}
    topics: [{topic: e, type: std_msgs/msg/Float32, fields: {data: "items[0].value"}}]
  newest:
    source: board
    destinations: [radio]
    topics: [{topic: d, type: std_msgs/msg/Float32, max_rate: 5 Hz, on_limit: latest, fields: {data: value}}]
  sharing:
    source: board
    topics: [{topic: d, type: std_msgs/msg/Float32, fields: {data: value}}]
  order: {source: radio, destinations: [board], deadman: {none: it moves nothing}}
  plain: {source: any, topics: [{topic: p, type: std_msgs/msg/Float32, fields: {data: value}}]}
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table in the working directory with messages of its own."""
    (tmp_path / "own.proto").write_text(PROTO)
    (tmp_path / "own.options").write_text(OPTIONS)
    monkeypatch.chdir(tmp_path)
    path = Path("table.yaml")
    path.write_text(OWN)
    return path


def test_what_a_message_waits_for_is_told_behind_its_fields(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = explained(capsys, own, "newest")
    assert (
        "  destination radio (127.0.0.3:8): unchanged, trailing zeros trimmed  (table.yaml:14:20)\n"
        "    telemetry within a bandwidth of 8000 bytes/s\n"
    ) in told
    assert (
        "    data  float32  <-  value  : float32\n"
        "    CDR: 8 bytes\n"
        "    at most 5 Hz, keeping the latest\n"
    ) in told  # fmt: skip


def test_what_is_checked_for_a_board_is_told(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bounds = (
        "name of up to 15 bytes, samples of 4 elements or none, key of 6 bytes or none, "
        "words of up to 1 element, each of up to 1 byte"
    )
    told = explained(capsys, own, "order")
    assert f"\n    checked for the board: at most 62 bytes, no NaN or infinity, {bounds}\n" in told
    own.write_text(OWN.replace("kind: board}", "kind: board, allow_non_finite: true}"))
    assert f"bytes, NaN and infinity allowed, {bounds}\n" in explained(capsys, own, "order")


def test_routes_of_one_case_are_told_with_their_own_places_and_auto_with_the_element(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rover = ROUTES / "rover.yaml"
    told = explained(capsys, rover, "detected_object")
    places = re.findall(r"^detected_object_from_ros\w*: .*:(\d+):7\)$", told, re.MULTILINE)
    written = rover.read_text(encoding="utf-8").splitlines()
    assert [written[int(line) - 1].strip()[:16] for line in places] == ["- source: {topic"] * 2
    assert re.search(r"^    id +uint32 +<-  item\.id +: uint32 +auto$", told, re.MULTILINE)
    assert re.search(r"^    index +uint32 +<-  index +: uint32$", told, re.MULTILINE)


def test_a_hand_over_is_told_on_both_sides(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    says = "deadman: {timeout: 500ms, send: {arm_ctrl: {}}, to: [laptop], disarmed_by: [imu_info]}"
    with table.open("a") as more:
        more.write(f"  arm_ctrl:\n    source: basestation\n    destinations: [laptop]\n    {says}\n")
    assert (
        "  deadman: arm_ctrl to laptop when no command came for 500 ms, again every 100 ms, "
        "and once when the router starts\n"
        "    disarmed by commands of imu_info\n"
    ) in (told := explained(capsys, table, "arm_ctrl"))
    assert f"  destination laptop (127.0.0.99:9999): unchanged  ({table}:12:20)\n    feeds the deadman\n" in told
    code = explained(capsys, table, "imu_info")
    assert "    at most 5 Hz, keeping the first\n    disarms the deadman of arm_ctrl\n" in code


def test_without_a_case_all_are_explained_and_with_code_also_what_runs(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = explained(capsys, table, "--code")
    assert "imu_info: SensorBoardIMUInfo" in out
    assert "\n  topic x\n    # when  (" in out
    assert "\ndef " not in out
    assert "  ignored: not part of this test\n" in out


def test_an_unknown_name_and_a_bad_table_are_told_instead(
    table: Path, gateways: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explain", "imu", "--table", str(table)]) == BAD_USAGE
    assert f"router explain: {table} has no route or gateway 'imu'" in capsys.readouterr().err
    assert main(["explain", "vr_handset", "--table", str(gateways)]) == BAD_USAGE
    assert "did you mean 'vr_headset'?" in capsys.readouterr().err
    table.write_text(table.read_text().replace("accel_x * 2", "accel_q"))
    assert main(["explain", "--table", str(table)]) == BAD_TABLE
    assert "error[unknown-field]" in capsys.readouterr().err


def test_a_source_is_told_with_the_listener_that_believes_it(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(table.read_text().replace("laptop:", "sensor_board: {listener: rover}, laptop:", 1))
    assert "  source: sensor_board (127.0.0.30 by listener rover)\n" in explained(capsys, table, "imu_info")


GATEWAYS = """\
extends: {base}
gateways:
  vr_headset:
    transport: {{udp: 127.0.0.9:8502}}
    receive: 127.0.0.1:8500
    format: gateway_v2
    topics: {{include: [/*_data, {{regex: "/imu.*"}}], exclude: [/x_data]}}
    compression: {{zstd: 3}}
    rates: {{/tf: each, "/imu*": 50 Hz}}
    inbound:
      - topic: cmd_vel
        type: geometry_msgs/msg/Twist
        ttl: 300ms
        max_rate: 20 Hz
        deadman: {{timeout: 500ms, send: {{linear.x: 0.0}}}}
      - {{topic: /stop, type: std_msgs/msg/Empty, deadman: {{timeout: 1s, send: {{}}, at_start: silent}}}}
  dashboard: {{transport: {{websocket: 127.0.0.1:8765}}, publish_period: each}}
  net: {{transport: {{zenoh: {{key: a/b, connect: [tcp/127.0.0.1:7447]}}}}, topics: {{include: [/greeting]}}}}
"""


UNQUOTED = f"""\
extends: {BASE}
gateways:
  far:
    transport:
      zenoh:
        key: rovers/one
        config:
          transport:
            auth:
              usrpwd:
                user: me
                password: ${{ZENOH_PASSWORD}}
"""


@pytest.fixture
def gateways(tmp_path: Path) -> Path:
    path = tmp_path / "gateways.yaml"
    path.write_text(GATEWAYS.format(base=BASE))
    return path


def test_a_gateway_is_told_with_its_patterns_what_they_match_and_what_it_lets_in(
    gateways: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explained(capsys, gateways, "vr_headset") == (
        f"vr_headset: gateway, udp to 127.0.0.9:8502 on 127.0.0.1:8500, gateway_v2  ({gateways}:3:3)\n"
        "  the latest value every 500 ms; schemas again every 5 s, looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes, compressed with zstd 3, in datagrams of up to 1400 bytes\n"
        "  sends /*_data, regex /imu.*, but not /x_data\n"
        "    /tf: every message\n"
        "    /imu*: the latest value every 20 ms\n"
        "  ~ /imu_data  comms/msg/ImuSensorInformation  the latest value every 20 ms  by /*_data, rate of /imu*\n"
        "\n"
        f"  from clients /cmd_vel: geometry_msgs/msg/Twist  ({gateways}:11:9)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    dropped when older than 300 ms\n"
        "    at most 20 Hz\n"
        "    deadman: {linear.x: 0.0} when no message came for 500 ms, again every 100 ms, "
        "and once when the router starts\n"
        "\n"
        f"  from clients /stop: std_msgs/msg/Empty  ({gateways}:16:10)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    deadman: all fields at their defaults when no message came for 1 s, again every 100 ms, "
        "but not when the router starts\n"
        "\n"
    )


def test_without_patterns_all_topics_of_the_table_are_matched_also_those_of_other_gateways(
    gateways: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explained(capsys, gateways, "dashboard") == (
        "dashboard: gateway, websocket on 127.0.0.1:8765, 1024 clients at most, 16 from one host, json"
        f"  ({gateways}:17:3)\n"
        "  every message; looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes\n"
        "  sends every topic that is not hidden\n"
        "  ~ /cmd_vel   geometry_msgs/msg/Twist         every message  by /**\n"
        "  ~ /imu_data  comms/msg/ImuSensorInformation  every message  by /**\n"
        "  ~ /stop      std_msgs/msg/Empty              every message  by /**\n"
        "\n"
    )


def test_a_gateway_may_match_nothing(gateways: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert explained(capsys, gateways, "net") == (
        f"net: gateway, zenoh peer under a/b, connects to tcp/127.0.0.1:7447, gateway_v1  ({gateways}:18:3)\n"
        "  the latest value every 500 ms; schemas again every 5 s, looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes\n"
        "  sends /greeting\n"
        "\n"
    )


def test_what_zenoh_is_configured_with_is_told_without_its_values(
    gateways: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = "fjord-4711"  # noqa: S105 - of nobody
    monkeypatch.setenv("ZENOH_PASSWORD", secret)
    here = 'config: {transport: {auth: {usrpwd: {user: me, password: "${ZENOH_PASSWORD}"}}}, id: "12"}'
    (tmp_path / "zenoh.json5").write_text(f'{{transport: {{auth: {{usrpwd: {{user: "me", password: "{secret}"}}}}}}}}')
    before = gateways.read_text()
    tables = []
    for name, config in (("plain", ""), ("mapping", here), ("file", "config: zenoh.json5")):
        tables.append(tmp_path / f"{name}.yaml")
        tables[-1].write_text(before.replace("key: a/b", f"key: a/b, {config}" if config else "key: a/b"))
    _, mapping, file = tables
    assert explained(capsys, mapping, "net").startswith(
        "net: gateway, zenoh peer under a/b, connects to tcp/127.0.0.1:7447, configures transport and id, gateway_v1  ("
    )
    assert f", configured by {tmp_path / 'zenoh.json5'}, gateway_v1  (" in explained(capsys, file, "net")
    for one, other in permutations(tables, 2):
        assert main(["explain", "--diff", str(one), str(other)]) == OK
        told = capsys.readouterr().out
        assert "zenoh.config" in told
        assert secret not in told


def test_a_variable_that_is_no_text_is_told_by_its_name(
    gateways: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gateways.write_text(UNQUOTED)
    for password, hint in (("20261122", "put the value in quotes"), ("0471", "quote it"), ("yes", "quote it")):
        monkeypatch.setenv("ZENOH_PASSWORD", password)
        assert main(["validate", str(gateways)]) == BAD_TABLE
        told = capsys.readouterr().out
        assert hint in told
        assert password not in told


def test_without_a_name_routes_and_gateways_are_told(gateways: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = explained(capsys, gateways)
    assert told.index("imu_info: ") < told.index("vr_headset: gateway") < told.index("dashboard: gateway")


def test_of_an_ignored_gateway_the_reason_is_told(
    gateways: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    over = tmp_path / "over.yaml"
    over.write_text(f"extends: {gateways}\ngateways:\n  dashboard: {{ignore: no page on this rover}}\n")
    told = f"dashboard: gateway  ({over}:3:3)\n  ignored: no page on this rover\n\n"
    assert explained(capsys, over, "dashboard") == told
    assert told in explained(capsys, over)


def test_live_shows_topics_of_the_network_with_who_publishes_them(
    gateways: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Publisher

    with closing(Publisher("greeting", "std_msgs/msg/String")):
        while "~" not in (told := explained(capsys, gateways, "net", "--live", "--for", "500ms")):
            pass
    assert "  ~ /greeting  std_msgs/msg/String of 1  the latest value every 500 ms  by /greeting\n" in told
    assert "/imu_data  comms/msg/ImuSensorInformation, no publisher  " in explained(
        capsys, gateways, "vr_headset", "--live", "--for", "100ms"
    )
