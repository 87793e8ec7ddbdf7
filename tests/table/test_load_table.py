from __future__ import annotations

import hashlib
from dataclasses import replace
from ipaddress import IPv4Network
from pathlib import Path

import pytest

from router.assets import asset
from router.errors import Code
from router.table import load_table
from router.table.addresses import Address
from router.table.keys import flat
from router.table.model import RouteTable
from router.table.model.expressions import Expression
from router.table.model.routes import Route
from tests.table.tables import GOOD, SMALL, good, load, parts, places, shown


@pytest.fixture
def table(tmp_path: Path) -> RouteTable:
    return good(tmp_path, GOOD)


def route(table: RouteTable, name: str) -> Route:
    [found] = [route for route in table.routes if route.name == name]
    return found


def test_listeners_endpoints_and_settings_are_typed(table: RouteTable) -> None:
    assert table.http
    assert table.http.address.value == Address("127.0.0.1", 9108)
    assert flat(table.node) == {"name": "rover_router", "namespace": "/"}
    assert flat(table.listeners["rover"]) == {
        "name": "rover", "address": "0.0.0.0:5000", "framing": "exact", "receive_buffer": "64 kB",
    }  # fmt: skip
    assert flat(table.endpoints["sensor_board"]) == {
        "name": "sensor_board", "address": "192.168.0.30:8", "kind": "board", "source_port": "9",
        "trim_trailing_zeros": "false", "allow_non_finite": "false", "stale_after": "5 s",
    }  # fmt: skip
    assert flat(table.endpoints["basestation"]) == {
        "name": "basestation", "address": "192.168.0.10:9000", "kind": "tool", "trim_trailing_zeros": "true",
        "allow_non_finite": "false",
        "bandwidth": "500 kB/s", "stale_after": "5 s",
    }  # fmt: skip


def test_routes_are_typed(table: RouteTable) -> None:
    assert {route.name: shown(route) for route in table.routes} == ROUTES


ROUTES = {
    "imu_info": {
        "name": "imu_info", "case": "imu_info", "source": "sensor_board", "destinations.0.endpoint": "basestation",
        "destinations.0.on_limit": "first", "destinations.1.endpoint": "basestation",
        "destinations.1.when": "accel_x > 1",
        "destinations.1.max_rate": "30 Hz", "destinations.1.on_limit": "first", "topics.0.topic": "imu_data",
        "topics.0.type": "comms/msg/ImuSensorInformation", "topics.0.queue_depth": "10", "topics.0.on_limit": "first",
        "topics.0.fields": "{auto}", "topics.1.topic": "imu/data_raw", "topics.1.type": "sensor_msgs/msg/Imu",
        "topics.1.qos.profile": "sensor_data", "topics.1.qos.depth": "5", "topics.1.qos.deadline": "500 ms",
        "topics.1.max_rate": "0.5 Hz", "topics.1.on_limit": "first",
        "topics.1.fields": "{auto, header.stamp: received_at, header.frame_id: 'imu_link', "
        "linear_acceleration.x: accel_x, linear_acceleration.y: 9.81, orientation_covariance: [-1, 0, accel_y]}",
    },
    "arm_target": {
        "name": "arm_target", "case": "arm_target", "source.0.topic": "arm_target",
        "source.0.type": "comms/msg/ArmBoardTargetMovement", "source.0.on_limit": "first", "fields": "{auto}",
        "destinations.0.endpoint": "basestation", "destinations.0.on_limit": "first",
    },
    "ph_info": {
        "name": "ph_info", "case": "ph_info", "ignore": "nobody needs it",
    },
    "manual_drive": {
        "name": "manual_drive", "case": "manual_drive", "source": "basestation",
        "destinations.0.endpoint": "sensor_board", "destinations.0.max_rate": "20 Hz",
        "destinations.0.on_limit": "latest",
        "priority": "command", "ttl": "200 ms", "deadman.timeout": "300 ms", "deadman.repeat": "100 ms",
        "deadman.at_start": "send", "deadman.send": "manual_brake {brake: true, by.who: 'router'}",
        "deadman.to": "sensor_board, basestation",
        "deadman.disarmed_by": "arm_target",
    },
    "detected_object_from_ros": {
        "name": "detected_object_from_ros", "case": "detected_object", "for_each": "detections",
        "source.0.topic": "detected_objects", "source.0.type": "comms/msg/DetectedObjectArray",
        "source.0.on_limit": "first", "fields": "{auto, total_count: count}", "destinations.0.endpoint": "basestation",
        "destinations.0.on_limit": "first", "no_deadman": "nothing moves because of it",
    },
    "detected_object_from_basestation": {
        "name": "detected_object_from_basestation", "case": "detected_object", "source": "basestation, sensor_board",
        "collect.by": "frame_id", "collect.count": "total_count", "collect.order": "index", "collect.timeout": "1 s",
        "topics.0.topic": "objects", "topics.0.type": "comms/msg/DetectedObjectArray", "topics.0.on_limit": "first",
        "topics.0.fields": "{detections: items}",
    },
    "detected_object_from_ros_2": {
        "name": "detected_object_from_ros_2", "case": "detected_object", "source.0.topic": "it",
        "source.0.type": "comms/msg/DetectedObject", "source.0.on_limit": "first", "fields": "{auto}",
        "destinations.0.endpoint": "basestation", "destinations.0.on_limit": "first",
    },
}  # fmt: skip


def test_a_payload_of_defaults_and_a_repeat_of_its_own_are_taken(tmp_path: Path) -> None:
    text = GOOD.replace("{brake: true, by.who: \"'router'\"}", "{}")
    text = text.replace("300 ms, send", "300 ms, repeat: 20ms, send").replace(",\n      disarmed_by: [arm_target]", "")
    deadman = route(good(tmp_path, text), "manual_drive").deadman
    assert deadman
    assert (deadman.repeat.value, [*map(str, deadman.payloads)]) == (20_000_000, ["manual_brake"])
    assert deadman.disarmed_by is None


def test_names_of_routes_differ_whatever_cases_are_called(tmp_path: Path) -> None:
    text = GOOD + "  detected_object_from_ros: {source: any, destinations: [basestation]}\n  imu: [{source: any}]\n"
    assert [route.name for route in good(tmp_path, text).routes][-5:] == [
        "detected_object_from_ros_2", "detected_object_from_basestation", "detected_object_from_ros_3",
        "detected_object_from_ros", "imu",
    ]  # fmt: skip


def test_fields_are_flattened_to_paths_with_a_place_for_each_part(table: RouteTable) -> None:
    fields = table.routes[0].topics[1].fields
    assert fields
    assert fields.auto
    by_path = {entry.path: entry for entry in fields.entries}
    assert list(by_path) == [
        ("header", "stamp"),
        ("header", "frame_id"),
        ("linear_acceleration", "x"),
        ("linear_acceleration", "y"),
        ("orientation_covariance",),
    ]
    line = GOOD.splitlines()[by_path["header", "stamp"].path_spans[1].line - 1]
    for path, entry in list(by_path.items())[:2]:
        line = GOOD.splitlines()[entry.path_spans[0].line - 1]
        assert [line[span.column - 1 : span.end_column - 1] for span in entry.path_spans] == list(path)


def test_protos_are_the_routers_own_unless_the_table_has_some(tmp_path: Path) -> None:
    text = GOOD.replace("protos: ../protos, ", "")
    envelope = good(tmp_path, text).envelopes[""]
    assert envelope.protos.value == asset("protos")


def test_protos_are_relative_to_the_file_that_says_so(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "base.yaml").write_text(GOOD)
    envelope = good(tmp_path, "extends: base/base.yaml\n").envelopes[""]
    assert envelope.protos.value.resolve() == tmp_path / "protos"


def test_the_hash_is_over_all_files_in_order(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(GOOD)
    table = good(tmp_path, "extends: base.yaml\n")
    assert [path.name for path in table.files] == ["table.yaml", "base.yaml"]
    assert table.sha256 == hashlib.sha256(b"extends: base.yaml\n" + GOOD.encode()).hexdigest()


def test_what_is_left_out_has_defaults(tmp_path: Path) -> None:
    table = good(tmp_path, f"{SMALL}endpoints: {{arm: {{address: 10.0.0.1:8, kind: board}}}}\n")
    assert (flat(table.node), table.http) == ({"name": "rover_router", "namespace": "/"}, None)
    assert flat(table.listeners["rover"]) == {
        "name": "rover", "address": "0.0.0.0:5000", "framing": "zero_trimmed", "receive_buffer": "4 MiB",
    }  # fmt: skip
    assert (table.record, table.foxglove, table.reload_on_change, table.node.diagnostics) == (None, None, False, None)
    assert table.endpoints["arm"].stale_after == 5 * 10**9


def test_a_recording_needs_a_directory_alone(tmp_path: Path) -> None:
    record = good(tmp_path, SMALL + "record: {directory: ../recordings}\n").record
    assert record
    assert record.directory.resolve() == tmp_path.parent.resolve() / "recordings"
    assert flat(replace(record, directory=Path("there"))) == {
        "directory": "there", "continuous": "true", "rotate_after.size": "256 MiB",
        "rotate_after.age": "10 min", "retention": "4 GiB",
    }  # fmt: skip


def test_what_is_said_beside_routing_is_typed(tmp_path: Path) -> None:
    table = good(
        tmp_path,
        SMALL + "node: {diagnostics: true}\nfoxglove: {address: 127.0.0.1:8766, from: [10.0.0.0/8]}\n"
        "reload: {on_change: true}\n"
        "endpoints:\n"
        "  arm: {address: 10.0.0.1:8, kind: board, stale_after: 500ms}\n"
        "  tool: {address: 10.0.0.2:8, kind: tool, stale_after: never}\n"
        "record: {directory: /data, continuous: false, last: 60s, retention: 20GiB,\n"
        "  rotate_after: {size: 1.5GB, age: 1h}}\n",
    )
    assert table.node.diagnostics
    assert table.node.diagnostics.line == 5
    assert table.foxglove
    assert table.foxglove.address.value == Address("127.0.0.1", 8766)
    assert table.foxglove.networks == (IPv4Network("10.0.0.0/8"),)
    assert table.reload_on_change
    assert [table.endpoints[name].stale_after for name in ("arm", "tool")] == [500_000_000, None]
    assert table.record
    assert flat(table.record) == {
        "directory": "/data", "continuous": "false", "last": "1 min",
        "rotate_after.size": "1500 MB", "rotate_after.age": "1 h",
        "retention": "20 GiB",
    }  # fmt: skip


def test_what_has_a_finding_is_left_out_and_named(tmp_path: Path) -> None:
    text = GOOD.replace("192.168.0.30:8", "192.168.0.30").replace("queue_depth: 10", "queue_depth: ten")
    table, findings = parts(tmp_path, text)
    assert places(findings) == [(Code.BAD_ADDRESS, 8, 27), (Code.WRONG_TYPE, 17, 22)]
    assert table.broken == {"endpoints/sensor_board", "routes/imu_info"}
    assert list(table.endpoints) == ["basestation"]
    [imu_info] = [route for route in table.routes if route.case.value == "imu_info"]
    assert imu_info.topics[0].queue_depth is None
    assert imu_info.topics[0].fields  # the rest of the route is checked in the same run


def test_a_route_without_a_valid_source_is_left_out(tmp_path: Path) -> None:
    table, [finding] = parts(tmp_path, GOOD.replace("source: sensor_board", "source: 5"))
    assert finding.code is Code.WRONG_TYPE
    assert "imu_info" not in [route.case.value for route in table.routes]


def test_a_misspelt_key_is_one_finding_and_read_as_what_was_meant(tmp_path: Path) -> None:
    text = GOOD.replace("destinations: [basestation, ", "destinatons: [5, ").replace("listen:", "lisen:")
    table, findings = parts(tmp_path, text)
    assert places(findings) == [(Code.UNKNOWN_KEY, 5, 1), (Code.UNKNOWN_KEY, 13, 5), (Code.WRONG_TYPE, 13, 19)]
    assert list(table.listeners) == ["rover"]


@pytest.mark.parametrize("key", ["envelope", "routes"])
def test_there_is_no_table_without_an_envelope_or_routes(tmp_path: Path, key: str) -> None:
    table, findings = load(tmp_path, "".join(GOOD.partition(f"{key}:")[0]) + f"{key}: 5\n")
    assert table is None
    assert Code.WRONG_TYPE in [finding.code for finding in findings]


def test_the_environment_is_the_process_environment_unless_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BASESTATION", "10.0.0.9:1")
    path = tmp_path / "table.yaml"
    path.write_text(GOOD)
    table, _ = load_table(path)
    assert table
    assert table.endpoints["basestation"].address.value == Address("10.0.0.9", 1)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [("300 ms, send", "0s, send"), ("manual_brake: {", "manual_brake: 5, x: {"), ("to: [sensor_board, ", "to: [5, ")],
)
def test_of_a_route_with_a_broken_deadman_the_rest_is_left(tmp_path: Path, right: str, wrong: str) -> None:
    table, _ = parts(tmp_path, GOOD.replace(right, wrong))
    drive = route(table, "manual_drive")
    assert (drive.deadman, drive.no_deadman, len(drive.destinations)) == (None, None, 1)
    assert table.broken == {"routes/manual_drive"}  # which tells it from one that has none


def test_of_several_routes_the_valid_ones_and_the_valid_parts_are_left(tmp_path: Path) -> None:
    text = GOOD.replace("[basestation, sensor_board]", "[5]").replace(
        "[basestation]\n      deadman", "5\n      deadman"
    )
    table, findings = parts(tmp_path, text)
    assert len(findings) == 2
    assert table.broken == {"routes/detected_object"}
    routes = [route for route in table.routes if route.case.value == "detected_object"]
    assert [(len(route.all_topics), len(route.destinations)) for route in routes] == [(1, 0), (1, 1)]


def test_expressions_are_left_out_with_what_gives_them_their_names(tmp_path: Path) -> None:
    text = GOOD.replace("order: index, ", "").replace("for_each: detections", "for_each: 5")
    table, findings = parts(tmp_path, text)
    assert len(findings) == 2
    assert [topic.topic.value for topic in route(table, "detected_object_from_ros").source_topics] == ["it"]
    together = route(table, "detected_object_from_basestation")
    assert (together.collect, together.topics) == (None, ())


@pytest.mark.parametrize(
    "defaults",
    ["deadman: {timeout: 1s, send: {}}", "deadman: 500ms", "timeout: 1s", "deadman: {timeout: 5}", "deadman: {}, a: 1"],
)
def test_deadmen_do_not_miss_what_a_mistake_in_their_defaults_has_lost(defaults: str, tmp_path: Path) -> None:
    text = GOOD.replace("timeout: 300 ms, ", "").replace("version: 1\n", f"version: 1\ndefaults: {{{defaults}}}\n")
    _, findings = parts(tmp_path, text)
    assert [each.code is Code.MISSING_KEY for each in findings] == [False]


@pytest.mark.parametrize("reason", ["true", ""])
def test_a_deadman_without_its_reason_lacks_no_timeout(reason: str, tmp_path: Path) -> None:
    _, findings = parts(tmp_path, GOOD.replace("{none: nothing moves because of it}", f"{{none: {reason}}}"))
    assert [each.code for each in findings] == [Code.WRONG_TYPE]


def test_values_of_a_key_that_is_ambiguous_are_not_checked(tmp_path: Path) -> None:
    table, findings = parts(tmp_path, GOOD.replace("{x: accel_x,", "{x: {map: is_ok, yes: 1, else: 0},"))
    assert [each.code for each in findings] == [Code.AMBIGUOUS_SCALAR]
    fields = table.routes[0].topics[1].fields
    assert fields
    assert not any(isinstance(entry.value, Expression) and entry.value.choices for entry in fields.entries)
