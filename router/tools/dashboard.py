"""A Grafana dashboard of a table: a row for each endpoint and gateway, in it what each route did, dropped and took.

Asks only for series that a router of this table has, whatever happened so far. Knows neither Grafana's JSON nor any
address: tables that differ in addresses alone have the same dashboard.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import chain, count

from router.compiler.program import Program
from router.table.model import ANY, Endpoint, Gateway, Route, RouteTable
from router.tools.dashboard_layout import SOURCE, Column, bottom, row
from router.tools.dashboard_overview import overview
from router.tools.dashboard_panels import (
    BYTES,
    DEADMAN,
    GREEN,
    LOST,
    MESSAGES,
    RED,
    SECONDS,
    Json,
    Query,
    heat_map,
    lines,
    number,
)
from router.tools.dashboard_queries import Series, selector

SCHEMA_VERSION = 39
"""Of Grafana 11; newer ones convert it when they read it."""


def dashboard(program: Program) -> Json:
    """What Grafana imports, the same for the same table."""
    name = program.table.path.stem
    ids = count(1)
    series = Series(program)
    panels = row("Router", ids, 0, overview(program.table, series), is_open=True)
    for title, columns in _rows(program.table, series):
        panels += row(title, ids, bottom(panels), columns, is_open=False)
    return {
        "uid": re.sub(r"[^\w-]", "-", f"rover-router-{name}", flags=re.ASCII)[:40],
        "title": f"Rover router: {name}",
        "description": f"Made by `router dashboard` of {program.table.path.name}. Edit the table, then make it again.",
        "tags": ["rover-router"],
        "timezone": "browser",
        "editable": True,
        "graphTooltip": 1,
        "refresh": "5s",
        "time": {"from": "now-15m", "to": "now"},
        "schemaVersion": SCHEMA_VERSION,
        "version": 1,
        "templating": {"list": _variables()},
        "annotations": {"list": []},
        "links": [],
        "panels": panels,
    }


def _variables() -> list[Json]:
    instances = "label_values(router_build_info, instance)"
    return [
        {"name": "datasource", "label": "Prometheus", "type": "datasource", "query": "prometheus", "refresh": 1},
        {
            "name": "instance",
            "label": "Router",
            "type": "query",
            "datasource": SOURCE,
            "definition": instances,
            "query": {"query": instances, "refId": "instances"},
            "refresh": 2,
            "sort": 1,
        },
    ]


def _rows(table: RouteTable, series: Series) -> Iterator[tuple[str, Iterable[Column]]]:
    """Titles and panels: endpoints with the routes that come from them, or from ROS to them."""
    routes = [route for route in table.routes if not route.ignore]
    for endpoint in table.endpoints.values():
        own = [route for route in routes if _belongs_to(route, endpoint.name)]
        yield endpoint.name, chain(_endpoint(endpoint, series), *(_route(route, series) for route in own))
    if anybody := [route for route in routes if any(source.value == ANY for source in route.sources)]:
        yield "from anybody", chain.from_iterable(_route(route, series) for route in anybody)
    for gateway in table.gateways.values():
        yield f"gateway {gateway.name}", _gateway(gateway, series)


def _belongs_to(route: Route, endpoint: str) -> bool:
    if route.is_outbound:
        return any(destination.endpoint.value == endpoint for destination in route.destinations)
    return any(source.value == endpoint for source in route.sources)


def _endpoint(endpoint: Endpoint, series: Series) -> Iterator[Column]:
    name = endpoint.name
    steps: list[tuple[float | None, str]] = [(None, GREEN)]
    if endpoint.stale_after is not None:
        steps.append((endpoint.stale_after / 1e9, RED))
    heard = Query(series.seconds_since("endpoint_last_seen_timestamp_seconds", endpoint=name), name)
    yield [number(f"{name} was heard", heard, SECONDS, 4, 8, steps, empty="never", note="Time since it sent.")]
    if series.has("messages_received", source=name):
        queries = [Query(series.rate("messages_received", "route", source=name), "{{route}}")]
        yield [lines(f"From {name}", queries, MESSAGES, 10)]
    queries = []
    if series.has("datagrams_sent", destination=name):
        queries = [Query(series.rate("datagrams_sent", "route", destination=name), "{{route}}")]
    if series.has("deadman_datagrams_sent", destination=name):
        queries += [
            Query(series.rate("deadman_datagrams_sent", "route", destination=name), "deadman of {{route}}"),
            Query(f"{series.rate('deadman_send_errors', 'route', destination=name)} > 0", "lost: deadman of {{route}}"),
        ]
    if queries:
        yield [lines(f"To {name}", queries, MESSAGES, 10, LOST)]


def _route(route: Route, series: Series) -> Iterator[Column]:
    """A graph of what it did, its age, and its latency."""
    name = route.name
    queries = [Query(series.rate("messages_received", route=name), "received")]
    for metric, target in (("datagrams_sent", "destination"), ("messages_published", "topic")):
        if series.has(metric, route=name):
            queries.append(Query(series.rate(metric, target, route=name), f"to {{{{{target}}}}}"))
    if series.has("messages_filtered", route=name):
        filtered = f"{series.rate('messages_filtered', 'target', route=name)} > 0"
        queries.append(Query(filtered, "not wanted by {{target}}"))
    dropped = f"{series.rate('messages_dropped', 'target, reason', route=name)} > 0"
    queries.append(Query(dropped, "dropped for {{target}}: {{reason}}"))
    yield [lines(name, queries, MESSAGES, 12, LOST)]
    age = Query(series.seconds_since("route_last_message_timestamp_seconds", route=name), name)
    if series.has("deadman_active", route=name):
        active = Query(series.of("deadman_active", route=name), name)
        yield [
            number(f"{name}: last message", age, SECONDS, 4, 4, empty="never"),
            number(f"{name}: deadman", active, "none", 4, 4, names=DEADMAN),
        ]
    else:
        yield [number(f"{name}: last message", age, SECONDS, 4, 8, empty="never")]
    yield [
        heat_map(
            f"{name}: time in the router",
            Query(series.buckets("route_duration_seconds", route=name), "{{le}}"),
            SECONDS,
            8,
        )
    ]


def _gateway(gateway: Gateway, series: Series) -> Iterator[Column]:
    name = gateway.name
    clients = Query(series.of("gateway_clients", route=name), "clients")
    missing = Query(series.of("gateway_topics", route=name, state="not_installed"), "topics")
    yield [
        number(f"{name}: clients", clients, "none", 4, 4),
        number(f"{name}: topics not served", missing, "none", 4, 4, ((None, GREEN), (1, RED)), note="Types missing."),
    ]
    messages = [
        Query(series.rate("messages_received", "source", route=name), "received from {{source}}"),
        Query(series.rate("messages_sent", route=name), "sent to clients"),
        Query(
            f"{series.rate('messages_dropped', 'target, reason', route=name)} > 0", "dropped for {{target}}: {{reason}}"
        ),
        Query(
            f"{series.rate('client_messages_dropped', 'reason', route=name)} > 0", "dropped for a client: {{reason}}"
        ),
        Query(f"{series.rate('datagrams_rejected', 'reason', listener=name)} > 0", "rejected: {{reason}}"),
    ]
    yield [lines(f"{name}: messages", messages, MESSAGES, 20, LOST)]
    lag = Query(selector("router_gateway_client_lag_seconds", route=name), "{{client}}")
    yield [lines(f"{name}: how far clients are behind", [lag], SECONDS, 12)]
    sent = Query(series.rate("sent_bytes", route=name), "to clients")
    yield [lines(f"{name}: bytes", [sent], BYTES, 12)]
