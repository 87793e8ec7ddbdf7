"""The scenarios and their aims, as data: who is measured, how, and what the result ought to be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.versus import sized, unrecorded
from benchmarks.versus.contenders import PAYLOADS, TABLES, Contender, Native, Router
from benchmarks.versus.costs import inbound_cost, outbound_cost
from benchmarks.versus.figures import Aim
from benchmarks.versus.flood import flood
from benchmarks.versus.footprint import start_and_memory, start_and_reload
from benchmarks.versus.helpers import ALL_TOPICS, IMU
from benchmarks.versus.idle import idle_cpu
from benchmarks.versus.latencies import latency, latency_beside_busy
from benchmarks.versus.limits import highest_rate, overload
from benchmarks.versus.trial import Measure

RATES = (1000, 5000, 20_000, 40_000)
SIZE_RATES = (5000, 20_000)
FORWARD_RATES = (200, 1000, 5000, 20_000)
RECORD_RATES = (1000, 5000, 20_000)


@dataclass(frozen=True)
class Scenario:
    """The contenders are measured in turns."""

    name: str
    title: str
    contenders: tuple[Contender, ...]
    measure: Measure
    aims: tuple[Aim, ...]


BUFFER = ("--rcvbuf", str(4 << 20))
"""As the router's listeners have by default."""
PEER = Native("peer", "cpp_peer", BUFFER, copies=2)
OWN = Router("router", TABLES / "own.yaml")
SAME_WORK = Router("router", TABLES / "peers_work.yaml", copies=2)
AS_SERVICES = (
    Router("router_realtime", TABLES / "peers_work.yaml", copies=2, realtime=True),
    Native("peer_realtime", "cpp_peer", BUFFER, copies=2, realtime=True),
)


def at_most(against: str, limits: dict[str, float], of: str = "router") -> tuple[Aim, ...]:
    """Limits of ratios, by metric."""
    return tuple(Aim(metric, against, of, at_most=limit) for metric, limit in limits.items())


def cpu_at_most(
    against: str, limits: Sequence[float], rates: Sequence[float] = RATES, of: str = "router"
) -> tuple[Aim, ...]:
    return at_most(against, {f"cpu_us@{rate:g}": limit for rate, limit in zip(rates, limits, strict=True)}, of)


def for_both(limits: dict[str, float]) -> tuple[Aim, ...]:
    """Limits of ratios to the peer, of ordinary processes and of those with a real-time priority."""
    return at_most("peer", limits) + at_most("peer_realtime", limits, "router_realtime")


def sized_router(name: str, size: sized.Size, spread: bool = False) -> Router:
    """One with a table of this size; with `spread`, datagrams are of all its payload cases."""
    folder = size.folder
    return Router(name, folder / "table.yaml", payloads=folder / "payloads.txt" if spread else PAYLOADS)


LATENCY = {f"{edge}_{quantile}_us": 1.0 for edge in ("udp", "udp_subscribed", "ros") for quantile in ("p50", "p99")}
DRIVING_BOARD = "127.0.0.222", 25008
FOOTPRINT = (
    Aim("start_s", at_most=0.7),
    Aim("start_s@again", at_most=0.2),
    Aim("ros_s"),
    Aim("ros_s@again", at_most=1.0),
)
BRAKE = (Aim("brake_s", at_most=0.7), Aim("brake_s@again", at_most=0.15))

SCENARIOS = (
    Scenario(
        "own_table",
        "CPU per datagram: one destination and one topic each, one subscriber of imu_data",
        (OWN, PEER),
        partial(inbound_cost, rates=RATES, topics=(IMU,)),
        cpu_at_most("peer", (0.75, 0.8, 0.95, 0.95)),
    ),
    Scenario(
        "peers_work",
        "CPU per datagram: both destinations, every topic filled and published, one subscriber of all four",
        (SAME_WORK, PEER, *AS_SERVICES),
        partial(inbound_cost, rates=RATES, topics=ALL_TOPICS),
        for_both({f"cpu_us@{rate:g}": 1.0 for rate in RATES}),
    ),
    Scenario(
        "no_subscriber",
        "CPU per datagram: one destination and one topic each, nobody subscribes",
        (OWN, PEER),
        partial(inbound_cost, rates=RATES, topics=()),
        cpu_at_most("peer", (0.75,) * 4),
    ),
    Scenario(
        "forward_only",
        "CPU per datagram: one destination, no topic",
        (Router("router", TABLES / "forward.yaml"), Native("bare", "bare_forward")),
        partial(inbound_cost, rates=FORWARD_RATES, topics=()),
        cpu_at_most("bare", (1.3,) * 4, FORWARD_RATES),
    ),
    Scenario(
        "record_last",
        "CPU per datagram: one destination, no topic, the last minute kept in memory or not",
        (Router("router", TABLES / "record_last.yaml"), Router("unrecorded", TABLES / "forward.yaml")),
        partial(inbound_cost, rates=RECORD_RATES, topics=()),
        cpu_at_most("unrecorded", (1.1, 1.1, 1.1), RECORD_RATES),
    ),
    Scenario(
        "max_rate",
        "Highest rate without loss over 10 s: the work of `peers_work`, one subscriber of imu_data",
        (SAME_WORK, PEER),
        partial(highest_rate, topics=(IMU,)),
        (Aim("max_rate", "peer", at_least=1.2),),
    ),
    Scenario(
        "overloaded",
        "Datagrams per second when 250,000 per second are offered, without and with one subscriber of imu_data",
        (OWN, PEER),
        partial(overload, topics=(IMU,)),
        (Aim("processed@alone", "peer", at_least=1.0), Aim("processed@subscribed", "peer", at_least=1.0)),
    ),
    Scenario(
        "latency",
        "One-way latency at 1000 gps_info per second, to the first destination and to a subscriber: the work of "
        "`peers_work`",
        (SAME_WORK, PEER, *AS_SERVICES),
        partial(latency, rate=1000, seconds=10),
        for_both(LATENCY),
    ),
    Scenario(
        "latency_busy",
        "The same to the first destination, without subscriber, beside four busy processes on both cores",
        (SAME_WORK, PEER, *AS_SERVICES),
        partial(latency_beside_busy, rate=1000, seconds=10),
        for_both({"udp_p50_us": 1.0, "udp_p99_us": 1.0}),
    ),
    Scenario(
        "latency_thick",
        "The same as `latency` at 20,000 per second",
        (SAME_WORK, PEER),
        partial(latency, rate=20_000, seconds=4),
        at_most("peer", LATENCY),
    ),
    Scenario(
        "outbound",
        "CPU per message from ROS to UDP",
        (
            Router("router", TABLES / "outbound.yaml", listens=False),
            Native("peer", "cpp_peer", ("--outbound",), listens=False),
        ),
        partial(outbound_cost, rates=(100, 2000)),
        cpu_at_most("peer", (1.0, 1.0), (100, 2000)),
    ),
    Scenario(
        "footprint",
        "Start to the first datagram routed and the first message on ROS, and memory after 60 s at 5000 per second",
        (OWN, PEER),
        start_and_memory,
        (
            *FOOTPRINT,
            Aim("rss_mb", at_most=80),
            *(Aim(metric, "peer") for metric in ("start_s", "start_s@again", "ros_s@again", "rss_mb")),
        ),
    ),
    Scenario(
        "footprint_rover",
        "The same as `footprint` with all routes of the rover, and start to the first brake at the board",
        (Router("router", TABLES / "rover.yaml", board=DRIVING_BOARD),),
        start_and_memory,
        (*BRAKE, *FOOTPRINT, Aim("rss_mb")),
    ),
    Scenario(
        "footprint_unrecorded",
        "The same without the table's recordings",
        (Router("router", unrecorded.TABLE, board=DRIVING_BOARD),),
        start_and_memory,
        (*BRAKE, *FOOTPRINT, Aim("rss_mb", at_most=90)),
    ),
    Scenario(
        "footprint_1000",
        "Start and reload of a table with 1,000 routes",
        (sized_router("routes_1000", sized.LARGEST),),
        start_and_reload,
        (
            Aim("start_s", of="routes_1000", at_most=3.0),
            Aim("start_s@again", of="routes_1000", at_most=0.3),
            Aim("ros_s", of="routes_1000"),
            Aim("ros_s@again", of="routes_1000"),
            Aim("reload_s", of="routes_1000", at_most=3.0),
        ),
    ),
    Scenario(
        "idle",
        "CPU in percent of a core without traffic and clients: the rover's whole table; 1,000 and 2,500 routes with "
        "`http`; 900 topics without it",
        (
            Router("shipped", TABLES / "shipped.yaml"),
            sized_router("routes_1000", sized.MANY),
            sized_router("routes_2500", sized.MOST),
            sized_router("topics_900", sized.ALL_PUBLISHED),
        ),
        idle_cpu,
        tuple(
            Aim("cpu_percent", of=name, at_most=limit)
            for name, limit in (("shipped", 0.5), ("routes_1000", 0.6), ("routes_2500", 0.8), ("topics_900", 0.3))
        ),
    ),
    Scenario(
        "table_size",
        "CPU per datagram: 260 routes compared with 26, the same four payload cases, one subscriber of imu_data",
        (sized_router("routes_260", sized.LARGE), sized_router("routes_26", sized.SMALL)),
        partial(inbound_cost, rates=SIZE_RATES, topics=(IMU,)),
        cpu_at_most("routes_26", (1.05, 1.05), SIZE_RATES, "routes_260"),
    ),
    Scenario(
        "table_size_spread",
        "CPU per datagram: 260 routes compared with 26, all payload cases in turn, nobody subscribes",
        (sized_router("routes_260", sized.LARGE, spread=True), sized_router("routes_26", sized.SMALL, spread=True)),
        partial(inbound_cost, rates=SIZE_RATES, topics=()),
        cpu_at_most("routes_26", (1.05, 1.05), SIZE_RATES, "routes_260"),
    ),
    Scenario(
        "flood",
        "p99 latency of seven listeners, 200 datagrams per second each, while an eighth gets 50,000",
        (Router("router", TABLES / "flood.yaml"),),
        flood,
        (
            Aim("p99_us@quiet"),
            Aim("p99_us@control"),
            Aim("p99_us@flooded"),
            Aim("flooded_by_quiet", at_most=1.2),
            Aim("flooded_by_control"),
        ),
    ),
)
