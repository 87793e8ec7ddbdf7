"""What Prometheus sees, scraped over HTTP."""

from __future__ import annotations

import socket
import urllib.request
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from ctypes import c_int64
from dataclasses import dataclass
from typing import cast

import pytest
from prometheus_client.parser import text_string_to_metric_families

from router.clock import boottime_ns
from router.compiler.metrics import LATENCY_BOUNDS_NS, METRICS, Counters
from router.errors import SourceSpan, StartError
from router.library import library
from router.net.doors import Door
from router.observe.http import HttpServer
from router.observe.metrics import CountersCollector
from router.observe.readings import Readings
from router.observe.running import Running
from router.observe.watch import Health
from router.table.addresses import Address

SPAN = SourceSpan("routes/rover.yaml", 8, 20, 34)
LOOPBACK = Address("127.0.0.1", 0)
LABELS = {
    "kind": "board",
    "listener": "rover",
    "reason": "stale",
    "result": "ok",
    "payload_case": "imu_info",
    "route": "imu_info",
    "mode": "peer",
    "server": "http",
    "source": "sensor_board",
    "destination": "basestation",
    "topic": "imu_data",
    "target": "imu_data",
    "endpoint": "sensor_board",
    "address": "192.168.0.30:8",
    "service": "arm",
    "outcome": "answered",
    "policy": "reliability",
    "peer": "publisher",
    "type": "geometry_msgs/msg/Twist",
    "host": "nuc",
    "process": "4711",
    "shares": "topic",
    "name": "drive_motor",
    "node": "/rover_router",
    "state": "served",
    "text": "AUTO",
    "client": "0",
    "command": "true",
}
NO_HEALTH = cast("Health", None)
"""Nobody asks for it."""
BUILD = {"version": "1", "table_sha256": "aa", "protos_sha256": "bb"}


@dataclass
class Scraped:
    """Counters with one series per metric, two threads' counts, and what a scrape shows of them."""

    indexes: dict[str, int]
    threads: list[list[int]]
    drops: int
    address: Address

    def values(self) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
        text = urllib.request.urlopen(f"http://{self.address}/metrics", timeout=10).read().decode()
        return {
            (sample.name, frozenset(sample.labels.items())): sample.value
            for family in text_string_to_metric_families(text)
            for sample in family.samples
        }

    def value(self, name: str, **labels: str) -> float:
        metric = next(metric for metric in METRICS if name.startswith(f"router_{metric.name}"))
        labels |= {label: LABELS[label] for label in metric.exported_labels}
        return self.values()[name, frozenset(labels.items())]


def joined(threads: list[list[int]], latest: bytes) -> list[int]:
    """The counts of all threads together."""
    totals = (c_int64 * len(latest))()
    for counts in threads:
        library().counters_join(totals, (c_int64 * len(latest))(*counts), latest, len(latest))
    return list(totals)


@pytest.fixture
def scraped(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scraped]:
    monkeypatch.setattr("router.observe.responses.KEPT_SECONDS", 0)
    counters = Counters()
    counters.set_commands(LABELS["route"], LABELS["target"], are_commands=True)
    counted = {metric.name: metric.labels[:-1] if metric.kind == "origin" else metric.labels for metric in METRICS}
    indexes = {name: counters.index(name, *(LABELS[label] for label in labels)) for name, labels in counted.items()}
    threads = [counters.fresh_counts(), counters.fresh_counts()]
    result = Scraped(indexes, threads, 0, LOOPBACK)
    computed = {"kernel_drops": lambda: [(["rover"], result.drops)]}
    readings = Readings(counters, lambda: joined(threads, counters.latest()), computed, {LABELS["endpoint"]: 0})
    collector = CountersCollector(readings, BUILD)
    with closing(
        HttpServer(LOOPBACK, SPAN, Door("http", (), Counter()), cast("Running", collector), NO_HEALTH, None)
    ) as server:
        result.address = server.address
        yield result


def test_every_metric_is_there_from_the_start_at_zero(scraped: Scraped) -> None:
    values = scraped.values()
    for metric in METRICS:
        labels = frozenset((label, LABELS[label]) for label in metric.exported_labels)
        suffix = {"counter": "_total", "histogram": "_count"}.get(metric.kind, "")
        if metric.name == "endpoint_unheard_seconds":
            assert values["router_endpoint_unheard_seconds", labels] > 0
        elif metric.kind not in ("age", "origin"):
            assert values[f"router_{metric.name}{suffix}", labels] == 0, metric.name


def test_an_address_that_was_learned_is_a_label(scraped: Scraped) -> None:
    assert not any(name == "router_endpoint_learned" for name, _ in scraped.values())
    scraped.threads[0][scraped.indexes["endpoint_learned"]] = 0xC0A8001E << 16 | 8
    assert scraped.value("router_endpoint_learned") == 1


def test_an_endpoint_is_unheard_until_it_is_heard_and_then_silent(scraped: Scraped) -> None:
    endpoint = frozenset({("endpoint", LABELS["endpoint"])})
    silence, unheard = ("router_endpoint_silence_seconds", endpoint), ("router_endpoint_unheard_seconds", endpoint)
    assert silence not in scraped.values()
    scraped.threads[0][scraped.indexes["endpoint_silence_seconds"]] = boottime_ns() - 3 * 10**9
    values = scraped.values()
    assert unheard not in values
    assert 3 <= values[silence] < 60


def test_a_counter_is_the_sum_over_threads_and_a_gauge_the_latest_of_them(scraped: Scraped) -> None:
    first, second = scraped.threads
    first[scraped.indexes["datagrams_sent"]], second[scraped.indexes["datagrams_sent"]] = 3, 4
    loaded = scraped.indexes["config_last_reload_timestamp_seconds"]
    first[loaded], second[loaded] = 1_500_000_000, 2_500_000_000
    waiting = scraped.indexes["messages_waiting"]
    first[waiting], second[waiting] = 5, -3
    second[scraped.indexes["qos_incompatible"]] = first[scraped.indexes["deadman_active"]] = 2
    assert scraped.value("router_datagrams_sent_total") == 7
    assert scraped.value("router_config_last_reload_timestamp_seconds") == 2.5
    assert scraped.value("router_messages_waiting") == 2
    assert scraped.value("router_qos_incompatible") == 2
    assert scraped.value("router_deadman_active") == 2
    first[scraped.indexes["deadman_active"]] = 0
    assert scraped.value("router_deadman_active") == 0


def test_what_is_not_counted_is_asked_for_at_each_scrape(scraped: Scraped) -> None:
    scraped.drops = 12
    assert scraped.value("router_kernel_drops_total") == 12
    scraped.drops = 13
    assert scraped.value("router_kernel_drops_total") == 13


def test_histogram_buckets_are_cumulative_and_in_seconds(scraped: Scraped) -> None:
    first = scraped.indexes["route_duration_seconds"]
    for counts, elapsed_ns in ((scraped.threads[0], 9_000), (scraped.threads[1], 9_000), (scraped.threads[0], 10**9)):
        counts[first + bisect_left(LATENCY_BOUNDS_NS, elapsed_ns)] += 1
        counts[first + len(LATENCY_BOUNDS_NS) + 1] += elapsed_ns
    assert scraped.value("router_route_duration_seconds_bucket", le="1e-05") == 2
    assert scraped.value("router_route_duration_seconds_bucket", le="0.05") == 2
    assert scraped.value("router_route_duration_seconds_bucket", le="+Inf") == 3
    assert scraped.value("router_route_duration_seconds_count") == 3
    assert scraped.value("router_route_duration_seconds_sum") == pytest.approx(1.000018)


def test_the_process_and_what_it_runs_are_described_and_python_is_not(scraped: Scraped) -> None:
    values = scraped.values()
    assert values["router_build_info", frozenset(BUILD.items())] == 1
    names = {name for name, _ in values}
    assert "process_cpu_seconds_total" in names
    assert not {name for name in names if name.startswith("python_")}


def test_an_address_in_use_is_refused_with_who_has_it() -> None:
    with socket.create_server(LOOPBACK) as other:
        taken = Address(*other.getsockname())
        collector = CountersCollector(Readings(Counters(), list, {}, {}), BUILD)
        with pytest.raises(StartError, match=rf"rover.yaml:8:20: cannot serve HTTP at {taken}: .*\(pid \d+\)"):
            HttpServer(taken, SPAN, Door("http", (), Counter()), cast("Running", collector), NO_HEALTH, None)
