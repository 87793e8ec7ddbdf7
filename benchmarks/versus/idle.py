"""CPU of a router that receives nothing and has no clients, in total and by thread. Knows no aims."""

from __future__ import annotations

import time

from benchmarks.versus.subject import Meter
from benchmarks.versus.trial import Metrics, Trial

SECONDS = 30
SETTLE_SECONDS = 8
"""From the start until DDS and gateways have found what there is."""
LEAST_PERCENT = 0.005


def idle_cpu(trial: Trial) -> Metrics:
    """`cpu_percent` of a core, and `cpu_percent@THREAD` of those that use any."""
    pace = trial.pace
    with trial.started() as subject:
        time.sleep(min(SETTLE_SECONDS, pace.longest))
        before, meter, began = subject.cpu_by_thread(), Meter(subject), time.monotonic()
        time.sleep(min(SECONDS, pace.longest))
        seconds = time.monotonic() - began
        meter.read()
        used = subject.cpu_by_thread() - before
    percent = {f"cpu_percent@{name}": ns / seconds / 1e7 for name, ns in used.most_common()}
    metrics = {"noise": round(meter.noise, 3), "cpu_percent": round(meter.cpu_ns / seconds / 1e7, 3)}
    return metrics | {name: round(value, 3) for name, value in percent.items() if value >= LEAST_PERCENT}
