"""Checks gateways: their names, their patterns, and the topics that their clients publish on.

`network` checks their addresses for clashes, `topics` their topics.
"""

from __future__ import annotations

from collections.abc import Iterator

from router.compiler.compiled_table import ClientCallPlan, DeadmanPlan, GatewayPlan, InboundPlan
from router.compiler.constants import cdr_of
from router.compiler.deadmen import constant_plan, deadman_plan, timing_findings
from router.compiler.lookup import Lookup, definitions_of
from router.compiler.selection import pattern_problem
from router.compiler.services import service_type
from router.compiler.topics import qos_findings, resolved, topic_name_finding
from router.errors import Code, Diagnostic, FindingError
from router.table.model import RouteTable
from router.table.model.gateways import Gateway, GatewayFormat, Inbound, InboundService, Transport
from router.types.model import MessageType


def check_gateways(lookup: Lookup) -> tuple[GatewayPlan, ...]:
    """Check the gateways of the table; findings go to `lookup`."""
    checked = []
    for gateway in lookup.table.gateways.values():
        lookup.findings += [*_name_findings(lookup.table, gateway), *_pattern_findings(gateway)]
        if gateway.zenoh is not None and gateway.zenoh.config is not None:
            from router.compiler.zenoh_config import config_findings  # the library takes 50 ms to import

            lookup.findings += config_findings(gateway.zenoh.config)
        if gateway.zenoh is not None and lookup.table.networks is not None:
            from router.compiler.zenoh_config import scouting_findings

            lookup.findings += scouting_findings(gateway, lookup.table.networks)
        checked.append(GatewayPlan(gateway, _client_topics(lookup, gateway), _client_calls(lookup, gateway)))
    return tuple(checked)


def _name_findings(table: RouteTable, gateway: Gateway) -> Iterator[Diagnostic]:
    """Yield findings for names that a listener or a route also has: metrics and `explain` cannot distinguish them."""
    names = {
        "listener": set(table.listeners),
        "route": {name for route in table.routes for name in (route.name, route.case.value)},
    }
    for kind, taken in names.items():
        if gateway.name in taken:
            message = f"'{gateway.name}' is also the name of a {kind}"
            yield Diagnostic(
                gateway.span, Code.BAD_VALUE, message, "rename one of them: metrics distinguish them by name"
            )


def _pattern_findings(gateway: Gateway) -> Iterator[Diagnostic]:
    for pattern in (*gateway.include, *gateway.exclude, *(rate.pattern for rate in gateway.rates)):
        if problem := pattern_problem(pattern):
            yield Diagnostic(pattern.span, Code.BAD_VALUE, problem.what, problem.hint)


def _client_topics(lookup: Lookup, gateway: Gateway) -> dict[str, InboundPlan]:
    """Return the topics that clients of a gateway may publish on, except those whose types do not exist."""
    plans: dict[str, InboundPlan | None] = {}
    for inbound in gateway.inbound:
        name = resolved(inbound.topic.topic.value, lookup.table.node)
        if name in plans:
            message = f"'{name}' is in 'inbound' twice"
            lookup.report(inbound.topic.topic.span, Code.BAD_VALUE, message, "name it once")
        plans[name] = _inbound(lookup, gateway, inbound, name)
    return {name: plan for name, plan in plans.items() if plan}


def _inbound(lookup: Lookup, gateway: Gateway, inbound: Inbound, name: str) -> InboundPlan | None:
    findings = (topic_name_finding(inbound.topic), *qos_findings(inbound.topic, publishes=True))
    lookup.findings += [finding for finding in findings if finding]
    ros_type = lookup.ros_type(inbound.topic)
    if inbound.deadman is not None:
        lookup.findings += timing_findings(inbound.deadman, inbound.ttl, inbound.topic.max_rate, "messages")
    if ros_type is None:
        return None
    return InboundPlan(inbound, name, ros_type, _deadman(lookup, gateway, inbound, name, ros_type))


_CALL_FORMATS = {Transport.TCP: GatewayFormat.JSON_LINES, Transport.WEBSOCKET: GatewayFormat.JSON}
"""The formats in which clients can call services: a response needs a connection of its own and the caller's `id`."""


def _client_calls(lookup: Lookup, gateway: Gateway) -> dict[str, ClientCallPlan]:
    """Return the services that clients of a gateway may call, except those whose types do not exist."""
    plans: dict[str, ClientCallPlan | None] = {}
    for declared in gateway.calls:
        name = resolved(declared.service.value, lookup.table.node)
        if name in plans:
            lookup.report(declared.service.span, Code.BAD_VALUE, f"'{name}' is in 'inbound' twice", "name it once")
        elif _CALL_FORMATS.get(gateway.transport.value) is not gateway.format:
            what = f"{gateway.format.value} over {gateway.transport.value.value}"
            message = f"clients that read {what} cannot call services"
            hint = "use a gateway with `transport: {websocket: ...}` and 'json', or with tcp and `format: json_lines`"
            lookup.report(declared.service.span, Code.BAD_VALUE, message, hint)
        plans[name] = _client_call(lookup, gateway, declared, name)
    return {name: plan for name, plan in plans.items() if plan}


def _client_call(lookup: Lookup, gateway: Gateway, declared: InboundService, name: str) -> ClientCallPlan | None:
    if (halves := service_type(lookup, declared.type)) is None:
        return None
    request, response = halves
    definitions = definitions_of(request) | definitions_of(response)
    return ClientCallPlan(declared, f"{gateway.name}:{name}", name, request, response, definitions)


def _deadman(
    lookup: Lookup, gateway: Gateway, inbound: Inbound, name: str, ros_type: MessageType
) -> DeadmanPlan | None:
    """Return the deadman of a topic, with the CDR bytes that it publishes; None if there is none, or with a finding."""
    deadman = inbound.deadman
    if deadman is None:
        return None
    plan = constant_plan(lookup, deadman.fields, ros_type, deadman.fields.span, ros_type)
    if plan is None:
        return None
    try:
        message = cdr_of(plan)
    except FindingError as error:
        lookup.findings.append(error.diagnostic)
        return None
    return deadman_plan(f"{gateway.name}:{name}", deadman, [(name, (message,))])
