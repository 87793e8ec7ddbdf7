"""Checks gateways: their names, their patterns, and by `client_topics` what they let in.

Who else has their addresses is for `network`, who else their topics for `meetings`.
"""

from __future__ import annotations

from collections.abc import Iterator

from router.compiler.checked import CheckedGateway
from router.compiler.client_topics import check_client_topics
from router.compiler.lookup import Lookup
from router.compiler.selection import pattern_problem
from router.errors import Code, Diagnostic
from router.table.model import Gateway, RouteTable


def check_gateways(lookup: Lookup) -> tuple[CheckedGateway, ...]:
    """Those of the table, findings beside them."""
    checked = []
    for gateway in lookup.table.gateways.values():
        lookup.findings += [*_name_findings(lookup.table, gateway), *_pattern_findings(gateway)]
        if gateway.zenoh is not None and gateway.zenoh.config is not None:
            from router.compiler.zenoh_config import config_findings  # the library takes 50 ms to import

            lookup.findings += config_findings(gateway.zenoh.config)
        if gateway.zenoh is not None and lookup.table.networks is not None:
            from router.compiler.zenoh_config import scouting_findings

            lookup.findings += scouting_findings(gateway, lookup.table.networks)
        checked.append(CheckedGateway(gateway, check_client_topics(lookup, gateway)))
    return tuple(checked)


def _name_findings(table: RouteTable, gateway: Gateway) -> Iterator[Diagnostic]:
    """Metrics have listeners, routes and gateways under the same labels, `explain` takes payload cases as well."""
    names = {
        "listener": set(table.listeners),
        "route": {name for route in table.routes for name in (route.name, route.case.value)},
    }
    for kind, taken in names.items():
        if gateway.name in taken:
            message = f"'{gateway.name}' is also the name of a {kind}"
            yield Diagnostic(gateway.span, Code.BAD_VALUE, message, "metrics tell them apart by their names")


def _pattern_findings(gateway: Gateway) -> Iterator[Diagnostic]:
    for pattern in (*gateway.include, *gateway.exclude, *(rate.pattern for rate in gateway.rates)):
        if problem := pattern_problem(pattern):
            yield Diagnostic(pattern.span, Code.BAD_VALUE, problem.what, problem.hint)
