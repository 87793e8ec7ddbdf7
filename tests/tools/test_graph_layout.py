"""The picture of a table: no two boxes overlap, and lines end at boxes."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler import check_table
from router.tools.graph_layout import route_map, spread
from tests.tables import ROUTES

TABLES = ("rover.yaml", "legacy.yaml", "sim.yaml")


@pytest.mark.parametrize("name", TABLES)
def test_no_box_overlaps_another_and_links_run_from_the_right_of_a_box_to_the_left_of_another(name: str) -> None:
    table = check_table(ROUTES / name).table
    assert table is not None
    drawing = route_map(table)
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
