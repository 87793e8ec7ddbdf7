"""The picture of a table is one sound file with a box and a line for everything, and refers to nothing else."""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from router.compiler import check_table
from router.observe.route_map import NodeKind, nodes_and_edges
from router.table.model import RouteTable
from router.tools.graph import LEGEND, dot, mermaid
from router.tools.graph_layout import route_map
from router.tools.graph_svg import svg
from tests.gateway.browser import Browser
from tests.tables import PROTOS, ROUTES

DOT = shutil.which("dot")
SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen: {{all: {{address: "127.0.0.1:5000"}}}}
endpoints: {{a: {{address: "127.0.0.1:6000", kind: tool}}}}
routes:
  imu_info:
    source: any
    destinations: [{{endpoint: a, when: "str(state) != '\\"#<b>&lt;|\\\\\\\\'\\n and accel_x > 1\\n", max_rate: 5 Hz}}]
  gps_info: {{ignore: 'because "x" < y & so'}}
"""


@pytest.fixture(params=["rover.yaml", "legacy.yaml", "hostile"], scope="module")
def table(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RouteTable:
    path = ROUTES / request.param
    return checked_table(tmp_path_factory.mktemp("hostile") / "hostile.yaml" if request.param == "hostile" else path)


def checked_table(path: Path) -> RouteTable:
    if path.stem == "hostile":
        path.write_text(HOSTILE.format(protos=PROTOS))
    table = check_table(path).table
    assert table is not None
    return table


def test_the_picture_has_a_box_and_a_line_for_everything(table: RouteTable) -> None:
    drawing = route_map(table)
    picture = ET.fromstring(svg(drawing, 'a "title" <&>'))  # noqa: S314 - our own
    titled = [group.get("class", "") for group in picture.iter(f"{SVG}g") if group.find(f"{SVG}title") is not None]
    assert sum("node" in classes.split() for classes in titled) == len(drawing.boxes)
    assert sum("edge" in classes.split() for classes in titled) == len(drawing.curves)
    said = "".join(picture.itertext())
    assert all(box.node.name in said and box.node.about in said for box in drawing.boxes)
    assert all(curve.edge.about in said for curve in drawing.curves)


def test_the_picture_says_what_it_is_about_and_what_its_shapes_mean(table: RouteTable) -> None:
    drawing = route_map(table)
    picture = ET.fromstring(svg(drawing, "boat.yaml", "boat: 2 routes"))  # noqa: S314 - our own
    said = [text.text for text in picture.iter(f"{SVG}text")]
    assert said[:2] == ["boat.yaml", "boat: 2 routes"]
    kinds = {box.node.kind for box in drawing.boxes}
    assert {kind for kind, text in LEGEND.items() if text in said} == kinds
    assert set(LEGEND) == set(NodeKind)


def test_routes_that_halt_boards_are_marked() -> None:
    table = checked_table(ROUTES / "rover.yaml")
    guarded = sum(route.ttl is not None or route.deadman is not None for route in table.routes)
    assert 0 < guarded < len(table.routes)
    assert svg(route_map(table), "").count('class="halt"') == guarded + 1  # and one in the legend


def test_it_refers_to_nothing_outside_itself(table: RouteTable) -> None:
    text = svg(route_map(table), "title").replace("http://www.w3.org/2000/svg", "")
    for outside in ("http:", "https:", "url(", "@import", "href", "<script"):
        assert outside not in text


OVERLAPS = """(() => {
  const inside = (a, b) => a.left >= b.left && a.right <= b.right && a.top >= b.top && a.bottom <= b.bottom;
  const meet = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const box = (element) => element.getBoundingClientRect();
  const texts = [...document.querySelectorAll("svg text")], whole = box(document.querySelector("svg"));
  const wrong = texts.filter((text) => !inside(box(text), whole));
  wrong.push(...texts.filter((a, i) => texts.slice(i + 1).some((b) => meet(box(a), box(b)))));
  for (const node of document.querySelectorAll("svg .node")) {
    if (!inside(box(node.querySelector("text")), box(node.querySelector(".shape")))) wrong.push(node);
    const halt = node.querySelector(".halt");
    if (halt && meet(box(halt), box(node.querySelector("text")))) wrong.push(node);
  }
  return wrong.map((element) => element.textContent);
})()"""


@pytest.mark.slow
def test_nothing_in_the_picture_overlaps(table: RouteTable, tmp_path: Path, browser: Browser) -> None:
    file = tmp_path / "routes.html"
    file.write_text(svg(route_map(table), table.path.name, "boat: 2 routes"), encoding="utf-8")
    assert browser.open(file.as_uri()).evaluate(OVERLAPS) == []


def test_browsers_that_darken_pages_on_their_own_leave_it_alone(table: RouteTable) -> None:
    """They would make its dark boxes light, and keep the light text in them."""
    assert "color-scheme: light dark" in svg(route_map(table), "title").replace("prefers-color-scheme", "")


@pytest.mark.skipif(DOT is None, reason="Graphviz is not installed")
def test_dot_draws_every_node_and_edge(table: RouteTable) -> None:
    text = dot(table, 'with "quotes" \\')
    drawn = subprocess.run([str(DOT), "-Tplain"], input=text, capture_output=True, text=True, check=True)
    nodes, edges = nodes_and_edges(table)
    assert drawn.stderr == ""
    assert drawn.stdout.count("\nnode ") == len(nodes) + len({node.kind for node in nodes})
    assert drawn.stdout.count("\nedge ") == len(edges)


def test_mermaid_has_a_line_for_every_node_and_edge(table: RouteTable) -> None:
    nodes, edges = nodes_and_edges(table)
    lines = mermaid(table, "it's").splitlines()
    assert lines[:4] == ["---", "title: 'it''s'", "---", "flowchart LR"]
    label = r'(\["{text}"\]|\(\["{text}"\]\)|>"{text}"\]|\{{\{{"{text}"\}}\}}|\[\["{text}"\]\])'.format(text='[^"]*')
    drawn = [line for line in lines if re.fullmatch(rf"    n\d+{label}", line)]
    links = [line for line in lines if re.fullmatch(r'  n\d+ (-->|-\.->\|"[^"#<>]*"\|) n\d+', line)]
    explained = [line for line in lines if re.fullmatch(rf"    [a-z]+{label}", line)]
    assert (len(drawn), len(links)) == (len(nodes), len(edges))
    assert len(explained) == len({node.kind for node in nodes})


@pytest.mark.skipif(DOT is None, reason="Graphviz is not installed")
def test_a_condition_is_shown_as_it_is_written_on_one_line(tmp_path: Path) -> None:
    table = checked_table(tmp_path / "hostile.yaml")
    drawn = subprocess.run([str(DOT), "-Tsvg"], input=dot(table, ""), capture_output=True, text=True, check=True)
    assert "#&lt;b&gt;&amp;lt;|" in drawn.stdout
    assert "and accel_x &gt; 1, at most 5 Hz" in drawn.stdout.replace("&#160;", " ").replace("&#45;", "-")
