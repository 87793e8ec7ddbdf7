"""Checks `obeyed` of deadmen: the messages that show whether a board has stopped."""

from __future__ import annotations

from router.compiler.compiled_table import ObeyedPlan
from router.compiler.expressions.functions import NS_PER_SECOND
from router.compiler.expressions.kinds import BoolKind
from router.compiler.expressions.tree import Present, Read, nodes_in
from router.compiler.lookup import Lookup
from router.errors import Code, Located
from router.table.model.routes import ANY, Deadman, Obeyed, Route
from router.table.units import duration

LONGEST_WITHIN = 30 * NS_PER_SECOND
"""ns. A rover that takes longer to stop has not obeyed: other values are probably in the wrong unit."""


def check_obeyed(lookup: Lookup, route: Route) -> ObeyedPlan | None:
    """Check what shows that the brake of a route's deadman is obeyed. Return None without it, or with a finding."""
    deadman = route.deadman
    if deadman is None or (obeyed := deadman.obeyed) is None:
        return None
    _check_within(lookup, deadman, obeyed)
    case = lookup.case(obeyed.case)
    if case is None:
        return None
    watched = _watched(lookup, deadman, obeyed.case)
    hint = "write a comparison, such as abs(front_left_motor.rpm) < 5"
    when = lookup.value(obeyed.when, lookup.received(case), (BoolKind,), "'obeyed' takes a bool", hint)
    if when is None:
        return None
    if not any(isinstance(node, (Read, Present)) for node in nodes_in(when)):
        message = f"this reads no field of '{case.name}', so it shows nothing about the board"
        lookup.report(when.span, Code.BAD_VALUE, message, "compare a field that says how fast the motors turn")
        return None
    return ObeyedPlan(case, when, obeyed.within.value, watched)


def _check_within(lookup: Lookup, deadman: Deadman, obeyed: Obeyed) -> None:
    within, time = obeyed.within, duration(obeyed.within.value)
    if within.value < deadman.repeat.value:
        message = f"a brake that is lost is repeated after {duration(deadman.repeat.value)}, later than this"
        lookup.report(within.span, Code.BAD_VALUE, message, "allow the time to stop from full speed, such as 2s")
    elif within.value > LONGEST_WITHIN and deadman.because is None:
        message = f"a board that ignores the brake would be reported only after {time}"
        hint = "allow the time to stop from full speed, such as 2s, or add `because: why`"
        lookup.report(within.span, Code.DOUBTFUL_DEADMAN, message, hint)


def _watched(lookup: Lookup, deadman: Deadman, case: Located[str]) -> tuple[str, ...]:
    """Return the endpoints of the deadman that a route takes this case from. Report boards without such a route."""
    table = lookup.table
    routes = [other for other in table.routes if other.case.value == case.value and other.ignore is None]
    sources = {source.value for other in routes for source in other.sources}
    is_broken = f"routes/{case.value}" in table.broken  # then it has a finding already
    endpoints = tuple(to.value for to in deadman.to if {to.value, ANY} & sources)
    boards = [to.value for to in deadman.to if to.value in lookup.boards]
    missing = next((name for name in boards if name not in endpoints), None)
    if missing is None and not endpoints:
        missing = next((to.value for to in deadman.to if to.value in table.endpoints), None)
    if missing is not None and not is_broken:
        message = f"no route takes '{case.value}' from '{missing}', so nothing shows whether it obeys"
        hint = f"write a case that '{missing}' sends, or add it to the sources of a route of '{case.value}'"
        lookup.report(case.span, Code.BAD_VALUE, message, hint)
    return endpoints
