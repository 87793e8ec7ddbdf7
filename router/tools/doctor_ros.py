"""What the doctor sees of ROS 2: whether it is there, and has every message type as the table was compiled for it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Mapping

from router.compiler.program import Program
from router.errors import StartError
from router.net.kernel import interface_is_up
from router.ros.environment import obstacles, ros_package_remedy, ros_remedy
from router.tools.doctor_report import Finding, fine, problem, warning


def ros(program: Program) -> Iterator[Finding]:
    plans = (*program.publishers, *program.subscriptions)
    if not plans and not program.gateways:
        return
    found = [problem("ROS", what, remedy) for what, remedy in obstacles(os.environ)]
    yield from found
    if found:  # to load it would end this process
        return
    try:
        from router.ros.installation import middleware, usable_class
    except ImportError as error:
        yield problem("ROS", f"the table has topics, and ROS 2 cannot be loaded: {error}", ros_remedy())
        return
    wrong: dict[str, dict[str, str]] = {}
    for plan in plans:
        try:
            usable_class(plan.type_name, plan.definitions)
        except StartError as error:
            wrong.setdefault(plan.type_name.partition("/")[0], {})[plan.type_name] = str(error)
    for package, errors in wrong.items():
        remedy = ros_package_remedy(package)
        what = next(iter(errors.values())).removesuffix(f"; {remedy}")
        more = f"; and {len(errors) - 1} more of its types" if len(errors) > 1 else ""
        yield problem("ROS", f"{what}{more}", remedy)
    if not wrong:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        types = len({plan.type_name for plan in plans})
        yield fine("ROS", f"{middleware()} in domain {domain}, and the {types} message types of the table")


def open_domain(program: Program, variables: Mapping[str, str]) -> Iterator[Finding]:
    """Whether whoever reaches this computer by a network is in the ROS domain without having to look for it."""
    if not (program.publishers or program.subscriptions or program.gateways):
        return
    found_everywhere = variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "") in ("", "SUBNET", "SYSTEM_DEFAULT")
    if variables.get("ROS_DOMAIN_ID", "") not in ("", "0") or not found_everywhere:
        return
    networks = [name for _, name in socket.if_nameindex() if name != "lo" and interface_is_up(name)]
    if networks:
        yield warning(
            "ROS",
            "whoever is in a network of this computer is in the ROS domain, and can publish commands: it is domain 0, "
            f"and nodes are looked for by {', '.join(networks)}",
            "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST where all nodes are on this computer, as the service has it by "
            "itself; else a domain of your own, and docs/security.md",
        )
