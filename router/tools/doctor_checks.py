"""Checks of this computer: kernel limits, clock, shared memory, network, ports, ROS 2."""

from __future__ import annotations

import ctypes
import enum
import errno
import os
import pwd
import shutil
import socket
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from datetime import datetime, timezone
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from router.assets import asset
from router.compiler.compiled_table import CalledPlan, ClientCallPlan, CompiledTable, ServicePlan
from router.compiler.extras import missing_extras, missing_modules
from router.errors import Located, StartError, listed, plural, shown_path
from router.hosts import any_of, bracketed, is_ipv6
from router.library import load
from router.net.addresses import family, host_and_port, open_socket, socket_address
from router.net.dds import clashes, discovers_by_multicast
from router.net.kernel import BELOW_ROS, interface_is_up, port_holder
from router.net.ready import readable
from router.net.udp import absence, why_no_way
from router.ros.environment import SHM, obstacles, ros_package_remedy, ros_remedy, unresolved_peers
from router.table.addresses import LOCATOR, Address, BadAddressError, LinkPlace, parse_address
from router.table.model.endpoints import Endpoint, Listener, bound_to
from router.table.model.gateways import Transport


class Grade(enum.Enum):
    FINE = "ok"
    WARNING = "warning"
    PROBLEM = "problem"


class CheckResult(NamedTuple):
    """`about` is a word such as `ports`; `remedy` is empty if nothing has to be done."""

    grade: Grade
    about: str
    text: str
    remedy: str = ""


def fine(about: str, text: str) -> CheckResult:
    return CheckResult(Grade.FINE, about, text)


def warning(about: str, text: str, remedy: str) -> CheckResult:
    """Return a warning: something works less well than it could, or not for everybody."""
    return CheckResult(Grade.WARNING, about, text, remedy)


def problem(about: str, text: str, remedy: str) -> CheckResult:
    """Return a problem: the router does not start, or does not do what the table says."""
    return CheckResult(Grade.PROBLEM, about, text, remedy)


RMEM_MAX = Path("/proc/sys/net/core/rmem_max")

_BUILT = datetime(2025, 1, 1, tzinfo=timezone.utc)
"""A clock that shows an earlier time was never set."""

_TIMEX = struct.Struct("@i4xqqqqi")
"""The beginning of Linux's struct timex: modes, offset, freq, maxerror, esterror, status."""
_TIMEX_BYTES = 256
_UNSYNCHRONISED = 0x40


def receive_buffers(program: CompiledTable) -> Iterator[CheckResult]:
    """Check that the kernel grants the receive buffers of the table."""
    if not program.table.sockets:
        return
    wanted = max(listener.receive_buffer for listener in program.table.sockets)
    try:
        allowed = int(RMEM_MAX.read_text())
    except FileNotFoundError:  # in a container
        what = "the kernel does not show here how large receive buffers may be"
        yield warning("buffers", what, "also run this on the host; the router logs when a buffer is smaller")
        return
    if wanted <= allowed or os.geteuid() == 0:
        yield fine("buffers", f"a listener can have the {wanted} bytes that the table asks for")
        return
    yield warning(
        "buffers",
        f"the table asks for receive buffers of {wanted} bytes, the kernel allows {allowed}: bursts may be dropped",
        f"run `sysctl -w net.core.rmem_max={wanted}`, and to keep it, write it in /etc/sysctl.d/60-rover-router.conf; "
        "the service of `make install-service` does not need it",
    )


LEAST_FREE = 64 << 20
"""Bytes: more than the recording of a stop takes at 5,000 datagrams per second."""


def recordings(program: CompiledTable, *, running: bool) -> Iterator[CheckResult]:
    """Check that the directory is writable and has room for what the table keeps.

    A `running` router may have another user, and reports itself what it cannot write.
    """
    settings = program.table.record
    if settings is None or missing_modules("recording"):  # which `extras` reports
        return
    if os.path.islink(settings.directory) and not os.path.exists(settings.directory):  # noqa: PTH110, PTH114 - as below
        what = f"{settings.directory} is a link that leads nowhere"
        yield problem("recordings", what, "mount its disk, or correct the link")
        return
    directory = settings.directory.resolve()
    # os.path, since Path.exists raises if a folder above is not readable.
    there = next(folder for folder in (directory, *directory.parents) if os.path.exists(folder))  # noqa: PTH110
    if not there.is_dir():
        remedy = "move that file away, or give `record` another directory"
        yield problem("recordings", f"{there} is a file, not a folder", remedy)
        return
    if os.statvfs(there).f_flag & os.ST_RDONLY:
        remedy = "`dmesg` says why; `mount -o remount,rw` undoes it; or give `record` another directory"
        grade = problem if running else warning  # it prevents no start
        yield grade("recordings", f"the disk with {there} is mounted read-only", remedy)
        return
    if not os.access(there, os.R_OK | os.W_OK | os.X_OK):
        what = f"{_user(os.geteuid())} may not write to {there}"
        if running:
            yield fine("recordings", f"{what}; the running router reports what it cannot write")
            return
        yield problem(
            "recordings",
            what,
            "chown it, or give `record` another directory; for a service, then run deploy/install-service.sh again",
        )
        return
    from router.recording.writer import recording_sizes  # of an extra

    kept = sum(recording_sizes(directory, program.table.path.stem).values())
    free = shutil.disk_usage(there).free
    if settings.continuous and kept + free < settings.retention:
        yield warning(
            "recordings",
            f"the disk with {directory} has room for {(kept + free) >> 20} MiB, "
            f"`retention` is {settings.retention >> 20} MiB",
            "reduce `retention`: then the oldest files are deleted before the disk is full",
        )
    elif free < LEAST_FREE:
        what = f"the disk with {directory} has {free >> 20} MiB free: the recording of a stop may not fit"
        yield warning("recordings", what, "free space, or give `record` another directory")
    else:
        yield fine("recordings", f"{directory}, with {free >> 20} MiB free")


def clock(now: datetime | None = None, status: int | None = None) -> Iterator[CheckResult]:
    """Check that the clock is synchronised, as `ttl` requires. Tests pass the arguments."""
    now = now or datetime.now(timezone.utc)
    status = _clock_status() if status is None else status
    if now < _BUILT:
        yield problem(
            "clock", f"it says {now.astimezone():%Y-%m-%d %H:%M %z}", "set it: `timedatectl set-ntp true`, or `date -s`"
        )
    elif status is None:
        yield warning("clock", "the kernel does not say whether it is synchronised", "run `timedatectl`")
    elif status & _UNSYNCHRONISED:
        yield warning(
            "clock",
            "it is not synchronised: messages of other computers may seem stale, and `ttl` then drops them",
            "install chrony on all computers of the rover, with one as the others' server; check with `timedatectl`",
        )
    else:
        yield fine("clock", "synchronised")


def _clock_status() -> int | None:
    """Return the status bits of adjtimex; None if not permitted."""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    if ctypes.CDLL(None).adjtimex(timex) < 0:
        return None
    return int(_TIMEX.unpack_from(timex)[-1])


def shared_memory(variables: Mapping[str, str], folder: Path = SHM) -> Iterator[CheckResult]:
    """Warn if several users run nodes: Fast DDS's shared memory silently loses messages between them."""
    segments = [segment for segment in folder.glob("fastrtps_port*") if not segment.name.endswith("_el")]
    owners = {owner for owner in map(_owner, segments) if owner is not None}
    if len(owners) > 1 or (owners - {os.geteuid()} and variables.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4"):
        yield warning(
            "ROS",
            f"nodes of {' and '.join(sorted(map(_user, owners)))} share memory here: Fast DDS silently loses "
            "messages between nodes of different users",
            "run all nodes as one user, or with FASTDDS_BUILTIN_TRANSPORTS=UDPv4 in their environment, as the service "
            "of the router does; `fastdds shm clean` removes the files of nodes that have exited",
        )


def _owner(segment: Path) -> int | None:
    """Return the user ID of a file's owner; None if the node that had the file has just exited."""
    try:
        return segment.stat().st_uid
    except FileNotFoundError:
        return None


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"


PATIENCE = 1.0
"""Seconds for an answer to a ping; a board answers within milliseconds."""

_ECHO, _ECHO_REPLY = 8, 0
_ECHO_IPV6, _ECHO_REPLY_IPV6 = 128, 129
_ICMP = struct.Struct("!BBHHH")

_KEEPS = "systemd"
"""The process that holds the ports of an installed service."""


def ports(program: CompiledTable, *, running: bool, with_listeners: bool = True) -> Iterator[CheckResult]:
    """Check that the router can bind its ports, unless it is `running` already."""
    if running:
        yield fine("ports", "the running router has them")
        return
    wanted: list[tuple[str, Address, str | None, str, bool]] = []
    wanted += [("tcp", address.value, None, what, True) for address, what in _pages(program) if address is not None]
    gateways = [(protocol, address, None, what, protocol == "tcp") for protocol, address, what in _gateways(program)]
    wanted += gateways
    wanted += [
        ("tcp", Address(*listener.address.value), None, f"listener '{listener.name}'", True)
        for listener in program.table.links
        if listener.accepts
    ]
    there = [listener for listener in program.table.sockets if _absence(listener) is None] if with_listeners else []
    wanted += [
        ("udp", listener.address.value, listener.interface, f"listener '{listener.name}'", bool(listener.groups))
        for listener in there
    ]
    refused = [finding for port in wanted for finding in _port(*port, waits=port in gateways)]
    free = ", ".join(bound_to(address, interface) for _, address, interface, *_ in wanted)
    yield from refused or ([fine("ports", f"free: {free}")] if wanted else [])


def listeners(program: CompiledTable) -> Iterator[CheckResult]:
    """Check that the addresses of listeners, and the network interfaces that they name, are there and up."""
    for listener in program.table.sockets:
        about = f"listener '{listener.name}'"
        if (absent := _absence(listener)) is not None:
            why, remedy = absent
            remedy += "; the router waits for it, for example for a tunnel to come up"
            yield warning("listeners", f"{about} cannot use {listener.bound_to}: {why}", remedy)
        elif listener.interface is not None and interface_is_up(listener.interface):
            yield fine("listeners", f"{about}: network interface {listener.interface} is up")
        elif listener.interface is not None:
            what = f"{about}: network interface {listener.interface} is down: the listener receives nothing"
            yield warning("listeners", what, f"run `ip link set {listener.interface} up`")


def ros_ports(program: CompiledTable, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Check that no listener or gateway has a UDP port that ROS uses."""
    uses_ros = program.uses_ros
    for clash in clashes(program, variables):
        grade = problem if clash.blinds and uses_ros and discovers_by_multicast(variables) else warning
        yield grade("ports", str(clash), BELOW_ROS)


def _absence(listener: Listener) -> tuple[str, str] | None:
    return absence(listener.address.value._replace(port=0), listener.interface)  # even if the port is in use


def _pages(program: CompiledTable) -> tuple[tuple[Located[Address] | None, str], ...]:
    servers = ("http", program.table.http), ("foxglove", program.table.foxglove)
    return tuple((server.address if server else None, f"{key}.address") for key, server in servers)


def _gateways(program: CompiledTable) -> Iterator[tuple[str, Address, str]]:
    """Yield what gateways bind: (protocol, address, owner). Of Zenoh's locators, only TCP ones with an IP address."""
    for gateway in program.table.gateways.values():
        what = f"gateway '{gateway.name}'"
        if gateway.receive is not None:
            yield "udp", gateway.receive.value, what
        if gateway.address is not None and gateway.transport.value in (Transport.TCP, Transport.WEBSOCKET):
            yield "tcp", gateway.address.value, what
        for locator in gateway.zenoh.listen if gateway.zenoh is not None else ():
            if (match := LOCATOR.fullmatch(locator)) and match["protocol"] == "tcp/":
                with suppress(BadAddressError):
                    yield "tcp", parse_address(match["address"]), what


def _port(
    protocol: str, address: Address, interface: str | None, what: str, is_shared: bool, waits: bool
) -> Iterator[CheckResult]:
    """Check that an address can be bound.

    `is_shared`: with SO_REUSEADDR, as by servers and listeners with groups. `waits`: the router waits for an address
    that no interface has yet.
    """
    kind = socket.SOCK_DGRAM if protocol == "udp" else socket.SOCK_STREAM
    with open_socket(address.host, kind) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, is_shared)
        try:
            if interface is not None:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
            probe.bind(socket_address(*address))
        except OSError as error:
            yield from _refused(protocol, address, what, error, waits)


def _refused(protocol: str, address: Address, what: str, error: OSError, waits: bool) -> Iterator[CheckResult]:
    if error.errno in (errno.EADDRNOTAVAIL, errno.ENODEV):
        wildcard = bracketed(any_of(address.host))
        remedy = f"give an interface that address (`ip address`), or write {wildcard} in the table"
        grade = warning if waits else problem
        yield grade("ports", f"{what}: no interface of this computer has {address.host}", remedy)
        return
    if error.errno != errno.EADDRINUSE:
        yield problem("ports", f"{what} cannot use {address}: {error.strerror}", "choose another port")
        return
    holder = port_holder(protocol, address.port)
    if holder.startswith(_KEEPS):
        yield fine(
            "ports", f"{what}: {holder} keeps {address} for the service; start it: `systemctl start rover-router`"
        )
        return
    yield problem(
        "ports",
        f"{what}: {holder} has {protocol} port {address.port}",
        "stop it unless it is the router of this table, or choose another port; run as root to see which process, and "
        "`systemctl status PID` for its service",
    )


def ways(program: CompiledTable, grade: Callable[[str, str, str], CheckResult]) -> Iterator[CheckResult]:
    """Check that an IP route leads to each endpoint. `grade` makes the result if none does."""
    for endpoint in _on_udp(program):
        address = endpoint.address.value
        if not address.is_known:
            continue
        try:
            unreachable = why_no_way(endpoint)
        except BadAddressError as error:
            yield problem("endpoints", f"{endpoint.name}: {error.what}", error.hint)
            continue
        if unreachable:
            why, remedy = unreachable
            yield grade("endpoints", f"{endpoint.name}: nothing can be sent to {address.host}: {why}", remedy)


def endpoints(program: CompiledTable, in_place_of: Mapping[str, str]) -> Iterator[CheckResult]:
    """Check that an IP route leads to each endpoint, and that it answers a ping.

    `in_place_of`: by endpoint, another host that sends its payloads.
    """
    yield from ways(program, problem)
    known = _on_udp(program)
    one = [endpoint for endpoint in known if endpoint.is_one_machine and _has_way(endpoint)]
    reachable = {endpoint.name: endpoint.address.value.host for endpoint in one}
    try:
        answered = answering(set(reachable.values()))
    except PermissionError:
        remedy = "run this as root, or run `sysctl -w net.ipv4.ping_group_range='0 2147483647'`"
        yield warning("endpoints", "this user may not ping, so it is unknown whether endpoints are up", remedy)
        return
    for name, host in reachable.items():
        if host in answered:
            yield fine("endpoints", f"{name}: {host} answers a ping")
        elif name in in_place_of:
            what = f"{name}: {host} does not answer a ping, but {in_place_of[name]} sends its payloads"
            yield warning("endpoints", what, "check its address in the table; see `router` below")
        else:
            remedy = "check that it is on and connected; some boards never answer a ping"
            yield warning("endpoints", f"{name}: {host} does not answer a ping", remedy)


def _on_udp(program: CompiledTable) -> list[Endpoint]:
    """Return the endpoints that have an address."""
    endpoints = program.table.endpoints.values()
    return [endpoint for endpoint in endpoints if not isinstance(endpoint.address.value, LinkPlace)]


def _has_way(endpoint: Endpoint) -> bool:
    try:
        return endpoint.address.value.is_known and why_no_way(endpoint) is None
    except BadAddressError:
        return False


def answering(hosts: set[str], patience: float = PATIENCE) -> set[str]:
    """Return the `hosts` that answer a ping in time. Raises PermissionError if this user may not ping."""
    answered: set[str] = set()
    with ExitStack() as opened:
        pinging = {each: opened.enter_context(_open_ping(each)) for each in sorted({*map(family, hosts)})}
        for host in hosts:
            with suppress(OSError):  # unreachable
                pinging[family(host)].sendto(_request(host), socket_address(host, 0))
        deadline = monotonic() + patience
        while answered != hosts and (left := deadline - monotonic()) > 0:
            for each in readable(pinging.values(), left):
                with suppress(OSError):  # such as an ICMP error
                    answered |= _answerer(each)
    return answered & hosts


def _open_ping(of: socket.AddressFamily) -> socket.socket:
    """Open an unprivileged ICMP socket if the system allows it, else a raw one."""
    protocol = socket.IPPROTO_ICMPV6 if of == socket.AF_INET6 else socket.IPPROTO_ICMP
    try:
        return socket.socket(of, socket.SOCK_DGRAM, protocol)
    except PermissionError:
        return socket.socket(of, socket.SOCK_RAW, protocol)


def _request(host: str) -> bytes:
    """Return an echo request. It has the checksum that raw IPv4 sockets need; the kernel adds that of IPv6."""
    kind, identity = _ECHO_IPV6 if is_ipv6(host) else _ECHO, os.getpid() & 0xFFFF
    total = (kind << 8) + identity + 1
    return _ICMP.pack(kind, 0, 0xFFFF - (total % 0xFFFF), identity, 1)


def _answerer(pinging: socket.socket) -> set[str]:
    """Return the host that has answered a ping; none if something else has arrived. Raises OSError."""
    reply, address = pinging.recvfrom(1500)
    host, _ = host_and_port(address)
    if pinging.type == socket.SOCK_RAW and not is_ipv6(host):
        reply = reply[(reply[0] & 0xF) * 4 :]  # what follows the IP header
    return {host} if reply[:1] == bytes([_ECHO_REPLY_IPV6 if is_ipv6(host) else _ECHO_REPLY]) else set()


def extras(program: CompiledTable) -> Iterator[CheckResult]:
    for missing in missing_extras(program.table):
        yield problem("Python", missing.what, missing.hint)


def ros(program: CompiledTable) -> Iterator[CheckResult]:
    if not program.uses_ros:
        return
    plans = (*program.publishers, *program.subscriptions)
    services: tuple[ServicePlan | CalledPlan | ClientCallPlan, ...]
    services = (*program.services, *program.called, *program.client_calls)
    problems = [problem("ROS", obstacle.what, obstacle.hint) for obstacle in obstacles(os.environ)]
    yield from problems
    if problems:  # loading it would end this process
        return
    try:
        from router.ros.node import middleware
        from router.ros.types import usable_class, usable_service
    except ImportError as error:
        yield problem("ROS", f"the table needs ROS 2, which cannot be loaded: {error}", ros_remedy())
        return
    wrong: dict[str, dict[str, StartError]] = {}
    used = [(usable_class, plan.type_name, plan.definitions) for plan in plans]
    used += [(usable_service, plan.type_name, plan.definitions) for plan in services]
    for load_type, name, definitions in used:
        try:
            load_type(name, definitions)
        except StartError as error:
            wrong.setdefault(name.partition("/")[0], {})[name] = error
    for package, errors in wrong.items():
        first = next(iter(errors.values()))
        more = f"; and {len(errors) - 1} more of its types" if len(errors) > 1 else ""
        yield problem("ROS", f"{first.what}{more}", first.hint or ros_package_remedy(package))
    unresolved = list(unresolved_peers(os.environ))
    yield from (problem("ROS", peer.what, peer.hint) for peer in unresolved)
    if not wrong and not unresolved:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        types = [plural(len({plan.type_name for plan in plans}), "message type")]
        if services:
            types.append(plural(len({plan.type_name for plan in services}), "service type"))
        yield fine("ROS", f"{middleware()} in domain {domain}, and {listed(types)} of the table")


DISCOVERY_S = 2.0
"""Seconds for the discovery of nodes, which rarely takes longer."""


def ros_peers(program: CompiledTable) -> Iterator[CheckResult]:
    """Warn of what a router would meet in the ROS domain: another router, and peers of another type."""
    if not program.uses_ros:
        return
    from router.ros.graph import Ours, look, look_once

    try:
        others = look_once("router_doctor", DISCOVERY_S, lambda node: look(node, Ours.of(program)))
    except StartError as error:
        yield problem("ROS", error.what, error.hint)
        return
    which = "another"
    remedy = "do not start this one beside it: it would brake the rover at its start, and send commands twice"
    if program.table.http is None:  # nothing tells whether that router runs this table
        which, remedy = (
            "a",
            f"if it runs this table, add an `http.address`, so that doctor can ask it; if not, {remedy}",
        )
    for router in sorted({shared.router for shared in others.shared}):
        theirs = sorted(shared for shared in others.shared if shared.router == router)
        topics = [shared.name for shared in theirs if not shared.is_node]
        whats = ["has the name of its node"] if any(shared.is_node for shared in theirs) else []
        if topics:
            whats.append(f"takes messages from {listed(topics)}")
        what = f"{which} router runs, process {router.process} on {router.host}: it {listed(whats)}"
        yield warning("ROS", what, remedy)
    if others.namesakes:
        name = program.table.node.name
        yield warning("ROS", f"another node is called {name}", "stop it, or give one of them another name")
    for peer in others.mistyped:
        remedy = f"give that {peer.peer} the table's type, or stop it; `ros2 topic info -v {peer.topic}` names its node"
        yield warning("ROS", str(peer), remedy)


def carrier() -> Iterator[CheckResult]:
    """Check the carrier's library, which receives, forwards, publishes and brakes."""
    try:
        load()
    except StartError as error:
        yield problem("carrier", error.what, error.hint)
    else:
        yield fine("carrier", "its library is up to date")
        yield from _priority()


def _priority() -> Iterator[CheckResult]:
    """Check that the carrier's threads may run at the lowest real-time priority."""
    policy = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        yield warning(
            "carrier",
            "it may not run at a real-time priority: other programs can delay commands and brakes by about 0.5 ms",
            f"write '{_user(os.geteuid())} - rtprio 1' in /etc/security/limits.d/60-rover-router.conf, and log in "
            "again (a container needs deploy/container/realtime.yaml; the service of `make install-service` does not)",
        )
    else:
        os.sched_setscheduler(0, policy, os.sched_param(0))
        yield fine("carrier", "it may run at a real-time priority")


def page(name: str) -> str:
    """Return the path of a page of the documentation on this computer, and its section: `docs/index.md#tools`."""
    path, mark, section = name.partition("#")
    return f"{shown_path(asset(path))}{mark}{section}"


def open_domain(program: CompiledTable, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Warn if the ROS domain is open to the networks of this computer."""
    if not program.uses_ros:
        return
    if variables.get("ROS_DOMAIN_ID", "") not in ("", "0") or not discovers_by_multicast(variables):
        return
    networks = [name for _, name in socket.if_nameindex() if name != "lo" and interface_is_up(name)]
    if networks:
        yield warning(
            "ROS",
            "every computer in this computer's networks can join the ROS domain and publish commands: it is domain 0, "
            f"with discovery on {', '.join(networks)}",
            "set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST if all nodes are on this computer, as the service does; else "
            f"use a domain of your own, and read {page('docs/guides/security.md')}",
        )
