"""What actors and metrics say, as figures. Times in ms, from ns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from benchmarks.fleet.actors import Record, Told

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


def dropped(counted: Mapping[str, int]) -> dict[str, int]:
    """What a router dropped or rejected, by series."""
    kinds = ("messages_dropped_total{", "datagrams_rejected_total{", "client_messages_dropped_total{", "kernel_drops")
    return {name: count for name, count in counted.items() if name.startswith(kinds) and count}


def imbalances(counted: Mapping[str, int], up: tuple[int, int], down: tuple[int, int]) -> list[str]:
    """Sums of one rover that do not come out. `up` and `down` are what was sent and received at the ends."""
    count = Counter(counted)
    from_ros, to_hub = (
        count['messages_received_total{route="fleet",source="ros"}'],
        _sum(count, "sent", "fleet", "clients"),
    )
    from_hub = count['datagrams_received_total{listener="fleet"}']
    accepted = count['messages_received_total{route="fleet",source="clients"}']
    to_ros = count['messages_published_total{route="fleet",topic="/drive"}']
    commands = count['messages_received_total{route="drive",source="drive"}']
    sums = {
        "boards -> router": (up[0], count['messages_received_total{route="imu",source="sensor_board"}']),
        "router -> gateway": (count['messages_published_total{route="imu",topic="imu"}'], from_ros),
        "gateway -> hub": (
            from_ros,
            to_hub + _sum(count, "filtered", "fleet") + _sum(count, "dropped", "fleet", "clients"),
        ),
        "hub -> gateway": (from_hub, accepted + _sum(count, "rejected", "fleet")),
        "gateway -> ROS": (accepted, to_ros + _sum(count, "dropped", "fleet", "/drive")),
        "ROS -> router": (to_ros, commands),
        "router -> board": (commands, down[1] + _sum(count, "dropped", "drive")),
    }
    wrong = [f"{name}: {one} and {other}" for name, (one, other) in sums.items() if one != other]
    if up[1] > to_hub or from_hub > down[0]:
        wrong.append(f"hub: {up[1]} of {to_hub} and {from_hub} of {down[0]}")
    return wrong


_METRICS = {
    "sent": "messages_sent_total{",
    "filtered": "messages_filtered_total{",
    "dropped": "messages_dropped_total{",
    "rejected": "datagrams_rejected_total{",
}


def _sum(count: Mapping[str, int], what: str, owner: str, target: str = "") -> int:
    """Of series whose route or listener is `owner`."""
    owners = (f'route="{owner}"', f'listener="{owner}"')
    return sum(
        value
        for name, value in count.items()
        if name.startswith(_METRICS[what])
        and any(label in name for label in owners)
        and (not target or f'target="{target}"' in name or "target=" not in name)
    )


def braked(told: Told, rovers: Iterable[int], since: int) -> dict[int, float]:
    """Milliseconds from `since` to the first brake of each rover that got one."""
    first: dict[int, float] = {}
    for rover, _, at in told.brakes:
        if rover in rovers and at > since:
            first.setdefault(rover, (at - since) / 1e6)
    return first


def first_after(records: Iterable[Record], since: int) -> dict[int, float]:
    """Milliseconds from `since` to the first message of each rover."""
    first: dict[int, float] = {}
    for rover, _, at in records:
        if at > since:
            first.setdefault(rover, (at - since) / 1e6)
    return first
