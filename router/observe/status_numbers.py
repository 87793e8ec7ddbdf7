"""All that a router counts, by route, endpoint and listener, as a page wants it: plain JSON.

Knows the metrics' names and labels, which `counters` declares; not what the page shows of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from router.observe.metrics import PREFIX

Sample = tuple[str, dict[str, str], float]
Numbers = dict[str, Any]

DELIVERED = {
    "datagrams_sent_total": "destination",
    "messages_published_total": "topic",
    "messages_sent_total": "target",
}
"""The label that names the target, by metric."""


def numbers(samples: Iterable[Sample]) -> Numbers:
    """What did not happen is mostly left out. Times in seconds, counts since the start.

    `routes` has gateways as well. A route's `buckets` are cumulative, in the order of bounds.
    """
    found: Numbers = {"routes": {}, "endpoints": {}, "listeners": {}, "unhandled": {}, "reload": {}}
    for name, labels, value in samples:
        if take := TAKERS.get(name.removeprefix(PREFIX)):
            take(found, labels, value)
    return found


Taker = Callable[[Numbers, dict[str, str], float], None]


def _route(found: Numbers, labels: dict[str, str]) -> Numbers:
    route: Numbers = found["routes"].setdefault(labels["route"], {"sources": {}, "targets": {}})
    return route


def _target(found: Numbers, labels: dict[str, str], name: str) -> Numbers:
    fresh: Numbers = {"delivered": 0, "dropped": {}}
    target: Numbers = _route(found, labels)["targets"].setdefault(labels[name], fresh)
    return target


def _received(found: Numbers, labels: dict[str, str], value: float) -> None:
    _route(found, labels)["sources"][labels["source"]] = value


def _delivered(label: str) -> Taker:
    def take(found: Numbers, labels: dict[str, str], value: float) -> None:
        _target(found, labels, label)["delivered"] += value

    return take


def _of_target(key: str) -> Taker:
    def take(found: Numbers, labels: dict[str, str], value: float) -> None:
        if value:
            _target(found, labels, "target")[key] = value

    return take


def _dropped(found: Numbers, labels: dict[str, str], value: float) -> None:
    if value:
        _target(found, labels, "target")["dropped"][labels["reason"]] = value


def _client_dropped(found: Numbers, labels: dict[str, str], value: float) -> None:
    if value:
        _route(found, labels).setdefault("clients_missed", {})[labels["reason"]] = value


def _of_route(key: str) -> Taker:
    def take(found: Numbers, labels: dict[str, str], value: float) -> None:
        _route(found, labels)[key] = value

    return take


def _bucket(found: Numbers, labels: dict[str, str], value: float) -> None:
    _route(found, labels).setdefault("buckets", []).append([labels["le"], value])


def _gateway_topics(found: Numbers, labels: dict[str, str], value: float) -> None:
    _route(found, labels).setdefault("topics", {})[labels["state"]] = value


def _qos(found: Numbers, labels: dict[str, str], value: float) -> None:
    if value:
        _route(found, labels).setdefault("qos", {}).setdefault(labels["topic"], {})[labels["policy"]] = value


def _of(group: str, label: str, key: str) -> Taker:
    def take(found: Numbers, labels: dict[str, str], value: float) -> None:
        found[group].setdefault(labels[label], {})[key] = value

    return take


def _rejected(found: Numbers, labels: dict[str, str], value: float) -> None:
    if value:
        found["listeners"].setdefault(labels["listener"], {}).setdefault("rejected", {})[labels["reason"]] = value


def _unhandled(found: Numbers, labels: dict[str, str], value: float) -> None:
    if value:
        found["unhandled"][labels["payload_case"]] = value


def _reload(key: str) -> Taker:
    def take(found: Numbers, labels: dict[str, str], value: float) -> None:
        found["reload"][key] = value

    return take


TAKERS: dict[str, Taker] = {
    "messages_received_total": _received,
    **{metric: _delivered(label) for metric, label in DELIVERED.items()},
    "messages_dropped_total": _dropped,
    "messages_filtered_total": _of_target("filtered"),
    "messages_collected_total": _of_target("collected"),
    "route_duration_seconds_bucket": _bucket,
    "route_last_message_timestamp_seconds": _of_route("last"),
    "deadman_active": _of_route("deadman_active"),
    "deadman_trips_total": _of_route("deadman_trips"),
    "gateway_clients": _of_route("clients"),
    "gateway_topics": _gateway_topics,
    "client_messages_dropped_total": _client_dropped,
    "qos_incompatible": _qos,
    "endpoint_last_seen_timestamp_seconds": _of("endpoints", "endpoint", "seen"),
    "datagrams_received_total": _of("listeners", "listener", "received"),
    "received_bytes_total": _of("listeners", "listener", "bytes"),
    "kernel_drops_total": _of("listeners", "listener", "kernel_drops"),
    "datagrams_rejected_total": _rejected,
    "unhandled_total": _unhandled,
    "config_last_reload_successful": _reload("ok"),
    "config_last_reload_timestamp_seconds": _reload("at"),
}
