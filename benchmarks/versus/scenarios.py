"""The scenarios and their aims, as data: who is measured, how, and what the result ought to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.versus.contenders import TABLES, Contender, Native, Router
from benchmarks.versus.costs import inbound_cost, outbound_cost
from benchmarks.versus.figures import Aim
from benchmarks.versus.helpers import ALL_TOPICS, IMU
from benchmarks.versus.latencies import latency
from benchmarks.versus.trial import Measure

RATES = (1000, 5000, 20_000, 40_000)


@dataclass(frozen=True)
class Scenario:
    """The contenders are measured in turns; the first is the one that the aims are about."""

    name: str
    title: str
    contenders: tuple[Contender, ...]
    measure: Measure
    aims: tuple[Aim, ...]


PEER = Native("peer", "cpp_peer", copies=2)
OWN = Router("router", TABLES / "own.yaml")


def at_most(against: str, limits: dict[str, float]) -> tuple[Aim, ...]:
    """Limits of ratios, by metric."""
    return tuple(Aim(metric, against, at_most=limit) for metric, limit in limits.items())


def cpu_at_most(against: str, limits: Sequence[float], rates: Sequence[float] = RATES) -> tuple[Aim, ...]:
    return at_most(against, {f"cpu_us@{rate:g}": limit for rate, limit in zip(rates, limits, strict=True)})


SCENARIOS = (
    Scenario(
        "own_table",
        "CPU per datagram: one destination and one topic each, one subscriber of imu_data",
        (OWN, PEER),
        partial(inbound_cost, rates=RATES, topics=(IMU,)),
        cpu_at_most("peer", (1.1, 0.9, 0.8, 0.8)),
    ),
    Scenario(
        "peers_work",
        "CPU per datagram: both destinations, every topic filled and published, one subscriber of all four",
        (Router("router", TABLES / "peers_work.yaml", copies=2), PEER),
        partial(inbound_cost, rates=RATES, topics=ALL_TOPICS),
        cpu_at_most("peer", (1.2,) * 4),
    ),
    Scenario(
        "no_subscriber",
        "CPU per datagram: one destination and one topic each, nobody subscribes",
        (OWN, PEER),
        partial(inbound_cost, rates=RATES, topics=()),
        cpu_at_most("peer", (1.1, 0.9, 0.7, 0.6)),
    ),
    Scenario(
        "forward_only",
        "CPU per datagram: one destination, no topic",
        (Router("router", TABLES / "forward.yaml"), PEER, Native("bare", "bare_forward", ("--batch",))),
        partial(inbound_cost, rates=RATES, topics=()),
        cpu_at_most("peer", (0.7,) * 4) + cpu_at_most("bare", (2.0,) * 4),
    ),
    Scenario(
        "latency",
        "One-way latency at 1000 gps_info per second, to the first destination and to a subscriber",
        (OWN, PEER),
        partial(latency, seconds=10),
        at_most(
            "peer",
            {
                f"{edge}_{quantile}_us": limit
                for edge in ("udp", "udp_subscribed", "ros")
                for quantile, limit in (("p50", 1.2), ("p99", 1.2), ("p999", 1.5))
            },
        ),
    ),
    Scenario(
        "outbound",
        "CPU per message from ROS to UDP",
        (
            Router("router", TABLES / "outbound.yaml", listens=False),
            Native("peer", "cpp_peer", ("--outbound",), listens=False),
        ),
        partial(outbound_cost, rates=(100, 2000)),
        cpu_at_most("peer", (1.5, 1.5), (100, 2000)),
    ),
)
