"""deploy/grafana: what Grafana needs to import the dashboard, and that it asks for nothing the router does not have."""

from __future__ import annotations

import re
from collections.abc import Iterator

from router.compiler.metrics import METRICS
from tests.deploy.dashboard import Json, dashboard, panels
from tests.deploy.promql import grouping_labels, selectors

KINDS = {"timeseries", "stat", "heatmap", "state-timeline"}
"""Panels that come with Grafana."""

UNITS = {"mps", "Bps", "s", "bytes", "percentunit", "short", "none"}
"""Ids of Grafana's units: messages and bytes per second, seconds, bytes, a share of 1."""

OF_THE_PROCESS = {"process_start_time_seconds", "process_cpu_seconds_total", "process_resident_memory_bytes"}
BUILD_LABELS = {"version", "table_sha256", "protos_sha256", "start"}
BY_PROMETHEUS = {"instance", "job"}


def _labels() -> Iterator[tuple[str, set[str]]]:
    for metric in METRICS:
        if metric.kind == "histogram":
            yield f"router_{metric.name}_bucket", {*metric.labels, "le"}
        else:
            yield f"router_{metric.name}{'_total' if metric.kind == 'counter' else ''}", set(metric.exported_labels)
    yield "router_build_info", BUILD_LABELS
    yield from ((name, set()) for name in OF_THE_PROCESS)


LABELS = dict(_labels())
"""The labels of each series that the router exports, by its name."""


def everything() -> Iterator[Json]:
    """All panels, rows among them."""
    for panel in dashboard()["panels"]:
        yield panel
        yield from panel.get("panels", ())


def variables() -> dict[str, Json]:
    return {variable["name"]: variable for variable in dashboard()["templating"]["list"]}


def test_grafana_can_import_it() -> None:
    found = dashboard()
    assert found["schemaVersion"] == 39
    assert 8 <= len(found["uid"]) <= 40
    ids = [panel["id"] for panel in everything()]
    assert len(set(ids)) == len(ids)
    assert list(variables()) == ["datasource", "instance", "route", "listener", "endpoint", "gateway"]
    assert (variables()["datasource"]["type"], variables()["datasource"]["query"]) == ("datasource", "prometheus")


def test_every_panel_is_whole() -> None:
    source = {"type": "prometheus", "uid": "${datasource}"}
    for panel in panels():
        assert panel["type"] in KINDS
        assert panel["datasource"] == source
        assert panel["fieldConfig"]["defaults"].get("unit") in UNITS
        names = [target["refId"] for target in panel["targets"]]
        assert names
        assert len(set(names)) == len(names)
        for target in panel["targets"]:
            assert 'instance="$instance"' in target["expr"]
            assert target.get("instant", False) is (panel["type"] == "stat")
            assert target.get("format") == ("heatmap" if panel["type"] == "heatmap" else None)


def test_no_two_panels_that_are_seen_together_overlap() -> None:
    found = dashboard()
    for together in (found["panels"], *(panel.get("panels", ()) for panel in found["panels"])):
        taken = [place for panel in together for place in _places(panel)]
        assert len(set(taken)) == len(taken)
    rows = [panel["gridPos"]["y"] for panel in found["panels"] if panel["type"] == "row"]
    assert rows == sorted(set(rows))


def _places(panel: Json) -> Iterator[tuple[int, int]]:
    place = panel["gridPos"]
    assert place["x"] + place["w"] <= 24
    for x in range(place["x"], place["x"] + place["w"]):
        for y in range(place["y"], place["y"] + place["h"]):
            yield x, y


def test_only_metrics_and_labels_that_the_router_has_are_asked_for() -> None:
    for panel in panels():
        for target in panel["targets"]:
            expression, labels = target["expr"], set(BY_PROMETHEUS)
            for selector in selectors(expression):
                own = LABELS[selector.metric] | BY_PROMETHEUS
                assert {label for label, _, _ in selector.matchers} <= own, expression
                labels |= own
            assert grouping_labels(expression) <= labels, expression
            kept = grouping_labels(expression) if "sum" in expression else labels
            assert set(re.findall(r"\{\{(\w+)\}\}", target.get("legendFormat", ""))) <= kept, expression


def test_variables_take_their_values_from_labels_that_the_router_has() -> None:
    for name, variable in variables().items():
        if name == "datasource":
            continue
        asked = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["definition"])
        assert asked is not None
        assert variable["query"]["query"] == variable["definition"]
        [selector] = selectors(asked[1])
        assert asked[2] in LABELS[selector.metric] | BY_PROMETHEUS


def test_a_variable_of_several_values_is_matched_as_a_pattern() -> None:
    """Grafana writes several values as `a|b`, and escapes what is special in a pattern also in a single one."""
    used = set()
    for panel in panels():
        for target in panel["targets"]:
            for selector in selectors(target["expr"]):
                for _, sign, value in selector.matchers:
                    if value.startswith("$"):
                        name = value.removeprefix("$")
                        used.add(name)
                        assert sign == ("=~" if variables()[name].get("multi") else "="), target["expr"]
    assert used == variables().keys() - {"datasource"}


def test_routes_endpoints_and_gateways_have_a_closed_row_each() -> None:
    repeated = {panel["repeat"]: panel for panel in dashboard()["panels"] if "repeat" in panel}
    assert repeated.keys() == {"route", "endpoint", "gateway"}
    for name, row in repeated.items():
        assert row["collapsed"]
        assert row["title"].endswith(f" ${name}")
        assert all(f'=~"${name}"' in target["expr"] for panel in row["panels"] for target in panel["targets"])
