"""The picture of a table is one sound file with a box and a line for everything, and refers to nothing else."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from router.compiler import check_table
from router.observe.route_map import route_map
from router.table.model import RouteTable
from router.tools.graph_svg import svg
from tests.tables import PROTOS, ROUTES

SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen: {{all: {{address: "127.0.0.1:5000"}}}}
endpoints: {{a: {{address: "127.0.0.1:6000", kind: tool}}}}
routes:
  imu_info:
    source: any
    destinations: [{{endpoint: a, when: "accel_x < 3 and str(state) != '\\"<b>&'", max_rate: 5 Hz}}]
  gps_info: {{ignore: 'because "x" < y & so'}}
"""


@pytest.fixture(params=["rover.yaml", "hostile"])
def table(request: pytest.FixtureRequest, tmp_path: Path) -> RouteTable:
    path = ROUTES / request.param
    if request.param == "hostile":
        path = tmp_path / "hostile.yaml"
        path.write_text(HOSTILE.format(protos=PROTOS))
    table = check_table(path).table
    assert table is not None
    return table


def test_the_picture_has_a_box_and_a_line_for_everything(table: RouteTable) -> None:
    drawing = route_map(table)
    picture = ET.fromstring(svg(drawing, 'a "title" <&>'))  # noqa: S314 - our own
    assert len(list(picture.iter(f"{SVG}rect"))) == len(drawing.boxes)
    assert len(list(picture.iter(f"{SVG}path"))) == len(drawing.curves)
    said = "".join(picture.itertext())
    assert all(box.node.name in said and box.node.about in said for box in drawing.boxes)
    assert all(curve.edge.about in said for curve in drawing.curves)


def test_it_refers_to_nothing_outside_itself(table: RouteTable) -> None:
    text = svg(route_map(table), "title").replace("http://www.w3.org/2000/svg", "")
    for outside in ("http:", "https:", "url(", "@import", "href", "<script"):
        assert outside not in text


def test_browsers_that_darken_pages_on_their_own_leave_it_alone(table: RouteTable) -> None:
    """They would make its dark boxes light, and keep the light text in them."""
    assert "color-scheme: light dark" in svg(route_map(table), "title").replace("prefers-color-scheme", "")
