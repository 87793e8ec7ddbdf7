"""The benchmark of a fleet: what it makes of records and metrics, and a short run of it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from benchmarks.fleet.figures import carried, counted, dropped, first_after, imbalances
from demo.places import alone
from router.observe.snapshot import Snapshot
from tests.acceptance.site import ROOT

SENT = [(1, 1, 0), (1, 2, 1_000_000), (2, 1, 0)]
COUNTED = {
    ("messages_received", "imu", "sensor_board"): 5,
    ("messages_published", "imu", "imu"): 5,
    ("messages_received", "fleet", "ros"): 5,
    ("messages_sent", "fleet", "clients"): 5,
    ("datagrams_received", "fleet"): 4,
    ("datagrams_rejected", "fleet", "malformed"): 0,
    ("messages_received", "fleet", "clients"): 4,
    ("messages_published", "fleet", "/drive"): 3,
    ("messages_dropped", "fleet", "/drive", "stale"): 1,
    ("messages_received", "drive", "drive"): 3,
}


def snapshot(series: Mapping[tuple[str, ...], int]) -> Snapshot:
    metrics = {metric for metric, *_ in series}
    return Snapshot(
        0.0,
        {metric: {labels[1:]: float(n) for labels, n in series.items() if labels[0] == metric} for metric in metrics},
    )


def test_messages_are_told_apart_by_rover_and_number() -> None:
    found = carried(SENT, [(1, 1, 2_000_000), (2, 1, 4_000_000), (2, 1, 5_000_000)], 2.0)
    assert {name: found[name] for name in ("sent", "received", "lost", "twice", "never_sent")} == {
        "sent": 3,
        "received": 2,
        "lost": 1,
        "twice": 1,
        "never_sent": 0,
    }
    assert found["per_second"] == 1.0
    assert found["latency_ms"] == {"p50": 2.0, "p99": 4.0, "max": 4.0}


def test_the_first_message_after_a_time_is_that_of_each_rover() -> None:
    assert first_after(SENT, 500_000) == {1: 0.5}


def test_sums_come_out_where_everything_is_accounted_for() -> None:
    assert imbalances(snapshot(COUNTED), (5, 5), (4, 3)) == []
    assert imbalances(snapshot(COUNTED), (5, 4), (6, 3)) == []  # the hub may lose some


def test_what_was_counted_before_does_not_count() -> None:
    before = snapshot(dict.fromkeys(COUNTED, 10))
    after = snapshot({series: count + 10 for series, count in COUNTED.items()})
    assert counted(before, after).values == snapshot(COUNTED).values
    assert dropped(counted(before, after)) == {"messages_dropped fleet /drive stale": 1}


@pytest.mark.parametrize("series", COUNTED)
def test_a_message_too_many_anywhere_is_found(series: tuple[str, ...]) -> None:
    assert imbalances(snapshot({**COUNTED, series: COUNTED[series] + 1}), (5, 5), (4, 3))


@pytest.mark.slow
def test_a_small_fleet_balances_its_books_and_brakes_without_hub_link_or_operator(tmp_path: Path) -> None:
    if shutil.which("openssl") is None or shutil.which("nft") is None or alone() is None:
        pytest.skip("needs openssl, nft, and a network namespace")
    file = tmp_path / "fleet.json"
    options = ["--rovers", "2", "--operators", "1", "--seconds", "2", "--json", str(file)]
    command = [sys.executable, "-m", "benchmarks.fleet", *options]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stdout + run.stderr
    found = json.loads(file.read_text())
    assert found["wrong"] == []
    assert (found["hub"]["braked"], found["links"]["lost_braked"], found["operator"]["braked"]) == (2, 1, 2)
    for way in ("rover_to_operator", "operator_to_rover"):
        assert found["all"][way]["received"] > 0
        assert found["all"][way]["never_sent"] == 0
