"""What the doctor sees of the network: who has the router's ports, and which endpoints can be reached."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from time import monotonic

from router.compiler.program import Program
from router.errors import Located
from router.net.kernel import interface_is_up, port_holder
from router.table.addresses import LOCATOR, Address, BadAddressError, parse_address
from router.table.model import Transport, bound_to
from router.tools.doctor_report import Finding, fine, problem, warning

PATIENCE = 1.0
"""Seconds for an answer to a ping; a board answers within milliseconds."""

_ECHO, _ECHO_REPLY = 8, 0
_ICMP = struct.Struct("!BBHHH")

_KEEPS = "systemd"
"""The name of the process that keeps the ports of an installed service."""


def ports(program: Program, *, running: bool, with_listeners: bool = True) -> Iterator[Finding]:
    """Whether the router can have its ports. With a router `running` they are taken, and should be."""
    if running:
        yield fine("ports", "the running router has them")
        return
    wanted: list[tuple[str, Address, str | None, str]] = []
    wanted += [("tcp", found.value, None, what) for found, what in _pages(program) if found is not None]
    gateways = [(protocol, address, None, what) for protocol, address, what in _gateways(program)]
    wanted += gateways
    if with_listeners:
        wanted += [("udp", each.address, each.interface, f"listener '{each.name}'") for each in program.listeners]
    refused = [finding for each in wanted for finding in _port(*each, waits=each in gateways)]
    free = ", ".join(bound_to(address, interface) for _, address, interface, _ in wanted)
    yield from refused or ([fine("ports", f"free: {free}")] if wanted else [])


def interfaces(program: Program) -> Iterator[Finding]:
    """Whether the network interfaces of listeners are there and up."""
    for listener in program.listeners:
        if listener.interface is None:
            continue
        is_up = interface_is_up(listener.interface)
        about = f"listener '{listener.name}': network interface {listener.interface}"
        if is_up is None:
            remedy = "`ip link` lists those there are; a tunnel has to be up before the router starts"
            yield problem("interfaces", f"{about} does not exist", remedy)
        elif is_up:
            yield fine("interfaces", f"{about} is up")
        else:
            yield problem("interfaces", f"{about} is down: nothing comes in", f"ip link set {listener.interface} up")


def _pages(program: Program) -> tuple[tuple[Located[Address] | None, str], ...]:
    return (program.table.metrics, "metrics.address"), (program.table.foxglove, "foxglove.address")


def _gateways(program: Program) -> Iterator[tuple[str, Address, str]]:
    """What gateways bind. Of Zenoh's locators those of tcp; a name or IPv6 in one is not looked at."""
    for gateway in program.table.gateways.values():
        what = f"gateway '{gateway.name}'"
        if gateway.receive is not None:
            yield "udp", gateway.receive.value, what
        if gateway.address is not None and gateway.transport.value in (Transport.TCP, Transport.WEBSOCKET):
            yield "tcp", gateway.address.value, what
        for locator in gateway.zenoh.listen if gateway.zenoh is not None else ():
            if (found := LOCATOR.fullmatch(locator)) and found["protocol"] == "tcp/":
                with suppress(BadAddressError):
                    yield "tcp", parse_address(found["address"]), what


def _port(protocol: str, address: Address, interface: str | None, what: str, waits: bool) -> Iterator[Finding]:
    """`waits`: whether the router waits for an address that no interface has yet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if protocol == "udp" else socket.SOCK_STREAM) as probe:
        if protocol == "tcp":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as a server has it
        try:
            if interface is not None:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
            probe.bind(address)
        except OSError as error:
            if error.errno == errno.ENODEV:  # `interfaces` tells
                return
            yield from _refused(protocol, address, what, error, waits)


def _refused(protocol: str, address: Address, what: str, error: OSError, waits: bool) -> Iterator[Finding]:
    if error.errno == errno.EADDRNOTAVAIL:
        remedy = "give the interface that address (`ip address`), or have the table say 0.0.0.0"
        grade = warning if waits else problem
        yield grade("ports", f"{what}: no interface of this computer has {address.host}", remedy)
        return
    if error.errno != errno.EADDRINUSE:
        yield problem("ports", f"{what} cannot use {address}: {error.strerror}", "choose another port")
        return
    holder = port_holder(protocol, address.port)
    if holder.startswith(_KEEPS):
        yield fine(
            "ports", f"{what}: {holder} keeps {address} for the service; start that: systemctl start rover-router"
        )
        return
    yield problem(
        "ports",
        f"{what}: {holder} has {protocol} port {address.port}",
        "stop it, or choose another port; root is told who it is, and `systemctl status` tells of which service",
    )


def endpoints(program: Program) -> Iterator[Finding]:
    """Whether a network leads to each endpoint, and whether there is somebody."""
    reachable = {}
    for endpoint in program.table.endpoints.values():
        address = endpoint.address.value
        if (why := _no_way(address)) is not None:
            remedy = "does `ip address` show an interface in its network? is the cable in?"
            yield problem("endpoints", f"{endpoint.name}: no network leads to {address.host} ({why})", remedy)
        else:
            reachable[endpoint.name] = address.host
    try:
        answered = answering(set(reachable.values()))
    except PermissionError:
        remedy = "run this as root, or: sysctl -w net.ipv4.ping_group_range='0 2147483647'"
        yield warning("endpoints", "this user may not ping, so nobody knows whether they are there", remedy)
        return
    for name, host in reachable.items():
        if host in answered:
            yield fine("endpoints", f"{name}: {host} answers a ping")
        else:
            remedy = "is it on, and is its cable in? Some boards never answer a ping"
            yield warning("endpoints", f"{name}: {host} does not answer a ping", remedy)


def _no_way(address: Address) -> str | None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)  # sends nothing
        except OSError as error:
            return error.strerror
    return None


def answering(hosts: set[str], patience: float = PATIENCE) -> set[str]:
    """Those of `hosts` that answer a ping in time. Raises PermissionError where this user may not ask."""
    answered: set[str] = set()
    with _open_ping() as pinging:
        request = _request(os.getpid() & 0xFFFF)
        for host in hosts:
            with suppress(OSError):  # no way there after all
                pinging.sendto(request, (host, 0))
        deadline = monotonic() + patience
        while answered != hosts and (left := deadline - monotonic()) > 0:
            pinging.settimeout(left)
            try:
                reply, (host, _) = pinging.recvfrom(1500)
            except OSError:  # a timeout is one
                continue
            if pinging.type == socket.SOCK_RAW:
                reply = reply[(reply[0] & 0xF) * 4 :]  # what follows the IP header
            if reply[:1] == bytes([_ECHO_REPLY]):
                answered.add(host)
    return answered & hosts


def _open_ping() -> socket.socket:
    """Of the kind that everybody may have where the system allows that, else of the kind that root may have."""
    try:
        return socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_ICMP)
    except PermissionError:
        return socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP)


def _request(identity: int) -> bytes:
    """With a checksum, which the kernel puts in anew where the socket is not raw."""
    total = (_ECHO << 8) + identity + 1
    return _ICMP.pack(_ECHO, 0, 0xFFFF - (total % 0xFFFF), identity, 1)
