"""The figures of a run as a text, and what is wrong with them."""

from __future__ import annotations

from functools import reduce

from benchmarks.fleet.figures import Figures

WAYS = {"rover_to_operator": "rover -> operator", "operator_to_rover": "operator -> rover"}
ROWS = {
    **{
        f"{label}{what}": (way, *path)
        for way, label in WAYS.items()
        for what, path in {
            ", messages/s": ["per_second"],
            ": sent": ["sent"],
            ": lost": ["lost"],
            ": latency p50, ms": ["latency_ms", "p50"],
            ": latency p99, ms": ["latency_ms", "p99"],
            ": longest, ms": ["latency_ms", "max"],
        }.items()
    },
    "hub: CPU, % of a core": ("hub_cpu_percent",),
    "hub: CPU per message, us": ("hub_cpu_us_per_message",),
    "hub: memory, MB": ("hub_memory_mb", "rss"),
    "router: CPU, % of a core": ("router_cpu_percent",),
    "router: memory, MB": ("router_memory_mb", "rss"),
    "router: memory not shared, MB": ("router_memory_mb", "private"),
}
"""Labels, and where the figures are in those of a phase."""


def wrong(results: Figures, rovers: int) -> list[str]:
    """Deadmen that did not trip, or tripped though commands came."""
    hub, links, operator = results["hub"], results["links"], results["operator"]
    found = []
    if links["lost_braked"] != links["lost"]:
        found.append(f"cut off from the hub, {links['lost_braked']} of {links['lost']} rovers were braked")
    if links["others_braked"]:
        found.append(f"{links['others_braked']} rovers were braked whose links were not cut")
    if hub["braked"] != rovers:
        found.append(f"without the hub, {hub['braked']} of {rovers} rovers were braked")
    if operator["braked"] != operator["his_rovers"]:
        found.append(f"without their operator, {operator['braked']} of {operator['his_rovers']} rovers were braked")
    if operator["others_braked"]:
        found.append(f"{operator['others_braked']} rovers of other operators were braked")
    return found


def report(results: Figures) -> str:
    one, whole, hub, links, operator = (results[name] for name in ("one", "all", "hub", "links", "operator"))
    ratio = whole["hub_cpu_us_per_message"] / one["hub_cpu_us_per_message"]
    lines = [f"{'rovers':38}{one['rovers']:>10}{whole['rovers']:>10}"]
    for label, path in ROWS.items():
        values = (reduce(lambda found, step: found[step], path, phase) for phase in (one, whole))
        lines.append(f"{label:38}" + "".join(f"{value!s:>10}" for value in values))
    lines += [
        f"{'hub: CPU per message, ratio':38}{ratio:20.2f}",
        f"dropped by routers: {whole['dropped'] or 'nothing'}",
        f"without the hub: {hub['braked']} of {hub['rovers']} rovers braked; {_shown(hub, 'brake_after_ms')}",
        f"hub back: driven again; {_shown(hub, 'driven_again_after_ms')}",
        f"hub back: heard again; {_shown(hub, 'heard_again_after_ms')}",
        f"links cut: {links['lost_braked']} of {links['lost']} rovers braked; {_shown(links, 'brake_after_ms')}",
        f"links cut: {links['others_braked']} of {links['others']} others braked; between commands, "
        + _shown(links, "others_gap_ms"),
        f"links back: driven again; {_shown(links, 'driven_again_after_ms')}",
        f"hub with cut links: {links['hub']['threads']} threads, {links['hub']['descriptors']} descriptors",
        f"an operator less: {operator['braked']} of his {operator['his_rovers']} rovers braked; "
        + _shown(operator, "brake_after_ms"),
        f"an operator less: {operator['others_braked']} of {operator['other_rovers']} others braked; between commands, "
        + _shown(operator, "others_gap_ms"),
        *results["wrong"],
    ]
    return "\n".join(lines)


def _shown(found: Figures, name: str) -> str:
    return "ms: " + ", ".join(f"{part} {value}" for part, value in found[name].items())
