"""What a flood on one listener does to the latency of the others. Knows no aims.

Generators and sinks share a core, where the flood must not delay what is measured: what makes and drains it runs only
while nothing else wants to. How well that works shows a control: the same flood past the process under test, from its
generator straight to the sink that drains it.
"""

from __future__ import annotations

from benchmarks.versus.helpers import KEEPS_UP, STAMPED_CASE, load, sink
from benchmarks.versus.runs import warm_up
from benchmarks.versus.subject import Subject
from benchmarks.versus.trial import Metrics, Trial

FLOODER = "127.0.0.31:0"
FLOODED_CASE = "imu_info"
FLOOD_RATE, FLOOD_BURST = 50_000, 4
RATE = 200
"""Datagrams per second, of each listener that is not flooded."""
SECONDS = 8


def flood(trial: Trial) -> Metrics:
    """`p99_us@*` over seven listeners: `quiet`, `flooded` on the eighth, and the `control`; and how they compare.

    `flood_rate@*` is what a flood had per second, `through@*` how much of it reached its destination.
    """
    seconds = min(SECONDS, trial.pace.longest)
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        metrics = _p99("quiet", subject, seconds, None)
        metrics |= _p99("control", subject, seconds, subject.ports.second)
        metrics |= _p99("flooded", subject, seconds, subject.ports.listen[0])
    for name in ("lost", "too_slow"):
        metrics[name] = sum(metrics[f"{name}@{condition}"] for condition in ("quiet", "control", "flooded"))
    metrics["flooded_by_quiet"] = metrics["p99_us@flooded"] / metrics["p99_us@quiet"]
    metrics["flooded_by_control"] = metrics["p99_us@flooded"] / metrics["p99_us@control"]
    return metrics


def _p99(name: str, subject: Subject, seconds: float, flooded: int | None) -> Metrics:
    others = subject.ports.listen[1:]
    rate = RATE * len(others)
    with sink(subject.ports.first, wakes=True) as receiver, sink(subject.ports.second, priority=None) as drain:
        calm = load(others, rate, seconds, case=STAMPED_CASE, stamped=True)
        if flooded is None:
            with calm:
                sent = calm.result()
        else:
            storm = load([flooded], FLOOD_RATE, seconds, FLOOD_BURST, case=FLOODED_CASE, source=FLOODER, priority=None)
            with calm, storm:
                sent = calm.result()
                poured = storm.result()
        [arrived] = receiver.stop()["ports"]
        [drained] = drain.stop()["ports"]
    too_slow = sent["rate"] < KEEPS_UP * rate
    metrics: Metrics = {"p99_us": arrived["latency_us"]["p99"], "lost": max(0, sent["sent"] - arrived["datagrams"])}
    if flooded:
        too_slow |= poured["rate"] < KEEPS_UP * FLOOD_RATE
        metrics |= {"flood_rate": poured["rate"], "through": round(drained["datagrams"] / poured["sent"], 4)}
    metrics["too_slow"] = int(too_slow)
    return {f"{metric}@{name}": value for metric, value in metrics.items()}
