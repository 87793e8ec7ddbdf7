"""The ROS services of a table, and their types, for tools that call them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from router.compiler.topics import resolved
from router.errors import UsageError, did_you_mean
from router.table.model import RouteTable
from router.types.model import MessageType
from router.types.ros import ros_interfaces


class TableService(NamedTuple):
    """A service of a table: its absolute name, its type, and the most seconds within which it should respond."""

    name: str
    type_name: str
    longest: float


def services_of(table: RouteTable) -> Mapping[str, TableService]:
    """Return the services that the router offers or calls, by each of their names.

    These are the name in the table, the name in ROS, and the latter in full.
    """
    return {name: service for names, service in _services(table) for name in (*names, service.name)}


def _services(table: RouteTable) -> Iterator[tuple[tuple[str, ...], TableService]]:
    for called in table.called.values():
        call = called.call
        name = resolved(call.service.value, table.node)
        yield (call.service.value, called.name), TableService(name, call.type.value, call.timeout.value / 1e9)
    for service in table.services.values():
        longest = service.timeout.value * (1 + service.retries) / 1e9
        yield (service.name,), TableService(resolved(service.name, table.node), service.type.value, longest)


def halves(type_name: str) -> tuple[MessageType, MessageType]:
    """Return the request and the response of a type of services. Raises UsageError, and TableError for a bad file."""
    interfaces = ros_interfaces()
    if (found := interfaces.service(type_name)) is None:
        hint = did_you_mean(type_name, interfaces.services()) or "source the workspace that has it"
        raise UsageError(f"there is no ROS service type '{type_name}'", hint)
    return found
