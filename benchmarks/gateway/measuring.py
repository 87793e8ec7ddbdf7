"""One fresh process of one contender under one load, and what came out of it. Knows no contender and no load."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.gateway.receiver import Arrival, Receiver
from benchmarks.gateway.topics import Topic, write
from benchmarks.versus.building import PROGRAMS
from benchmarks.versus.contenders import Contender, Ports
from benchmarks.versus.helpers import Helper
from benchmarks.versus.subject import Meter, Subject

HERTZ = 2.0
"""How often the latest value of a topic is to be sent."""

SETTLE = 13.0
"""Seconds until everything flows: the existing gateway looks for topics after five, and every five."""

Metrics = dict[str, float]


def _percentiles(name: str, seconds: Sequence[float]) -> Metrics:
    """In milliseconds."""
    ordered = sorted(seconds)
    if not ordered:
        return {}
    places = {"p50": 0.5, "p95": 0.95, "max": 1.0}
    return {f"{name}_ms_{label}": 1e3 * ordered[round(part * (len(ordered) - 1))] for label, part in places.items()}


def metrics(topics: Sequence[Topic], arrivals: Sequence[Arrival], seconds: float) -> Metrics:
    """What came, beside what should have come in so many seconds. Ages are those of values that came first then."""
    counts = Counter(arrival.topic for arrival in arrivals)
    wanted = HERTZ * seconds
    fresh = [*{(arrival.topic, arrival.published): arrival for arrival in reversed(arrivals)}.values()]
    found = {
        "topics": len(topics),
        "served": len(counts),
        "at_rate": sum(abs(counts[topic.name] - wanted) <= 1 + 0.05 * wanted for topic in topics),
        "packets_per_s": len(arrivals) / seconds,
        "repeated": 1 - len(fresh) / len(arrivals) if arrivals else 0.0,
    }
    found |= _percentiles("arrival", [arrival.received - arrival.published for arrival in fresh])
    found |= _percentiles("age", [arrival.sent - arrival.published for arrival in fresh])
    return found | _percentiles("transit", [arrival.received - arrival.sent for arrival in fresh])


def measure(contender: Contender, topics: Sequence[Topic], seconds: float, folder: Path) -> Metrics:
    """All figures of one fresh process."""
    plan = folder / "topics.txt"
    write(topics, plan)
    ports = Ports.free()
    kinds = {topic.name: topic.kind for topic in topics}
    with ExitStack() as stack:
        receiver = stack.enter_context(Receiver(ports.first))
        load = stack.enter_context(Helper(PROGRAMS / "ros_load", "--topics", plan, priority=-10))
        load.result()
        subject = stack.enter_context(Subject(contender, ports, folder / "subject.log"))
        subject.wait_until_bound()
        time.sleep(SETTLE)
        meter, began = Meter(subject), time.time()
        time.sleep(seconds)
        ended = time.time()
        meter.read()
        memory = subject.rss_mb()
        subject.check(time.monotonic() + 1)
        loaded = load.stop()
    elapsed = ended - began
    receiver.keep(began, ended)
    found = {"cpu_percent": meter.cpu_ns / elapsed / 1e7, "memory_mb": memory, "noise": meter.noise}
    found |= metrics(topics, [*receiver.arrivals(kinds)], elapsed)
    found["cpu_us_per_packet"] = 1e4 * found["cpu_percent"] / max(found["packets_per_s"], 1e-9)
    return found | {"kB_per_s": receiver.bytes() / elapsed / 1e3, "load_late_ms": loaded["latest_ms"]}
