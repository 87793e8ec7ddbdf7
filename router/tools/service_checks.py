"""Checks of services in the ROS domain: the servers of those that endpoints call, and others of those of the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from router.compiler.compiled_table import CalledPlan, ClientCallPlan, CompiledTable, ServicePlan
from router.compiler.topics import resolved
from router.errors import StartError, listed, plural
from router.tools.doctor_checks import DISCOVERY_S, CheckResult, Grade, fine, problem, warning

if TYPE_CHECKING:
    from router.ros.graph import Server


def services(program: CompiledTable) -> Iterator[CheckResult]:
    """Check who offers the services of the table. ROS must be usable here, as `ros` checks."""
    called: list[CalledPlan | ClientCallPlan] = [*program.called, *program.client_calls]
    if not program.services and not called:
        return
    from router.ros.graph import look_once, servers
    from router.ros.node import middleware

    if middleware().startswith("rmw_zenoh"):  # which `servers` cannot query
        return
    settings = program.table.node
    names = {plan.name: plan.ros_name for plan in program.services}
    names |= {plan.name: resolved(plan.service, settings) for plan in called}
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
    own = {plan.ros_name for plan in program.services}
    others = [plan for plan in called if names[plan.name] not in own]  # the router, if it runs, serves its own
    results += [result for plan in others for result in _server(plan, names[plan.name], found[plan.name])]
    yield from results
    if all(result.grade is Grade.FINE for result in results):
        offered, with_server = len(program.services), len(others)
        parts = [f"{plural(offered, 'service')} that no other node offers"] if offered else []
        parts += [f"{plural(with_server, 'called service')} with a server"] if with_server else []
        yield fine("services", listed(parts))


def _rivals(plan: ServicePlan, found: Sequence[Server], node: str) -> Iterator[CheckResult]:
    """Yield a warning if another node than the router's offers a service of the table."""
    if others := sorted({server.node for server in found} - {node}):
        what = f"{listed(others)} also {'offers' if len(others) == 1 else 'offer'} the service {plan.ros_name}"
        remedy = "stop it, or give one of them another name: a client gets the response of either"
        yield warning("services", what, remedy)


def _server(plan: CalledPlan | ClientCallPlan, name: str, found: Sequence[Server]) -> Iterator[CheckResult]:
    """Yield a warning if a service that is called has no server, or only those of another type."""
    if not found:
        is_of_board = isinstance(plan, CalledPlan)
        ends, key = ("gets `on_timeout`", "call.service") if is_of_board else ("fails", "service")
        what = f"no server of {name}, which '{plan.name}' calls: every call {ends}"
        yield warning("services", what, f"start its node, or correct `{key}`; `ros2 service list` shows names")
    elif others := sorted({server.type_name for server in found} - {plan.type_name}):
        nodes = sorted({server.node for server in found if server.type_name != plan.type_name})
        what = f"{listed(nodes)} offers {name} as {listed(others)}; '{plan.name}' calls {plan.type_name}"
        yield warning("services", what, "give both the same type: calls of another type get no response")
