"""Checks of multicast groups: their network interfaces, the routes to them, and who shares their ports."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from router.compiler.compiled_table import CompiledTable
from router.errors import listed
from router.net.kernel import port_holders
from router.net.multicast import wanted_index
from router.table.model.endpoints import Listener
from router.tools.doctor_checks import CheckResult, fine, warning


def groups(program: CompiledTable) -> Iterator[CheckResult]:
    """Check that the groups of listeners can be joined, and name the programs that have their ports open."""
    for listener in program.listeners:
        for group in listener.group_hosts:
            yield from _joining(listener, group)
        if listener.groups and (holders := port_holders("udp", port := listener.address.value.port)):
            have = "have" if len(holders) > 1 else "has"
            what = f"listener '{listener.name}' shares its port: {listed(holders)} {have} udp port {port} open"
            yield fine("groups", f"{what}; only one of them gets what is sent to an address")


def _joining(listener: Listener, group: str) -> Iterator[CheckResult]:
    about = f"listener '{listener.name}'"
    if (index := wanted_index(group, listener.interface)) is None:
        if listener.interface is None:  # a missing interface is reported for the listener
            remedy = f"run `ip route add {group} dev eth0` with its interface, or write `interface: eth0`"
            yield warning("groups", f"{about} cannot join {group}: no route leads to it", remedy)
        return
    yield fine("groups", f"{about} joins {group} on {socket.if_indextoname(index)}")
