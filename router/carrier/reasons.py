"""Why native threads rejected a datagram, and what of the table refused a message, in words."""

from __future__ import annotations

from router.compiler.lowering import Lowered, LoweredFeed, LoweredRoute
from router.compiler.program import Program
from router.engine.slow_path import Rejected, SlowPath
from router.types.framing import MAX_DATAGRAM


def why_rejected(program: Program, listener: str, data: bytes, length: int) -> str:
    """Say why a datagram of `length` bytes was rejected, of which `data` may be the beginning."""
    if length > MAX_DATAGRAM:
        return f"{length} bytes"
    if listener not in program.table.listeners:
        return ""
    routed = {number: handlers[0].case.name for number, handlers in program.inbound.items()}
    try:
        case, _, _ = SlowPath(program, program.counters.fresh_counts(), listener, routed).parse(data)
    except Rejected as rejected:
        return str(rejected)
    return case


def where_refused(lowered: Lowered, route: str, topic: str | None, target: str, place: int) -> str:
    """Say which place of the table, an `enum place`, refused a message of `topic`; None for a datagram."""
    if topic is not None:
        serving: list[LoweredRoute | LoweredFeed] = [feed for feed in lowered.from_ros[topic] if feed.route == route]
    else:
        serving = [by_route[route] for by_route in (lowered.topics, lowered.conditions) if route in by_route]
    return next(each.targets[target] for each in serving if target in each.targets).places[place]
