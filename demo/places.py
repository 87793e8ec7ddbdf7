"""What must be free on this computer for the demo: the table's addresses and a ROS domain; or a network namespace."""

from __future__ import annotations

import os
import random
import shutil
import socket
import subprocess

from router.errors import UsageError
from router.table.addresses import Address
from router.table.model import RouteTable
from router.table.model.gateways import Transport
from router.tools.udp import open_udp

DOMAINS = range(1, 102)
"""ROS 2 domains whose ports are below Linux's ephemeral range."""


def taken_places(table: RouteTable) -> list[str]:
    """One line for each address of the table that cannot be bound."""
    wanted = {f"listener {name}": listener.address.value for name, listener in table.listeners.items()}
    wanted |= {f"endpoint {name}": endpoint.address.value for name, endpoint in table.endpoints.items()}
    wanted |= {f"gateway {name}": each.receive.value for name, each in table.gateways.items() if each.receive}
    problems = []
    for purpose, address in wanted.items():
        try:
            open_udp(address, purpose).close()
        except UsageError as error:
            problems.append(str(error))
    listening = {"http": table.http.address} if table.http is not None else {}
    for name, gateway in table.gateways.items():
        if gateway.transport.value is not Transport.UDP and gateway.address is not None:
            listening[f"gateway {name}"] = gateway.address
    for purpose, listens in listening.items():
        if _is_taken(listens.value):
            problems.append(f"{purpose}: another process has TCP port {listens.value}")
    return problems


def _is_taken(address: Address) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as an HTTP server does: only listeners count
        try:
            probe.bind(address)
        except OSError:
            return True
    return False


def free_ros_domain() -> int:
    """A domain that no process on this computer uses: each domain has its own UDP port for discovery."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * domain))
            except OSError:
                continue
            return domain
    raise UsageError("all ROS domains of this computer are in use")


def alone() -> list[str] | None:
    """Prefix that runs a command in a network namespace with loopback only; None if that is not possible."""
    if any(shutil.which(name) is None for name in ("unshare", "ip")):
        return None
    user = ["--map-root-user"] if os.geteuid() else []
    command = ["unshare", "--net", *user, "sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    return command if subprocess.run([*command, "true"], capture_output=True, check=False).returncode == 0 else None
