"""Checks routes against what exists: every name resolved, every mapping typed, all findings collected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from router.compiler.checked import CheckedRoute
from router.compiler.deadmen import check_deadman
from router.compiler.inbound import check_inbound
from router.compiler.lookup import Lookup
from router.compiler.outbound import check_outbound
from router.compiler.topics import qos_findings, topic_name_finding
from router.errors import Code, Diagnostic, nearest
from router.table.model import ANY, ROS, Route

_OF_GAPS = frozenset({Code.NO_TARGET, Code.NOTHING_MAPPED, Code.QOS_CONFLICT, Code.NO_DEADMAN})
"""What a route may seem to do wrong because a part of it, which has a finding of its own, was left out."""


@dataclass(slots=True)
class RouteChecker:
    """Checks the routes of one table; findings fill up `lookup`, what several routes share once for each of them."""

    lookup: Lookup

    def check_all(self) -> tuple[CheckedRoute, ...]:
        self._coverage()
        return tuple(checked for route in self.lookup.table.routes if (checked := self._checked(route)))

    def _coverage(self) -> None:
        table, cases = self.lookup.table, self.lookup.envelope.cases
        names = [route.case.value for route in table.routes]
        # a misspelt case is one finding, not two
        covered = {name if name in cases else nearest(name, cases) for name in names}
        covered |= {name.removeprefix("routes/") for name in table.broken if name.startswith("routes/")}
        missing = [name for name in cases if name not in covered]
        if missing and table.routes_span is not None:  # a table of gateways has no routes for any
            plural = "payload case" if len(missing) == 1 else "payload cases"
            message = f"no route for the {plural} {', '.join(missing)}"
            hint = "route it, or say `ignore: reason`"
            self.lookup.report(table.routes_span, Code.UNCOVERED_PAYLOAD_CASE, message, hint)

    def _checked(self, route: Route) -> CheckedRoute | None:
        findings = self.lookup.findings
        before = len(findings)
        checked = self._route(route)
        if f"routes/{route.case.value}" in self.lookup.table.broken:
            findings[before:] = [finding for finding in findings[before:] if finding.code not in _OF_GAPS]
        return checked

    def _route(self, route: Route) -> CheckedRoute | None:
        case = self.lookup.case(route.case)
        if case is None:
            return None
        if route.ignore is not None:
            return CheckedRoute(route, case)
        self._sources(route)
        if not route.destinations and not route.topics:
            message, hint = f"'{route.name}' goes nowhere", "name destinations or topics, or say `ignore: reason`"
            self.lookup.report(route.span, Code.NO_TARGET, message, hint)
        for topic in route.topics:
            found = (topic_name_finding(topic), *qos_findings(topic, publishes=not route.is_outbound))
            self.lookup.findings += [finding for finding in found if finding]
        checked = (check_outbound if route.is_outbound else check_inbound)(self.lookup, route, case)
        return replace(checked, deadman=check_deadman(self.lookup, route))

    def _sources(self, route: Route) -> None:
        for source in route.sources:
            if source.value not in (ANY, ROS):
                self.lookup.endpoint(source, (ANY, ROS))
            elif len(route.sources) > 1:
                message, hint = f"'{source.value}' stands alone", "name endpoints, or it, not both"
                self.lookup.report(source.span, Code.BAD_VALUE, message, hint)


def sorted_findings(findings: Sequence[Diagnostic]) -> list[Diagnostic]:
    """Each once, in the order in which a person reads the files."""
    return sorted(dict.fromkeys(findings), key=lambda finding: (finding.span, finding.code.value, finding.message))
