"""The map of a table shows all that it names, where the metrics' labels find it, and no two boxes overlap."""

from __future__ import annotations

import itertools
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler import check_table
from router.compiler.program import Program
from router.observe.route_map import NodeKind, nodes_and_edges, route_map, shortened, spread
from router.table.model import ANY
from tests.tables import ROUTES

TABLES = ("rover.yaml", "legacy.yaml", "sim.yaml")


@cache
def program_of(name: str) -> Program:
    program = check_table(ROUTES / name).program
    assert program is not None
    return program


@pytest.mark.parametrize("name", TABLES)
def test_no_box_overlaps_another_and_links_run_from_the_right_of_a_box_to_the_left_of_another(name: str) -> None:
    drawing = route_map(program_of(name).table)
    for box in drawing.boxes:
        assert 0 <= box.x < box.x + box.width <= drawing.width
        assert 0 <= box.y < box.y + box.height <= drawing.height
    for one, other in itertools.combinations(drawing.boxes, 2):
        apart = one.y + one.height <= other.y or other.y + other.height <= one.y
        assert apart or one.node.column != other.node.column, (one, other)
    boxes = {box.node.key: box for box in drawing.boxes}
    assert len(boxes) == len(drawing.boxes)
    for curve in drawing.curves:
        start, end = boxes[curve.edge.start], boxes[curve.edge.end]
        assert (curve.x0, curve.x1) == (start.x + start.width, end.x)
        assert start.y < curve.y0 < start.y + start.height
        assert end.y < curve.y1 < end.y + end.height


@pytest.mark.parametrize("name", TABLES)
def test_links_are_named_as_the_metrics_name_what_flows(name: str) -> None:
    program = program_of(name)
    series = {(each.metric, *each.labels) for each, _ in program.counters.series()}
    nodes, edges = nodes_and_edges(program.table)
    kinds = {node.key: node.kind for node in nodes}
    columns = {node.key: node.column for node in nodes}
    for edge in edges:
        if columns[edge.start] == 0:
            assert edge.label == ANY or ("messages_received", edge.route, edge.label) in series
        elif kinds[edge.end] is NodeKind.CLIENTS:
            assert ("messages_sent", edge.route, edge.label) in series
        else:
            metric = "messages_published" if kinds[edge.end] is NodeKind.TOPIC else "datagrams_sent"
            assert (metric, edge.route, edge.label) in series
            assert any(each[:3] == ("messages_dropped", edge.route, edge.label) for each in series)


def test_every_delivery_of_the_books_has_a_link() -> None:
    program = program_of("sim.yaml")
    delivered = ("datagrams_sent", "messages_published", "messages_sent")
    ways = {(name, gateway.transport.value.value) for name, gateway in program.table.gateways.items()}
    counted = {each.labels for each, _ in program.counters.series() if each.metric in delivered} - ways
    assert counted <= {(edge.route, edge.label) for edge in nodes_and_edges(program.table)[1]}


def test_an_ignored_case_stands_there_with_its_reason(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    path.write_text(f"extends: {ROUTES}/rover.yaml\nroutes: {{gps_info: {{ignore: 'because \"x\" < y & so'}}}}\n")
    table = check_table(path).table
    assert table is not None
    nodes, edges = nodes_and_edges(table)
    ignored = next(node for node in nodes if node.name == "gps_info")
    assert (ignored.kind, ignored.about) == (NodeKind.IGNORED, 'ignored: because "x" < y & so')
    assert all(ignored.key not in (edge.start, edge.end) for edge in edges)


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(1, 100)), max_size=20), st.floats(0, 1e3))
def test_spread_keeps_order_distance_and_room(column: list[tuple[float, float]], spare: float) -> None:
    wanted, sizes = [want for want, _ in column], [size for _, size in column]
    room = sum(sizes) + spare
    tops = spread(wanted, sizes, room)
    ends = [0.0, *(top + size for top, size in zip(tops, sizes, strict=True))]
    assert all(top >= end - 1e-6 for top, end in zip(tops, ends, strict=False))
    assert ends[-1] <= room + 1e-6


def test_spread_leaves_what_fits_where_it_wants_to_be() -> None:
    assert spread([5, 40, 41, 100], [10, 10, 10, 10], 200) == [5, 35.5, 45.5, 100]


def test_a_long_name_keeps_its_beginning_and_end() -> None:
    assert shortened("sensor_board_diagnostics", 18) == "sensor_bo…gnostics"
    assert shortened("imu_data", 18) == "imu_data"
