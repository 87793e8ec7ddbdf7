"""What a table says beside routing: recordings, Foxglove, diagnostics, reloading, when an endpoint is stale."""

from __future__ import annotations

from pathlib import Path

from router.table.addresses import Address
from router.table.model import RouteTable
from tests.table.tables import load

HEAD = """\
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 0.0.0.0:5000}}
routes: {}
"""


def table_with(folder: Path, text: str) -> RouteTable:
    table, findings = load(folder, HEAD + text)
    assert findings == []
    assert table
    return table


def test_without_these_keys_a_router_only_routes(tmp_path: Path) -> None:
    table = table_with(tmp_path, "endpoints: {arm: {address: 10.0.0.1:8, kind: board}}\n")
    assert (table.record, table.foxglove, table.reload_on_change, table.node.diagnostics) == (None, None, False, None)
    assert table.endpoints["arm"].stale_after == 5 * 10**9


def test_a_recording_needs_a_directory_alone(tmp_path: Path) -> None:
    table = table_with(tmp_path, "record: {directory: ../recordings}\n")
    assert table.record
    assert table.record.directory.resolve() == tmp_path.parent.resolve() / "recordings"
    assert (table.record.continuous, table.record.last) == (True, None)
    assert (table.record.max_size, table.record.max_age, table.record.keep) == (256 << 20, 600 * 10**9, 4 << 30)


def test_a_recording_is_typed(tmp_path: Path) -> None:
    text = "record: {directory: /data, continuous: false, last: 60s, max_size: 1.5GB, max_age: 1h, keep: 20GiB}\n"
    found = table_with(tmp_path, text).record
    assert found
    assert (found.directory, found.continuous, found.last) == (Path("/data"), False, 60 * 10**9)
    assert (found.max_size, found.max_age, found.keep) == (1_500_000_000, 3600 * 10**9, 20 << 30)


def test_the_rest_is_typed(tmp_path: Path) -> None:
    table = table_with(
        tmp_path,
        "node: {diagnostics: true}\nfoxglove: {address: 127.0.0.1:8766}\nreload: {on_change: true}\n"
        "endpoints:\n"
        "  arm: {address: 10.0.0.1:8, kind: board, stale_after: 500ms}\n"
        "  tool: {address: 10.0.0.2:8, kind: tool, stale_after: never}\n",
    )
    assert table.node.diagnostics
    assert table.node.diagnostics.line == 5
    assert table.foxglove
    assert table.foxglove.value == Address("127.0.0.1", 8766)
    assert table.reload_on_change
    assert [table.endpoints[name].stale_after for name in ("arm", "tool")] == [500_000_000, None]
