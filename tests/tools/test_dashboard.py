"""The dashboard of a table: what Grafana needs to import it, a row for each endpoint, and in it each route."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from router.cli import main
from router.compiler import check_table
from router.tools.dashboard import dashboard
from router.tools.dashboard_panels import Json
from router.tools.dashboard_queries import Series
from tests.tables import ROUTES

TABLES = [table for table in sorted(ROUTES.glob("*.yaml")) if not table.name.endswith(".test.yaml")]
KINDS = {"timeseries", "stat", "heatmap", "state-timeline"}
"""Panels that come with Grafana."""

UNITS = {"mps", "Bps", "s", "bytes", "percentunit", "none"}
"""Ids of Grafana's units: messages and bytes per second, seconds, bytes, a share of 1."""

OWN_ROUTES = """\
version: 1
extends: {routes}/rover.yaml
gateways: {{dashboard: {{ignore: not here}}}}
routes:
  imu_info: {{ignore: nobody wants it}}
  gps_info: {{source: any, destinations: [basestation]}}
"""


@cache
def made(table: Path) -> Json:
    program = check_table(table).program
    assert program is not None
    return dashboard(program)


def everything(found: Json) -> Iterator[Json]:
    """All panels, rows among them."""
    for panel in found["panels"]:
        yield panel
        yield from panel.get("panels", ())


def panels(found: Json, row: str) -> dict[str, Json]:
    """The panels of a closed row by title."""
    [closed] = [panel for panel in found["panels"] if panel["type"] == "row" and panel["title"] == row]
    return {panel["title"]: panel for panel in closed["panels"]}


def asked(panel: Json) -> str:
    return "\n".join(target["expr"] for target in panel["targets"])


def test_the_dashboard_of_a_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dashboard", str(ROUTES / "rover.yaml")]) == 0
    assert json.loads(capsys.readouterr().out) == made(ROUTES / "rover.yaml")


def test_a_table_with_errors_has_no_dashboard(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("version: 1\n")
    assert main(["dashboard", str(tmp_path / "bad.yaml")]) == 78
    told = capsys.readouterr()
    assert told.out == ""
    assert "error[missing-key]" in told.err


def test_tables_that_differ_in_addresses_alone_have_the_same_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    before = made(ROUTES / "rover.yaml")
    monkeypatch.setenv("BASESTATION", "10.0.0.1:9")
    program = check_table(ROUTES / "rover.yaml").program
    assert program is not None
    assert dashboard(program) == before


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_grafana_can_import_it(table: Path) -> None:
    found = made(table)
    assert json.loads(json.dumps(found)) == found
    assert found["schemaVersion"] == 39
    assert 8 <= len(found["uid"]) <= 40
    assert found["title"] == f"Rover router: {table.stem}"
    ids = [panel["id"] for panel in everything(found)]
    assert len(set(ids)) == len(ids)
    datasource, instance = found["templating"]["list"]
    assert (datasource["name"], datasource["type"], datasource["query"]) == ("datasource", "datasource", "prometheus")
    assert (instance["name"], instance["type"]) == ("instance", "query")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_every_panel_is_whole(table: Path) -> None:
    source = {"type": "prometheus", "uid": "${datasource}"}
    for panel in everything(made(table)):
        if panel["type"] == "row":
            continue
        assert panel["type"] in KINDS
        assert panel["datasource"] == source
        assert panel["fieldConfig"]["defaults"].get("unit") in UNITS
        names = [target["refId"] for target in panel["targets"]]
        assert names
        assert len(set(names)) == len(names)
        for target in panel["targets"]:
            assert target["datasource"] == source
            assert 'instance="$instance"' in target["expr"]
            assert target["instant"] is not target["range"]
            assert target["format"] == ("heatmap" if panel["type"] == "heatmap" else "time_series")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_no_two_panels_that_are_seen_together_overlap(table: Path) -> None:
    found = made(table)
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


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_each_endpoint_has_a_row_and_each_route_stands_in_one(table: Path) -> None:
    read = check_table(table).table
    assert read is not None
    found = made(table)
    rows = [panel["title"] for panel in found["panels"] if panel["type"] == "row"]
    gateways = [f"gateway {name}" for name in read.gateways]
    assert rows[0] == "Router"
    assert [row for row in rows[1:] if row != "from anybody"] == [*read.endpoints, *gateways]
    shown = {title for row in rows[1:] for title in panels(found, row)}
    assert {route.name for route in read.routes if not route.ignore} <= shown


def test_a_route_shows_what_it_received_delivered_and_dropped_its_age_and_its_latency() -> None:
    row = panels(made(ROUTES / "rover.yaml"), "basestation")
    shown = asked(row["manual_drive"])
    for metric in ("messages_received", "datagrams_sent", "messages_published", "messages_dropped"):
        assert f'router_{metric}_total{{instance="$instance", route="manual_drive"}}' in shown
    assert "sum by (destination)" in shown
    assert "sum by (target, reason)" in shown
    assert "router_route_last_message_timestamp_seconds" in asked(row["manual_drive: last message"])
    assert "router_deadman_active" in asked(row["manual_drive: deadman"])
    assert row["manual_drive: time in the router"]["type"] == "heatmap"


def test_a_route_from_ros_stands_where_it_goes_to() -> None:
    assert "drive_motor" in panels(made(ROUTES / "rover.yaml"), "driving_board")


def test_a_route_from_anybody_has_a_row_and_an_ignored_case_none(tmp_path: Path) -> None:
    table = tmp_path / "own.yaml"
    table.write_text(OWN_ROUTES.format(routes=ROUTES))
    found = made(table)
    assert "gps_info" in panels(found, "from anybody")
    assert not any(panel["title"].startswith("imu_info") for panel in everything(found))


def test_an_endpoint_is_red_when_it_is_stale_and_one_that_never_is_stays_green(tmp_path: Path) -> None:
    table = tmp_path / "own.yaml"
    never = "endpoints: {arm_board: {stale_after: never}, sensor_board: {stale_after: 1500ms}}\n"
    table.write_text(f"version: 1\nextends: {ROUTES}/rover.yaml\n{never}")
    assert _steps(made(table), "arm_board") == [None]
    assert _steps(made(table), "sensor_board") == [None, 1.5]


def _steps(found: Json, endpoint: str) -> list[Any]:
    thresholds = panels(found, endpoint)[f"{endpoint} was heard"]["fieldConfig"]["defaults"]["thresholds"]
    return [step["value"] for step in thresholds["steps"]]


def test_what_a_router_would_not_have_cannot_be_asked_for() -> None:
    program = check_table(ROUTES / "rover.yaml").program
    assert program is not None
    series = Series(program)
    assert series.has("deadman_active", route="manual_drive")
    with pytest.raises(ValueError, match="no series of deadman_active"):
        series.of("deadman_active", route="imu_info")
