from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from router.errors import Code
from router.table import load_table
from router.table.model import Address, EndpointKind, Framing, RouteTable
from tests.table.tables import GOOD, load, places


@pytest.fixture
def table(tmp_path: Path) -> RouteTable:
    table, findings = load(tmp_path, GOOD)
    assert findings == []
    assert table
    return table


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


def test_routes_are_typed(table: RouteTable) -> None:
    imu, arm, ph = table.routes
    assert [source.value for source in imu.sources] == ["sensor_board"]
    assert [destination.endpoint.value for destination in imu.destinations] == ["basestation", "basestation"]
    conditional = imu.destinations[1]
    assert conditional.when
    assert conditional.when.text == "accel_x > 1"
    assert conditional.max_rate
    assert conditional.max_rate.value == 30.0
    qos = imu.topics[1].qos
    assert qos
    assert qos.deadline
    assert qos.deadline.value == 500_000_000
    assert arm.is_outbound
    assert arm.fields
    assert arm.fields.auto
    assert ph.ignore
    assert ph.ignore.value == "nobody needs it"


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


def test_protos_are_relative_to_the_file_that_says_so(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "base.yaml").write_text(GOOD)
    table, findings = load(tmp_path, "extends: base/base.yaml\n")
    assert not findings
    assert table
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
    assert (table.listeners["rover"].framing, table.listeners["rover"].receive_buffer) == (
        Framing.ZERO_TRIMMED,
        4 << 20,
    )


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
