"""What actors and metrics say, as figures. Times in ms, from ns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.fleet.actors import Record
from router.observe.snapshot import Snapshot

Figures = dict[str, Any]


def percentile(values: Sequence[float], part: float) -> float | None:
    """None of nothing."""
    ordered = sorted(values)
    return round(ordered[round(part * (len(ordered) - 1))], 2) if ordered else None


def spread(values: Sequence[float]) -> Figures:
    return {name: percentile(values, part) for name, part in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}


def carried(sent: Iterable[Record], received: Sequence[Record], seconds: float) -> Figures:
    """Of one direction. Messages are told apart by rover and sequence number."""
    began = {(rover, number): at for rover, number, at in sent}
    ended: dict[tuple[int, int], int] = {}
    for rover, number, at in received:
        ended.setdefault((rover, number), at)
    return {
        "sent": len(began),
        "received": len(ended),
        "lost": len(began.keys() - ended.keys()),
        "twice": len(received) - len(ended),
        "never_sent": len(ended.keys() - began.keys()),
        "per_second": round(len(ended) / seconds, 1),
        "latency_ms": spread([(at - began[key]) / 1e6 for key, at in ended.items() if key in began]),
    }


def counted(before: Snapshot, after: Snapshot) -> Snapshot:
    """What was counted in between."""
    values = {
        metric: {labels: value - before.counts(metric).get(labels, 0) for labels, value in series.items()}
        for metric, series in after.values.items()
    }
    return Snapshot(after.at, values)


def dropped(count: Snapshot) -> Counter[str]:
    """What a router dropped or rejected, by metric and labels."""
    kinds = ("messages_dropped", "datagrams_rejected", "client_messages_dropped", "kernel_drops")
    series = {(kind, *labels): value for kind in kinds for labels, value in count.counts(kind).items()}
    return Counter({" ".join(words): int(value) for words, value in series.items() if value})


def imbalances(count: Snapshot, up: tuple[int, int], down: tuple[int, int]) -> list[str]:
    """Sums of one rover that do not come out. `up` and `down` are what was sent and received at the ends."""
    total = count.total
    from_ros, to_hub = total("messages_received", "fleet", "ros"), total("messages_sent", "fleet")
    from_hub, accepted = total("datagrams_received", "fleet"), total("messages_received", "fleet", "clients")
    to_ros, commands = total("messages_published", "fleet", "/drive"), total("messages_received", "drive", "drive")
    withheld = total("messages_filtered", "fleet") + total("messages_dropped", "fleet", "clients")
    sums = {
        "boards -> router": (up[0], total("messages_received", "imu", "sensor_board")),
        "router -> gateway": (total("messages_published", "imu", "imu"), from_ros),
        "gateway -> hub": (from_ros, to_hub + withheld),
        "hub -> gateway": (from_hub, accepted + total("datagrams_rejected", "fleet")),
        "gateway -> ROS": (accepted, to_ros + total("messages_dropped", "fleet", "/drive")),
        "ROS -> router": (to_ros, commands),
        "router -> board": (commands, down[1] + total("messages_dropped", "drive")),
    }
    wrong = [f"{name}: {one} and {other}" for name, (one, other) in sums.items() if one != other]
    if up[1] > to_hub or from_hub > down[0]:
        wrong.append(f"hub: {up[1]} of {to_hub} and {from_hub} of {down[0]}")
    return wrong


def first_after(records: Iterable[Record], since: int) -> dict[int, float]:
    """Milliseconds from `since` to the first message of each rover."""
    first: dict[int, float] = {}
    for rover, _, at in records:
        if at > since:
            first.setdefault(rover, (at - since) / 1e6)
    return first
