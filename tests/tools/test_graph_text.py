"""The text for other programs: real `dot` reads it, and names cannot break out of their quotation marks."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from router.compiler import check_table
from router.observe.route_map import nodes_and_edges
from router.table.model import RouteTable
from router.tools.graph_text import dot, mermaid
from tests.tables import PROTOS, ROUTES

DOT = shutil.which("dot")
HOSTILE = """\
version: 1
envelope: {{protos: {protos}, message: PBEnvelope, oneof: payload}}
listen: {{all: {{address: "127.0.0.1:5000"}}}}
endpoints: {{a: {{address: "127.0.0.1:6000", kind: tool}}}}
routes:
  imu_info:
    source: any
    destinations: [{{endpoint: a, when: "str(state) != '\\"#<b>&lt;|\\\\\\\\'\\n and accel_x > 1\\n", max_rate: 5 Hz}}]
"""


@pytest.fixture(params=["rover.yaml", "legacy.yaml", "sim.yaml", "hostile"])
def table(request: pytest.FixtureRequest, tmp_path: Path) -> RouteTable:
    path = ROUTES / request.param
    if request.param == "hostile":
        path = tmp_path / "hostile.yaml"
        path.write_text(HOSTILE.format(protos=PROTOS))
    table = check_table(path).table
    assert table is not None
    return table


@pytest.mark.skipif(DOT is None, reason="Graphviz is not installed")
def test_dot_draws_every_node_and_edge(table: RouteTable) -> None:
    text = dot(table, 'with "quotes" \\')
    drawn = subprocess.run([str(DOT), "-Tplain"], input=text, capture_output=True, text=True, check=True)
    nodes, edges = nodes_and_edges(table)
    assert drawn.stderr == ""
    assert drawn.stdout.count("\nnode ") == len(nodes)
    assert drawn.stdout.count("\nedge ") == len(edges)


def test_mermaid_has_a_line_for_every_node_and_edge(table: RouteTable) -> None:
    nodes, edges = nodes_and_edges(table)
    lines = mermaid(table).splitlines()
    assert lines[0] == "flowchart LR"
    boxes = [line for line in lines if re.fullmatch(r'    n\d+(\[|\(\(|\(\[)"[^"]*"(\]|\)\)|\]\))', line)]
    curves = [line for line in lines if re.fullmatch(r'  n\d+ -->(\|"[^"#<>]*"\|)? n\d+', line)]
    assert (len(boxes), len(curves)) == (len(nodes), len(edges))
    assert len(lines) == 1 + 2 * 3 + len(nodes) + len(edges)


@pytest.mark.skipif(DOT is None, reason="Graphviz is not installed")
def test_a_condition_is_shown_as_it_is_written_on_one_line(tmp_path: Path) -> None:
    path = tmp_path / "hostile.yaml"
    path.write_text(HOSTILE.format(protos=PROTOS))
    table = check_table(path).table
    assert table is not None
    drawn = subprocess.run([str(DOT), "-Tsvg"], input=dot(table, ""), capture_output=True, text=True, check=True)
    assert "#&lt;b&gt;&amp;lt;|" in drawn.stdout
    assert "and accel_x &gt; 1, at most 5 Hz" in html_unescaped_space(drawn.stdout)


def html_unescaped_space(text: str) -> str:
    return text.replace("&#160;", " ").replace("&#45;", "-")
