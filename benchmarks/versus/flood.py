"""What a flood on one listener does to the latency of the others. Knows no aims.

Generators and sinks share a core, where the flood must not delay what is measured: what makes and drains it runs only
while nothing else wants to. How well that works shows a control: the same flood past the process under test, from its
generator straight to the sink that drains it.
"""

from __future__ import annotations

from benchmarks.versus.helpers import STAMPED_CASE, load, sink
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

    `through@*` is how much of a flood reached its destination.
    """
    seconds = min(SECONDS, trial.pace.longest)
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        metrics = _p99("quiet", subject, seconds, None)
        metrics |= _p99("control", subject, seconds, subject.ports.second)
        metrics |= _p99("flooded", subject, seconds, subject.ports.listen[0])
    metrics["lost"] = sum(metrics[f"lost@{name}"] for name in ("quiet", "control", "flooded"))
    metrics["flooded_by_quiet"] = metrics["p99_us@flooded"] / metrics["p99_us@quiet"]
    metrics["flooded_by_control"] = metrics["p99_us@flooded"] / metrics["p99_us@control"]
    return metrics


def _p99(name: str, subject: Subject, seconds: float, flooded: int | None) -> Metrics:
    others = subject.ports.listen[1:]
    with sink(subject.ports.first, wakes=True) as receiver, sink(subject.ports.second, priority=None) as drain:
        calm = load(others, RATE * len(others), seconds, case=STAMPED_CASE, stamped=True)
        if flooded is None:
            with calm:
                sent = calm.result()
        else:
            storm = load([flooded], FLOOD_RATE, seconds, FLOOD_BURST, case=FLOODED_CASE, source=FLOODER, priority=None)
            with calm, storm:
                sent = calm.result()
                poured = storm.result()["sent"]
        [arrived] = receiver.stop()["ports"]
        [drained] = drain.stop()["ports"]
    metrics = {f"p99_us@{name}": arrived["latency_us"]["p99"], f"lost@{name}": sent["sent"] - arrived["datagrams"]}
    if flooded:
        metrics[f"through@{name}"] = round(drained["datagrams"] / poured, 4)
    return metrics
