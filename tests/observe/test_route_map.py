"""The map of a table shows all that it names, where the metrics' labels find it, and no two boxes overlap."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler import check_table
from router.compiler.program import Program
from router.observe.route_map import NARROW, WIDE, Measures, PartKind, map_parts, route_map, shortened, spread
from router.table.model import ANY, RouteTable
from tests.tables import PROTOS, ROUTES

TABLES = ("rover.yaml", "legacy.yaml", "sim.yaml")


def table_of(path: Path) -> RouteTable:
    table = check_table(path).table
    assert table is not None
    return table


def program_of(name: str) -> Program:
    program = check_table(ROUTES / name).program
    assert program is not None
    return program


def hostile(tmp_path: Path) -> RouteTable:
    path = tmp_path / "hostile.yaml"
    path.write_text(f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen: {{all: {{address: "127.0.0.1:5000"}}}}
endpoints: {{a: {{address: "127.0.0.1:6000", kind: tool}}}}
routes:
  imu_info:
    source: any
    destinations: [{{endpoint: a, when: "accel_x < 3 and str(state) != '\\"<b>&'", max_rate: 5 Hz}}]
  gps_info: {{ignore: 'because "x" < y & so'}}
""")
    return table_of(path)


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("measures", [WIDE, NARROW], ids=["wide", "narrow"])
def test_no_box_overlaps_another_and_all_are_in_the_picture(name: str, measures: Measures) -> None:
    drawing = route_map(table_of(ROUTES / name), measures)
    for node in drawing.nodes:
        assert 0 <= node.x < node.x + node.width <= drawing.width
        assert 0 <= node.y < node.y + node.height <= drawing.height
    for one, other in itertools.combinations(drawing.nodes, 2):
        apart = one.y + one.height <= other.y or other.y + other.height <= one.y
        assert apart or one.part.column != other.part.column, (one, other)


@pytest.mark.parametrize("name", TABLES)
def test_links_run_from_the_right_of_a_box_to_the_left_of_another(name: str) -> None:
    drawing = route_map(table_of(ROUTES / name))
    nodes = {node.part.key: node for node in drawing.nodes}
    assert len(nodes) == len(drawing.nodes)
    for link in drawing.links:
        start, end = nodes[link.tie.start], nodes[link.tie.end]
        assert (link.x0, link.x1) == (start.x + start.width, end.x)
        assert start.y < link.y0 < start.y + start.height
        assert end.y < link.y1 < end.y + end.height


@pytest.mark.parametrize("name", TABLES)
def test_links_are_named_as_the_metrics_name_what_flows(name: str) -> None:
    program = program_of(name)
    series = {(each.metric, *each.labels) for each, _ in program.counters.series()}
    parts, ties = map_parts(program.table)
    kinds = {part.key: part.kind for part in parts}
    columns = {part.key: part.column for part in parts}
    for tie in ties:
        if columns[tie.start] == 0:
            assert tie.label == ANY or ("messages_received", tie.route, tie.label) in series
        elif kinds[tie.end] is PartKind.CLIENTS:
            assert ("messages_sent", tie.route, tie.label) in series
        else:
            metric = "messages_published" if kinds[tie.end] is PartKind.TOPIC else "datagrams_sent"
            assert (metric, tie.route, tie.label) in series
            assert any(each[:3] == ("messages_dropped", tie.route, tie.label) for each in series)


def test_every_delivery_of_the_books_has_a_link() -> None:
    program = program_of("sim.yaml")
    delivered = ("datagrams_sent", "messages_published", "messages_sent")
    ways = {(name, gateway.transport.value.value) for name, gateway in program.table.gateways.items()}
    counted = {each.labels for each, _ in program.counters.series() if each.metric in delivered} - ways
    assert counted <= {(tie.route, tie.label) for tie in map_parts(program.table)[1]}


def test_an_ignored_case_stands_there_with_its_reason(tmp_path: Path) -> None:
    parts, ties = map_parts(hostile(tmp_path))
    ignored = next(part for part in parts if part.kind is PartKind.IGNORED)
    assert ignored.about == 'ignored: because "x" < y & so'
    assert all(ignored.key not in (tie.start, tie.end) for tie in ties)


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
