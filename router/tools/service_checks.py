"""Checks of services in the ROS domain: the servers of those that endpoints call, and others of those of the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from router.compiler.compiled_table import CalledPlan, CompiledTable, ServicePlan
from router.compiler.topics import resolved
from router.errors import StartError, listed, plural
from router.tools.doctor_checks import DISCOVERY_S, CheckResult, Grade, fine, problem, warning

if TYPE_CHECKING:
    from router.ros.graph import Server


def services(program: CompiledTable) -> Iterator[CheckResult]:
    """Check who offers the services of the table. ROS must be usable here, as `ros` checks."""
    if not program.services and not program.called:
        return
    from router.ros.graph import look_once, servers
    from router.ros.node import middleware

    if middleware().startswith("rmw_zenoh"):  # which `servers` cannot query
        return
    settings = program.table.node
    names = {plan.name: plan.ros_name for plan in program.services}
    names |= {plan.name: resolved(plan.service, settings) for plan in program.called}
    try:
        found = look_once(
            "router_doctor",
            DISCOVERY_S,
            lambda node: {name: servers(node, ros_name) for name, ros_name in names.items()},
        )
    except StartError as error:
        yield problem("services", error.what, error.hint)
        return
    ours = resolved(settings.name, settings)
    results = [result for plan in program.services for result in _rivals(plan, found[plan.name], ours)]
    results += [result for plan in program.called for result in _server(plan, names[plan.name], found[plan.name])]
    yield from results
    if all(result.grade is Grade.FINE for result in results):
        offered, called = len(program.services), len(program.called)
        parts = [f"{plural(offered, 'service')} that no other node offers"] if offered else []
        parts += [f"{plural(called, 'called service')} with a server"] if called else []
        yield fine("services", listed(parts))


def _rivals(plan: ServicePlan, found: Sequence[Server], node: str) -> Iterator[CheckResult]:
    """Yield a warning if another node than the router's offers a service of the table."""
    if others := sorted({server.node for server in found} - {node}):
        what = f"{listed(others)} also {'offers' if len(others) == 1 else 'offer'} the service {plan.ros_name}"
        remedy = "stop it, or give one of them another name: a client gets the response of either"
        yield warning("services", what, remedy)


def _server(plan: CalledPlan, name: str, found: Sequence[Server]) -> Iterator[CheckResult]:
    """Yield a warning if a service that an endpoint calls has no server, or only those of another type."""
    if not found:
        what = f"no server of {name}, which '{plan.name}' calls: every call gets `on_timeout`"
        yield warning("services", what, "start its node, or correct `call.service`; `ros2 service list` shows names")
    elif others := sorted({server.type_name for server in found} - {plan.type_name}):
        nodes = sorted({server.node for server in found if server.type_name != plan.type_name})
        what = f"{listed(nodes)} offers {name} as {listed(others)}; '{plan.name}' calls {plan.type_name}"
        yield warning("services", what, "give both the same type: calls of another type get no response")
