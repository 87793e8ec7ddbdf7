"""CPU per message: of datagrams at several rates, and of ROS messages on their way out. Knows no aims."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.versus.helpers import Topic
from benchmarks.versus.runs import Traffic, run, run_outbound, warm_up
from benchmarks.versus.subscriber import subscribed
from benchmarks.versus.trial import Metrics, Trial


def inbound_cost(trial: Trial, rates: Sequence[float], topics: Sequence[Topic]) -> Metrics:
    """`cpu_us@RATE`: CPU microseconds per datagram, of all threads; one process subscribes to the topics."""
    with trial.started() as subject, subscribed(topics) as listening:
        warm_up(subject, trial.pace)
        metrics = subject.conditions()
        for rate in trial.pace.rates(rates):
            result = run(subject, Traffic(rate, trial.pace.seconds), trial.pace, listening)
            metrics[f"cpu_us@{rate:g}"] = result.cpu_us
            result.add_to(metrics, f"@{rate:g}")
    return metrics


def outbound_cost(trial: Trial, rates: Sequence[float]) -> Metrics:
    """`cpu_us@RATE`: CPU microseconds per message that is published on `arm_target`."""
    metrics: Metrics = {}
    with trial.started() as subject:
        for rate in trial.pace.rates(rates):
            result = run_outbound(subject, rate, trial.pace)
            metrics[f"cpu_us@{rate:g}"] = result.cpu_us
            result.add_to(metrics, f"@{rate:g}")
    return metrics
