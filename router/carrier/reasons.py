"""Messages for reasons of native threads: why a datagram was rejected, and what in the table refused a message.

`compiler/refusals.py` has the words for what the machine refuses.
"""

from __future__ import annotations

from router import datagrams
from router.compiler.compiled_table import CompiledTable
from router.declared import PLACE_ORDER, Reason
from router.table.model.endpoints import Framing


def why_rejected(program: CompiledTable, listener: str, reason: int, data: bytes, length: int) -> str:
    """Describe why a datagram of `length` bytes was rejected; `data` is all of it or its beginning."""
    plan = program.table.listeners.get(listener)
    if plan is None:
        return ""
    if reason == Reason.SOURCE_MISMATCH and plan.accepts and not length:
        return f"a connection; no endpoint with `listener: {listener}` has this address"
    repairs = plan.framing is Framing.ZERO_TRIMMED
    return datagrams.why_rejected(program.envelopes.at(listener), data, length, repairs=repairs)


def superseded(program: CompiledTable, listener: str, data: bytes) -> str:
    """Describe the payloads of a datagram that has several: `manual_drive, then drive_motor`."""
    plan = program.table.listeners.get(listener)
    if plan is None:
        return ""
    return ", then ".join(
        datagrams.payloads(program.envelopes.at(listener), data, repairs=plan.framing is Framing.ZERO_TRIMMED)
    )


def where_refused(program: CompiledTable, route: str, topic: str | None, target: str, place: int) -> str:
    """Describe the place of the table (`enum place`) that refused a message of `topic` (None: a datagram)."""
    if place == PLACE_ORDER:
        (order,) = (each.order for each in program.table.routes if each.name == route)
        return f"{order.span}: order" if order else ""
    (plan,) = (plan for plan in program.routes if (plan.route, plan.topic) == (route, topic))
    for state in program.states:
        if target == state.label:
            return state.place
    by_label = {to.label: to for to in plan.targets if to.places}  # a topic rather than an endpoint of the same name
    return by_label[target].places[place]
