"""One-way latency, from the generator to a destination and to a ROS subscriber. Knows no aims."""

from __future__ import annotations

from benchmarks.versus.helpers import GPS
from benchmarks.versus.runs import Traffic, run, warm_up
from benchmarks.versus.subscriber import subscribed
from benchmarks.versus.trial import Metrics, Trial

QUANTILES = ("p50", "p99", "p999")


def latency(trial: Trial, rate: float, seconds: float) -> Metrics:
    """In microseconds: `udp_*` to the first destination, without a subscriber; `ros_*` to a subscriber's hands.

    `udp_subscribed_*` is the first again, while that subscriber listens.
    """
    metrics: Metrics = {}
    traffic = Traffic(rate, min(seconds, trial.pace.longest), stamped=True)
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        alone = run(subject, traffic, trial.pace)
        with subscribed([GPS]) as listening:
            heard = run(subject, traffic, trial.pace, listening)
    for result in (alone, heard):
        result.add_to(metrics, "")
    found = {"udp": alone.latency_us, "udp_subscribed": heard.latency_us, "ros": heard.ros_latency_us}
    for name, latencies in found.items():
        metrics |= {f"{name}_{quantile}_us": latencies[quantile] for quantile in QUANTILES if latencies}
    return metrics
