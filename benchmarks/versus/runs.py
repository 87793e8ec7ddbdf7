"""One run: traffic through a process for some seconds, what came out, and what that cost. Knows no aims.

A run that others disturbed, in which something got lost, or whose generator was too slow is repeated, and the best one
counts. What is wrong with that stays in the figures: `lost` are datagrams that should have reached a destination and
did not, `ros_lost` messages that a subscriber should have got, `too_slow` runs that had less traffic than was asked
for. A figure counts only where all are 0.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.versus.contenders import payload_cases
from benchmarks.versus.helpers import KEEPS_UP, STAMPED_CASE, load, publisher, sink
from benchmarks.versus.processes import FIRST
from benchmarks.versus.subject import Meter, Subject
from benchmarks.versus.subscriber import Subscriber
from benchmarks.versus.trial import Metrics, Pace

NOISE_LIMIT = 0.05
"""Of a core, used by processes that are not ours."""


@dataclass(frozen=True)
class Run:
    """`asked` and `achieved` are per second, `latency_us` is of the first sink, `ros_latency_us` of the subscriber."""

    asked: float
    achieved: float
    lost: int
    ros_lost: int
    cpu_us: float
    noise: float
    latency_us: dict[str, float] | None
    ros_latency_us: dict[str, float] | None = None

    @property
    def too_slow(self) -> bool:
        return self.achieved < KEEPS_UP * self.asked

    @property
    def is_sound(self) -> bool:
        return self.noise <= NOISE_LIMIT and not self.lost and not self.ros_lost and not self.too_slow

    def add_to(self, metrics: Metrics, suffix: str) -> None:
        """Adds what says whether figures with this suffix count."""
        metrics["noise"] = max(metrics.get("noise", 0), round(self.noise, 3))
        for name, value in (("lost", self.lost), ("ros_lost", self.ros_lost), ("too_slow", int(self.too_slow))):
            metrics[f"{name}{suffix}"] = metrics.get(f"{name}{suffix}", 0) + value


@dataclass(frozen=True)
class Traffic:
    """Datagrams to the subject, of those meant for it.

    `stamped`: only those that can carry the time of sending, and sinks wake for each. `first`: generator and sinks run
    before everything else.
    """

    rate: float
    seconds: float
    burst: int = 1
    stamped: bool = False
    first: bool = False


def _run(subject: Subject, traffic: Traffic, listening: Subscriber | None) -> Run:
    of_load, of_sink = (FIRST, FIRST) if traffic.first else (-10, -5)
    with sink(*subject.destinations(), wakes=traffic.stamped, priority=of_sink) as receiver:
        if listening:
            listening.heard()  # what came before is no part of this run
        meter = Meter(subject)
        with load(
            subject.ports.listen[:1],
            traffic.rate,
            traffic.seconds,
            burst=traffic.burst,
            payloads=subject.contender.payloads,
            case=STAMPED_CASE if traffic.stamped else "",
            stamped=traffic.stamped,
            priority=of_load,
        ) as generator:
            sent = generator.result()
        time.sleep(0.1)
        meter.read()
        arrived = receiver.stop()["ports"]
    result = _result(subject, traffic.rate, sent, meter, arrived)
    if not listening:
        return result
    cases = [STAMPED_CASE] if traffic.stamped else payload_cases(subject.contender.payloads)
    heard = listening.heard()
    missing = max(0, listening.expected(sent["sent"], cases) - heard.received)
    return replace(result, ros_lost=missing, ros_latency_us=heard.latency_us)


def _run_outbound(subject: Subject, rate: float, seconds: float) -> Run:
    with sink(subject.ports.first) as receiver, publisher(rate, seconds) as source:
        meter = Meter(subject)
        source.go()
        sent = source.result()
        meter.read()
        return _result(subject, rate, sent, meter, receiver.stop()["ports"])


def _result(subject: Subject, rate: float, sent: dict[str, Any], meter: Meter, arrived: list[dict[str, Any]]) -> Run:
    """Of a run in which nobody subscribed."""
    return Run(
        asked=rate,
        achieved=sent["rate"],
        lost=max(0, sent["sent"] * subject.contender.copies - sum(port["datagrams"] for port in arrived)),
        ros_lost=0,
        cpu_us=round(meter.cpu_ns / 1e3 / max(1, sent["sent"] - meter.drops), 2),
        noise=meter.noise,
        latency_us=arrived[0]["latency_us"],
    )


def best(attempt: Callable[[], Run], retries: int) -> Run:
    """The first sound one, else the one with the least wrong."""
    found = attempt()
    for _ in range(retries):
        if found.is_sound:
            break
        found = min(found, attempt(), key=lambda run: (run.too_slow, run.lost + run.ros_lost, run.noise))
    return found


def run(subject: Subject, traffic: Traffic, pace: Pace, listening: Subscriber | None = None) -> Run:
    return best(lambda: _run(subject, traffic, listening), pace.retries)


def run_outbound(subject: Subject, rate: float, pace: Pace) -> Run:
    """ROS messages, which the subject makes datagrams of."""
    return best(lambda: _run_outbound(subject, rate, pace.seconds), pace.retries)


def warm_up(subject: Subject, pace: Pace) -> None:
    """What runs for the first time is slow, and no figure."""
    _run(subject, Traffic(1000, min(pace.seconds, 1)), None)
