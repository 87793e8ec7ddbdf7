"""What `router explain` says of gateways."""

from __future__ import annotations

from contextlib import closing
from itertools import permutations
from pathlib import Path

import pytest

from router.cli import BAD_TABLE, BAD_USAGE, OK, main

BASE = Path(__file__).parents[1] / "bad_tables" / "base" / "base.yaml"
TABLE = """\
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
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.yaml"
    path.write_text(TABLE.format(base=BASE))
    return path


def explained(capsys: pytest.CaptureFixture[str], table: Path, *words: str) -> str:
    assert main(["explain", *words, "--table", str(table)]) == OK
    return capsys.readouterr().out


def test_a_gateway_is_told_with_its_patterns_what_they_match_and_what_it_lets_in(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explained(capsys, table, "vr_headset") == (
        f"vr_headset: gateway, udp to 127.0.0.9:8502 on 127.0.0.1:8500, gateway_v2  ({table}:3:3)\n"
        "  the latest value every 500 ms; schemas again every 5 s, looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes, compressed with zstd 3, in datagrams of up to 1400 bytes\n"
        "  sends /*_data, regex /imu.*, but not /x_data\n"
        "    /tf: every message\n"
        "    /imu*: the latest value every 20 ms\n"
        "  ~ /imu_data  comms/msg/ImuSensorInformation  the latest value every 20 ms  by /*_data, rate of /imu*\n"
        "\n"
        f"  from clients /cmd_vel: geometry_msgs/msg/Twist  ({table}:11:9)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    dropped when older than 300 ms\n"
        "    at most 20 Hz\n"
        "    deadman: linear.x 0.0 when no message came for 500 ms, again every 100 ms, "
        "and once when the router starts\n"
        "\n"
        f"  from clients /stop: std_msgs/msg/Empty  ({table}:16:10)\n"
        "    qos: reliability reliable, durability volatile, history keep_last, depth 10, liveliness system_default\n"
        "    deadman: all fields at their defaults when no message came for 1 s, again every 100 ms, "
        "but not when the router starts\n"
        "\n"
    )


def test_without_patterns_all_topics_of_the_table_are_matched_also_those_of_other_gateways(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert explained(capsys, table, "dashboard") == (
        "dashboard: gateway, websocket on 127.0.0.1:8765, 1024 clients at most, 16 from one host, json"
        f"  ({table}:17:3)\n"
        "  every message; looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes\n"
        "  sends every topic that is not hidden\n"
        "  ~ /cmd_vel   geometry_msgs/msg/Twist         every message  by /**\n"
        "  ~ /imu_data  comms/msg/ImuSensorInformation  every message  by /**\n"
        "  ~ /stop      std_msgs/msg/Empty              every message  by /**\n"
        "\n"
    )


def test_a_gateway_may_match_nothing(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert explained(capsys, table, "net") == (
        f"net: gateway, zenoh peer under a/b, connects to tcp/127.0.0.1:7447, gateway_v1  ({table}:18:3)\n"
        "  the latest value every 500 ms; schemas again every 5 s, looks for topics every 5 s\n"
        "  messages of up to 16777216 bytes\n"
        "  sends /greeting\n"
        "\n"
    )


def test_what_zenoh_is_configured_with_is_told_without_its_values(
    table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = "fjord-4711"  # noqa: S105 - of nobody
    monkeypatch.setenv("ZENOH_PASSWORD", secret)
    here = 'config: {transport: {auth: {usrpwd: {user: me, password: "${ZENOH_PASSWORD}"}}}, id: "12"}'
    (tmp_path / "zenoh.json5").write_text(f'{{transport: {{auth: {{usrpwd: {{user: "me", password: "{secret}"}}}}}}}}')
    before = table.read_text()
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
    table: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table.write_text(UNQUOTED)
    for password, hint in (("20261122", "put the value in quotes"), ("0471", "quote it"), ("yes", "quote it")):
        monkeypatch.setenv("ZENOH_PASSWORD", password)
        assert main(["validate", str(table)]) == BAD_TABLE
        told = capsys.readouterr().out
        assert hint in told
        assert password not in told


def test_without_a_name_routes_and_gateways_are_told(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = explained(capsys, table, "--no-code")
    assert told.index("imu_info: ") < told.index("vr_headset: gateway") < told.index("dashboard: gateway")


def test_of_an_ignored_gateway_the_reason_is_told(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    over = tmp_path / "over.yaml"
    over.write_text(f"extends: {table}\ngateways:\n  dashboard: {{ignore: no page on this rover}}\n")
    told = f"dashboard: gateway  ({over}:3:3)\n  ignored: no page on this rover\n\n"
    assert explained(capsys, over, "dashboard") == told
    assert told in explained(capsys, over, "--no-code")


def test_an_unknown_gateway_is_wrong_usage(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "vr_handset", "--table", str(table)]) == BAD_USAGE
    assert "did you mean 'vr_headset'?" in capsys.readouterr().err


def test_a_bad_gateway_is_told_instead(table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(table.read_text().replace("/*_data", "data"))
    assert main(["explain", "--table", str(table)]) == BAD_TABLE
    assert "error[bad-value]: 'data' does not begin with '/'" in capsys.readouterr().err


def test_live_shows_topics_of_the_network_with_who_publishes_them(
    table: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.ros_publisher import Publisher

    with closing(Publisher("greeting", "std_msgs/msg/String")):
        while "~" not in (told := explained(capsys, table, "net", "--live", "0.5")):
            pass
    assert "  ~ /greeting  std_msgs/msg/String of 1  the latest value every 500 ms  by /greeting\n" in told
    assert "/imu_data  comms/msg/ImuSensorInformation, no publisher  " in explained(
        capsys, table, "vr_headset", "--live", "0.1"
    )
