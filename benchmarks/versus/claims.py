"""The README's figures, from the file of results. A figure whose measurement was not fair or is missing is left out.

Fair means: router and C++ node sent as many datagrams, had equal receive buffers and the same priority, lost nothing,
were not disturbed, and all figures were measured at one commit without changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.versus.report import notes, number

EQUAL = ("copies", "receive_buffer", "realtime")
"""Of `Subject.conditions`."""

ORDINARY, SERVICE = (0.0, "router", "peer"), (1.0, "router_realtime", "peer_realtime")
"""Whether a thread has a real-time priority, and the contenders."""

HEADINGS = ("", "ordinary user", "service", "scenario")
NONE = "No figures have been measured at this commit yet: run `make bench`.\n"


@dataclass(frozen=True)
class Claim:
    """One row: metrics of a scenario. `against_peer`: as ratios to the C++ node. `unit`: of the router's own values.

    `any_priority`: the priority makes no difference, so one measurement serves both columns. `most`: the highest value
    of all runs instead of the median.
    """

    text: str
    scenario: str
    metrics: tuple[str, ...]
    unit: str = ""
    against_peer: bool = False
    any_priority: bool = False
    most: bool = False


CLAIMS = (
    Claim(
        "processor time per datagram at 1,000 and at 5,000 per second",
        "peers_work",
        ("cpu_us@1000", "cpu_us@5000"),
        against_peer=True,
    ),
    Claim(
        "latency to a board at 1,000 per second with a ROS subscriber, median and p99",
        "latency",
        ("udp_subscribed_p50_us", "udp_subscribed_p99_us"),
        against_peer=True,
    ),
    Claim(
        "p99 latency to a board at 1,000 per second, beside four busy processes",
        "latency_busy",
        ("udp_p99_us",),
        against_peer=True,
    ),
    Claim(
        "latest brake, counted from its timeout, beside four busy processes: after commands by UDP and from ROS",
        "pressure_busy",
        ("brake_udp_max_ms", "brake_ros_max_ms"),
        "ms",
        most=True,
    ),
    Claim(
        "memory with the rover's table, which records, after a minute at 5,000 per second",
        "footprint_rover",
        ("rss_mb",),
        "MB",
        any_priority=True,
    ),
)


def table(results: Mapping[str, Any], claims: Sequence[Claim] = CLAIMS) -> str:
    """The rows that can be shown, with the commit and the machine of all of them."""
    rows = {claim: cells for claim in claims if (cells := _cells(claim, results)) and cells[0]}
    entries = {claim: results["scenarios"][claim.scenario] for claim in rows}
    if not entries:
        return NONE
    newest = max(entries.values(), key=lambda entry: entry["date"])
    kept = [claim for claim in rows if entries[claim]["commit"] == newest["commit"]]
    machine = newest["machine"]
    intro = f"Commit {newest['commit']}, {newest['date']}, {machine['cores']} cores of {machine['cpu']}; medians."
    if any(claim.against_peer for claim in kept):
        intro += " `x 0.90` is 0.90 times what the C++ node takes for the same work."
    lines = [HEADINGS, ("---",) * len(HEADINGS)]
    lines += [(claim.text, *(cell or "not measured" for cell in rows[claim]), f"`{claim.scenario}`") for claim in kept]
    return "\n".join([intro, "", *(f"| {' | '.join(line)} |" for line in lines), ""])


def _cells(claim: Claim, results: Mapping[str, Any]) -> tuple[str, str] | None:
    """For an ordinary user and for the service; empty where it may not be shown. None without a clean measurement."""
    entry = results["scenarios"].get(claim.scenario)
    if entry is None or not entry["commit"] or entry["commit"].endswith("+"):
        return None
    if claim.any_priority:
        value = _values(claim, entry, "router", None)
        return value, value
    ordinary, service = (
        _values(claim, entry, router, peer if claim.against_peer else None)
        if _is_fair(entry, priority, router, *([peer] if claim.against_peer else []))
        else ""
        for priority, router, peer in (ORDINARY, SERVICE)
    )
    return ordinary, service


def _is_fair(entry: Mapping[str, Any], priority: float, *contenders: str) -> bool:
    """Whether these were measured with this priority, undisturbed, and under equal conditions."""
    found = [entry["contenders"].get(name, {}) for name in contenders]
    if notes({name: entry["contenders"].get(name, {}) for name in contenders}):
        return False
    if not all(metrics.get("realtime") == _always(priority) for metrics in found):
        return False
    return all(metrics.get(name) == found[0].get(name) is not None for metrics in found[1:] for name in EQUAL)


def _always(value: float) -> dict[str, float]:
    return {"median": value, "min": value, "max": value}


def _values(claim: Claim, entry: Mapping[str, Any], router: str, peer: str | None) -> str:
    """The values of all metrics; empty if one of them is missing or void."""
    judged = {(figure["metric"], figure["of"], figure["against"]): figure for figure in entry["figures"]}
    figures = [judged.get((metric, router, peer)) for metric in claim.metrics]
    if any(figure is None or figure["verdict"] == "void" for figure in figures):
        return ""
    values = [figure["max" if claim.most else "median"] for figure in figures if figure]
    return " and ".join(f"x {value:.2f}" if peer else f"{number(value)} {claim.unit}" for value in values)
