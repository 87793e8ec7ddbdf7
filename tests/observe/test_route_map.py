"""The map of a table shows all that it names, where the metrics' labels find it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.observe.route_map import NodeKind, deadman_edges, nodes_and_edges
from router.table.model.routes import ANY
from tests.tables import ROUTES

TABLES = ("rover.yaml", "legacy.yaml", "sim.yaml")


@cache
def program_of(name: str) -> CompiledTable:
    program = check_table(ROUTES / name).program
    assert program is not None
    return program


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


def test_what_a_deadman_sends_is_named_as_the_metrics_name_it(counted: CompiledTable) -> None:
    """Of boards, and of clients of gateways."""
    series = {each.labels for each, _ in counted.counters.series() if each.metric == "deadman_datagrams_sent"}
    edges = [*deadman_edges(counted)]
    assert {(edge.route, edge.label) for edge in edges} == series
    assert ("dashboard:/cmd_vel", "/cmd_vel") in series
    nodes, _ = nodes_and_edges(counted.table)
    assert {key for edge in edges for key in (edge.start, edge.end)} <= {node.key for node in nodes}


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
