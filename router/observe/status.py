"""The JSON for the status page: the map of the running table, its numbers, and the last values."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from router.clock import boottime_ns
from router.compiler.compiled_table import CompiledTable
from router.compiler.metrics import INTENDED_REASONS
from router.hosts import bracketed
from router.observe.last_values import LastValues
from router.observe.route_map import deadman_edges, endpoint_node, nodes_and_edges
from router.observe.running import Running
from router.observe.services import METRICS, ServiceReading, service_readings
from router.observe.snapshot import BUCKETS, SERIES, Snapshot
from router.observe.states import StateReading, state_readings
from router.observe.watch import Health
from router.table.model.gateways import Transport

Json = dict[str, Any]

PATHS = {
    "messages_received": "routes {route} sources {source}",
    "datagrams_sent": "routes {route} targets {destination} delivered",
    "messages_published": "routes {route} targets {topic} delivered",
    "messages_sent": "routes {route} targets {target} delivered",
    "messages_dropped": "routes {route} targets {target} dropped {reason}",
    "messages_filtered": "routes {route} targets {target} filtered",
    "messages_collected": "routes {route} targets {target} collected",
    "messages_split": "routes {route} targets {target} split",
    "route_silence_seconds": "routes {route} silence",
    "deadman_trips": "routes {route} deadman_trips",
    "deadman_datagrams_sent": "routes {route} deadman_sent {destination}",
    "gateway_clients": "routes {route} clients",
    "gateway_topics": "routes {route} topics {state}",
    "client_messages_dropped": "routes {route} clients_missed {reason}",
    "endpoint_silences": "endpoints {endpoint} silences",
    "endpoint_last_silence_seconds": "endpoints {endpoint} last_silence",
    "topic_subscribers": "topics {topic} subscribers",
    "endpoint_silence_seconds": "endpoints {endpoint} silence",
    "endpoint_stale_after_seconds": "endpoints {endpoint} stale_after",
    "datagrams_received": "listeners {listener} received",
    "received_bytes": "listeners {listener} bytes",
    "kernel_drops": "listeners {listener} kernel_drops",
    "superseded_members": "listeners {listener} superseded",
    "datagrams_rejected": "listeners {listener} rejected {reason}",
}
"""The place of each metric in `numbers`: keys, and labels in braces."""

IF_ANY = {
    "messages_dropped",
    "messages_filtered",
    "messages_collected",
    "messages_split",
    "client_messages_dropped",
    "superseded_members",
    "datagrams_rejected",
    "endpoint_silences",
    "endpoint_last_silence_seconds",
}
"""Metrics that are omitted while they are 0."""


class Status:
    """Makes the JSON. Thread-safe. Times: boot clock, s. `can_save`: whether the last datagrams are kept."""

    def __init__(self, running: Running, health: Health, can_save: bool = False) -> None:
        self._running = running
        self._health = health
        self._can_save = can_save
        self._started = boottime_ns() / 1e9
        self._values = LastValues(running)

    def numbers(self) -> Json:
        """Return everything that changes. `map` identifies the map, which changes with the table.

        `started` differs for each run of the router, since counters restart at zero.
        """
        running, now = self._running, boottime_ns()
        program = running.program
        table = program.table
        return {
            "at": now / 1e9,
            "started": self._started,
            "map": table.sha256,
            "ready": running.is_ready,
            **numbers(reading := running.read(now)),
            "states": [_state_json(state) for state in state_readings(program, reading)],
            "services": [_service_json(service) for service in service_readings(reading)],
            "problems": [problem.json() for problem in self._health.look().problems],
            "values": self._values.of(program),
        }

    def recent(self) -> Json:
        """Return the numbers of the last seconds, oldest first, without latencies: a new page has rates at once."""
        return {"numbers": [{"at": each.at, **numbers(each)} for each in self._health.look().snapshots]}

    def health(self) -> Json:
        """Return all problems. `name`, `table`: file name and SHA-256 of the table. `received`: since the start.

        `learned`: learned addresses, by endpoint.
        """
        health, calls = self._health.look(), self._running.read(boottime_ns(), METRICS)
        return {
            "name": health.program.table.path.name,
            "table": health.program.table.sha256,
            "received": health.now.total("datagrams_received"),
            "states": [asdict(state) for state in health.states],
            "services": [asdict(service) for service in service_readings(calls)],
            "learned": dict(health.learned),
            "problems": [problem.json() for problem in health.problems],
        }

    def map(self) -> Json:
        """Return everything that is fixed while a table runs.

        `keeps`: seconds that can be saved, or None. `intended`: reasons of intended losses.
        """
        program = self._running.program
        table = program.table
        kept = table.record.last if self._can_save and table.record is not None else None
        return {
            "map": table.sha256,
            "keeps": None if kept is None else kept / 1e9,
            "intended": sorted(INTENDED_REASONS),
            **_map_json(program),
        }

    def close(self) -> None:
        self._values.close()


def numbers(now: Snapshot) -> Json:
    """Return all metrics by route, endpoint, topic and listener. Times in seconds, counts since the start, addresses.

    `routes` includes gateways. A route's `buckets` are cumulative, in the order of bounds.
    """
    groups = ("routes", "endpoints", "topics", "listeners")
    found: Json = {group: {} for group in groups}
    for metric, path in _PATHS.items():
        for labels, value in now.counts(metric).items():
            if value or metric not in IF_ANY:
                *way, last = (labels[key] if isinstance(key, int) else key for key in path)
                place = found
                for key in way:
                    place = place.setdefault(key, {})
                place[last] = place.get(last, 0) + value
    for endpoint, address in now.counts("endpoint_learned"):
        found["endpoints"].setdefault(endpoint, {})["learned"] = address
    for (route, bound), value in now.counts(f"route_duration_seconds{BUCKETS}").items():
        found["routes"].setdefault(route, {}).setdefault("buckets", []).append([bound, value])
    for each in found["routes"].values():
        for key in ("sources", "targets"):
            each.setdefault(key, {})
        for target in each["targets"].values():
            target.setdefault("delivered", 0)
            target.setdefault("dropped", {})
    return found


def _state_json(state: StateReading) -> Json:
    return {"name": state.name, "value": state.value, "origin": state.origin}


def _service_json(service: ServiceReading) -> Json:
    return {"name": service.name, "text": service.text}


def _steps(metric: str, path: str) -> tuple[str | int, ...]:
    """Return the keys of a path, with the index of the label in place of each label."""
    return tuple(SERIES[metric].index(key[1:-1]) if key.startswith("{") else key for key in path.split())


_PATHS = {metric: _steps(metric, path) for metric, path in PATHS.items()}


def _map_json(program: CompiledTable) -> Json:
    """Return the map.

    `pages`: gateways with a page for browsers, and the addresses they listen on. `deadmen`: edges with what deadmen
    send.
    """
    table = program.table
    nodes, edges = nodes_and_edges(table)
    deadmen = [*deadman_edges(program)]
    halted = [endpoint_node(table.endpoints[each.label], "to", 2) for each in deadmen if each.label in table.endpoints]
    return {
        "name": table.path.name,
        "node": table.node.name,
        "listeners": {name: str(listener.address.value) for name, listener in table.listeners.items()},
        "pages": {
            gateway.name: [bracketed(gateway.address.value.host), gateway.address.value.port]
            for gateway in table.gateways.values()
            if gateway.transport.value is Transport.WEBSOCKET and gateway.address is not None
        },
        "deadmen": [asdict(edge) for edge in deadmen],
        "nodes": [{**asdict(node), "kind": node.kind.value} for node in dict.fromkeys([*nodes, *halted])],
        "links": [asdict(edge) for edge in edges],
    }
