from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from router.assets import asset
from router.errors import Code
from router.table import load_table
from router.table.addresses import Address
from router.table.model import EndpointKind, Framing, Keep, Priority, Route, RouteTable
from tests.table.tables import GOOD, load, places


@pytest.fixture
def table(tmp_path: Path) -> RouteTable:
    table, findings = load(tmp_path, GOOD)
    assert findings == []
    assert table
    return table


def route(table: RouteTable, name: str) -> Route:
    [found] = [route for route in table.routes if route.name == name]
    return found


def test_listeners_endpoints_and_settings_are_typed(table: RouteTable) -> None:
    assert table.metrics
    assert table.metrics.value == Address("127.0.0.1", 9108)
    listener = table.listeners["rover"]
    assert (listener.address.value, listener.framing, listener.receive_buffer) == (
        Address("0.0.0.0", 5000),
        Framing.EXACT,
        64_000,
    )
    board, basestation = table.endpoints.values()
    assert (board.kind, board.source_port and board.source_port.value) == (EndpointKind.BOARD, 9)
    assert (basestation.address.value.port, basestation.trim_trailing_zeros) == (9000, True)
    assert (board.budget, basestation.budget) == (None, 500_000)


def test_routes_are_typed(table: RouteTable) -> None:
    imu, arm, ph, *_ = table.routes
    assert [source.value for source in imu.sources] == ["sensor_board"]
    assert [destination.endpoint.value for destination in imu.destinations] == ["basestation", "basestation"]
    conditional = imu.destinations[1]
    assert conditional.when
    assert conditional.when.text == "accel_x > 1"
    assert conditional.max_rate == 30.0
    qos = imu.topics[1].qos
    assert qos
    assert qos.deadline
    assert qos.deadline.value == 500_000_000
    assert arm.is_outbound
    assert arm.fields
    assert arm.fields.auto
    assert ph.ignore == "nobody needs it"


def test_what_a_route_says_of_time_and_order_is_typed(table: RouteTable) -> None:
    drive = route(table, "manual_drive")
    [destination] = drive.destinations
    assert destination.keep is Keep.LATEST
    assert drive.priority is Priority.COMMAND
    assert drive.ttl
    assert drive.ttl.value == 200_000_000


def test_a_deadman_is_typed(table: RouteTable) -> None:
    deadman = route(table, "manual_drive").deadman
    assert deadman
    assert (deadman.timeout.value, deadman.repeat.value, deadman.case.value) == (
        300_000_000,
        100_000_000,
        "manual_brake",
    )
    assert [name.value for name in deadman.to] == ["sensor_board", "basestation"]
    assert [case.value for case in deadman.hands_over_to] == ["arm_target"]
    assert not deadman.fields.auto
    fields = {entry.path: entry.value.text for entry in deadman.fields.entries}
    assert fields == {("brake",): "true", ("by", "who"): "'router'"}


def test_a_payload_of_defaults_and_a_repeat_of_its_own_are_taken(tmp_path: Path) -> None:
    text = GOOD.replace("{brake: true, by.who: \"'router'\"}", "{}").replace(
        "300 ms, send", "300 ms, repeat: 20ms, send"
    )
    text = text.replace(",\n      hands_over_to: [arm_target]", "")
    table, findings = load(tmp_path, text)
    assert not findings
    assert table
    deadman = route(table, "manual_drive").deadman
    assert deadman
    assert (deadman.repeat.value, deadman.fields.entries, deadman.hands_over_to) == (20_000_000, (), ())


def test_a_case_may_have_several_routes_each_with_a_name(table: RouteTable) -> None:
    routes = [route for route in table.routes if route.case.value == "detected_object"]
    assert [route.name for route in routes] == [
        "detected_object_from_ros", "detected_object_from_basestation", "detected_object_from_ros_2",
    ]  # fmt: skip
    each, together, _ = routes
    assert each.for_each
    assert each.for_each.text == "detections"
    assert each.deadman is None
    assert each.no_deadman == "nothing moves because of it"
    assert together.collect
    collect = together.collect
    assert (collect.by.text, collect.count.text, collect.order.text) == ("frame_id", "total_count", "index")
    assert collect.timeout.value == 1_000_000_000


def test_names_of_routes_differ_whatever_cases_are_called(tmp_path: Path) -> None:
    text = GOOD + "  detected_object_from_ros: {source: any, destinations: [basestation]}\n  imu: [{source: any}]\n"
    table, findings = load(tmp_path, text)
    assert not findings
    assert table
    assert [route.name for route in table.routes][-5:] == [
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


def test_a_list_of_expressions_keeps_its_items(table: RouteTable) -> None:
    fields = table.routes[0].topics[1].fields
    assert fields
    expression = fields.entries[-1].value
    assert expression.items
    assert [item.text for item in expression.items] == ["-1", "0", "accel_y"]


def test_protos_are_the_routers_own_unless_the_table_has_some(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    path.write_text(
        "version: 1\nenvelope: {message: PBEnvelope, oneof: payload}\nlisten: {all: {address: 127.0.0.1:5000}}\n"
        "routes: {imu_info: {ignore: not here}}\n"
    )
    table, findings = load_table(path)
    assert table is not None
    assert table.envelope is not None
    assert (table.envelope.protos.value, findings) == (asset("protos"), [])


def test_protos_are_relative_to_the_file_that_says_so(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "base.yaml").write_text(GOOD)
    table, findings = load(tmp_path, "extends: base/base.yaml\n")
    assert not findings
    assert table
    assert table.envelope
    assert table.envelope.protos.value.resolve() == tmp_path / "protos"


def test_the_hash_is_over_all_files_in_order(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(GOOD)
    table, _ = load(tmp_path, "extends: base.yaml\n")
    assert table
    assert [path.name for path in table.files] == ["table.yaml", "base.yaml"]
    assert table.sha256 == hashlib.sha256(b"extends: base.yaml\n" + GOOD.encode()).hexdigest()


def test_what_is_left_out_has_defaults(tmp_path: Path) -> None:
    text = GOOD.replace("node: {name: rover_router, namespace: /}\nmetrics: {address: 127.0.0.1:9108}\n", "")
    table, findings = load(tmp_path, text.replace(", framing: exact, receive_buffer: 64kB", ""))
    assert not findings
    assert table
    assert (table.node.name, table.node.namespace, table.metrics) == ("rover_router", "/", None)
    listener = table.listeners["rover"]
    assert (listener.framing, listener.receive_buffer, listener.coalesce) == (Framing.ZERO_TRIMMED, 4 << 20, 1_000_000)


def test_what_has_a_finding_is_left_out_and_named(tmp_path: Path) -> None:
    text = GOOD.replace("192.168.0.30:8", "192.168.0.30").replace("queue_depth: 10", "queue_depth: ten")
    table, findings = load(tmp_path, text)
    assert places(findings) == [(Code.BAD_ADDRESS, 8, 27), (Code.WRONG_TYPE, 17, 22)]
    assert table
    assert table.broken == {"endpoints/sensor_board", "routes/imu_info"}
    assert list(table.endpoints) == ["basestation"]
    [imu_info] = [route for route in table.routes if route.case.value == "imu_info"]
    assert imu_info.topics[0].queue_depth is None
    assert imu_info.topics[0].fields  # the rest of the route is checked in the same run


def test_a_route_without_a_sound_source_is_left_out(tmp_path: Path) -> None:
    table, findings = load(tmp_path, GOOD.replace("source: sensor_board", "source: 5"))
    assert [found.code for found in findings] == [Code.WRONG_TYPE]
    assert table
    assert "imu_info" not in [route.case.value for route in table.routes]


def test_a_misspelt_key_is_one_finding_and_read_as_what_was_meant(tmp_path: Path) -> None:
    text = GOOD.replace("destinations: [basestation, ", "destinatons: [5, ").replace("listen:", "lisen:")
    table, findings = load(tmp_path, text)
    assert places(findings) == [(Code.UNKNOWN_KEY, 5, 1), (Code.UNKNOWN_KEY, 13, 5), (Code.WRONG_TYPE, 13, 19)]
    assert table
    assert list(table.listeners) == ["rover"]


@pytest.mark.parametrize("key", ["envelope", "routes"])
def test_there_is_no_table_without_an_envelope_or_routes(tmp_path: Path, key: str) -> None:
    table, findings = load(tmp_path, "".join(GOOD.partition(f"{key}:")[0]) + f"{key}: 5\n")
    assert table is None
    assert Code.WRONG_TYPE in [finding.code for finding in findings]


def test_every_finding_is_reported_at_once(tmp_path: Path) -> None:
    text = (
        GOOD.replace("depth: 5", "depht: 5")
        .replace("500ms", "500")
        .replace("0.5", "yes")
        .replace("${BASESTATION", "${")
    )
    _, findings = load(tmp_path, text)
    codes = [Code.BAD_VALUE, Code.UNKNOWN_KEY, Code.WRONG_TYPE, Code.AMBIGUOUS_SCALAR]
    assert [finding.code for finding in findings] == codes


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
    table, findings = load(tmp_path, GOOD.replace(right, wrong))
    assert findings
    assert table
    drive = route(table, "manual_drive")
    assert (drive.deadman, drive.no_deadman, len(drive.destinations)) == (None, None, 1)
    assert table.broken == {"routes/manual_drive"}  # which tells it from one that has none


def test_of_a_deadman_with_a_broken_repeat_the_rest_is_left(tmp_path: Path) -> None:
    table, [finding] = load(tmp_path, GOOD.replace("300 ms, send", "300 ms, repeat: often, send"))
    assert finding.code is Code.BAD_VALUE
    assert table
    assert route(table, "manual_drive").deadman


def test_of_several_routes_the_sound_ones_and_the_sound_parts_are_left(tmp_path: Path) -> None:
    text = GOOD.replace("[basestation, sensor_board]", "[5]").replace(
        "[basestation]\n      deadman", "5\n      deadman"
    )
    table, findings = load(tmp_path, text)
    assert len(findings) == 2
    assert table
    assert table.broken == {"routes/detected_object"}
    routes = [route for route in table.routes if route.case.value == "detected_object"]
    assert [(len(route.topics), len(route.destinations)) for route in routes] == [(1, 0), (1, 1)]


def test_expressions_are_left_out_with_what_gives_them_their_names(tmp_path: Path) -> None:
    text = GOOD.replace("order: index, ", "").replace("for_each: detections", "for_each: 5")
    table, findings = load(tmp_path, text)
    assert len(findings) == 2
    assert table
    each = route(table, "detected_object_from_ros")
    assert (each.for_each, each.fields, each.destinations, each.topics) == (None, None, (), ())
    together = route(table, "detected_object_from_basestation")
    assert (together.collect, together.topics) == (None, ())
