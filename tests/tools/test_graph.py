"""The picture of a table has a box and a line for everything; tests/transcripts/graph.md has the text of a table."""

from __future__ import annotations

import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from router.cli import OK, main
from router.compiler import check_table
from router.observe.route_map import NodeKind, nodes_and_edges
from router.table.model import RouteTable
from router.tools.graph import LEGEND, dot, svg
from tests.tables import PROTOS, ROUTES

DOT = shutil.which("dot")
needs_graphviz = pytest.mark.skipif(DOT is None, reason="Graphviz is not installed")
SVG = "{http://www.w3.org/2000/svg}"
XLINK = "http://www.w3.org/1999/xlink"
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


@needs_graphviz
def test_the_picture_names_everything_and_says_under_the_pointer_what_it_is(table: RouteTable) -> None:
    picture = ET.fromstring(svg(table, 'a "title" <&>'))  # noqa: S314 - our own
    said = {text.text for text in picture.iter(f"{SVG}text")}
    pointed = {link.get(f"{{{XLINK}}}title") for link in picture.iter(f"{SVG}a")}
    nodes, _ = nodes_and_edges(table)
    assert said >= {'a "title" <&>', *(node.name for node in nodes), *(LEGEND[node.kind] for node in nodes)}
    assert pointed >= {node.about or node.name for node in nodes}
    assert set(LEGEND) == set(NodeKind)


@needs_graphviz
def test_the_picture_refers_to_nothing_outside_itself_and_is_light_or_dark(table: RouteTable) -> None:
    text = svg(table, "title").replace("http://www.w3.org/2000/svg", "").replace(XLINK, "")
    for outside in ("http:", "https:", "url(", "@import", "href", "<script"):
        assert outside not in text
    assert "prefers-color-scheme: dark" in text
    assert "color-scheme: light dark" in text  # browsers that darken pages on their own leave it alone


@needs_graphviz
def test_dot_draws_every_node_and_edge(table: RouteTable) -> None:
    text = dot(table, 'with "quotes" \\')
    drawn = subprocess.run([str(DOT), "-Tplain"], input=text, capture_output=True, text=True, check=True)
    nodes, edges = nodes_and_edges(table)
    assert drawn.stderr == ""
    explained = len({node.kind for node in nodes}) + any(node.is_guarded for node in nodes)
    assert drawn.stdout.count("\nnode ") == len(nodes) + explained
    assert drawn.stdout.count("\nedge ") == len(edges)


@needs_graphviz
def test_the_verb_writes_the_picture(tmp_path: Path) -> None:
    assert main(["graph", str(ROUTES / "rover.yaml"), "-o", str(tmp_path / "routes.svg")]) == OK
    assert (tmp_path / "routes.svg").read_text(encoding="utf-8").startswith("<svg ")
