"""One-way latency, from the generator to a destination and to a ROS subscriber. Knows no aims."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.versus.helpers import GPS, busy
from benchmarks.versus.runs import Traffic, run, warm_up
from benchmarks.versus.subscriber import subscribed
from benchmarks.versus.trial import Metrics, Trial

QUANTILES = ("p50", "p99", "p999")


def latency(trial: Trial, rate: float, seconds: float) -> Metrics:
    """In microseconds: `udp_*` to the first destination, without a subscriber; `ros_*` to a subscriber's hands.

    `udp_subscribed_*` is the first again, while that subscriber listens.
    """
    traffic = Traffic(rate, min(seconds, trial.pace.longest), stamped=True)
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        metrics = subject.conditions()
        alone = run(subject, traffic, trial.pace)
        with subscribed([GPS]) as listening:
            heard = run(subject, traffic, trial.pace, listening)
    for result in (alone, heard):
        result.add_to(metrics, "")
    found = {"udp": alone.latency_us, "udp_subscribed": heard.latency_us, "ros": heard.ros_latency_us}
    return metrics | _named(found)


def latency_beside_busy(trial: Trial, rate: float, seconds: float) -> Metrics:
    """`udp_*` while other processes use both cores; generator and sink have a real-time priority above all others."""
    traffic = Traffic(rate, min(seconds, trial.pace.longest), stamped=True, first=True)
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        metrics = subject.conditions()
        with busy():
            result = run(subject, traffic, trial.pace)
    result.add_to(metrics, "")
    return metrics | _named({"udp": result.latency_us})


def _named(found: Mapping[str, Mapping[str, float] | None]) -> Metrics:
    """`NAME_QUANTILE_us` of those that were measured."""
    return {
        f"{name}_{quantile}_us": latencies[quantile]
        for name, latencies in found.items()
        if latencies
        for quantile in QUANTILES
    }
