"""Checks of the environment before ROS 2 is imported, which could end the process.

A full /dev/shm kills it with SIGBUS, an unknown middleware ends it with exit code 102, a domain above 232 with 1.
"""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from router.assets import asset, is_installed
from router.errors import ConfigurationError, StartError
from router.shortage import ADDRESS_SPACE, address_space

LAST_DOMAIN = 232
"""The highest domain for which DDS has port numbers."""

SHM = Path("/dev/shm")  # noqa: S108 - Linux's shared memory; the router writes nothing there
_NO_NAME = re.compile(r"[0-9.]+|.*[^A-Za-z0-9._-].*|.{254,}", re.DOTALL)
"""A peer that no name server can know: it looks like an address, or no host may be called that."""

_TRACING = 8 << 10
"""Bytes that the tracing library of ROS writes to /dev/shm while it is loaded."""
_FAST_DDS = 1 << 20
"""Bytes in /dev/shm for a participant's segment and ports, 652 KiB in full pages: less silently loses messages."""


def check_environment(environ: Mapping[str, str]) -> None:
    """Raise StartError for a problem that would end the process when ROS is imported or a node is opened."""
    for obstacle in obstacles(environ):
        raise obstacle


def obstacles(environ: Mapping[str, str], shm: Path = SHM) -> Iterator[StartError]:
    """Yield each problem that prevents loading ROS; a ConfigurationError if it does not pass by itself."""
    domain = environ.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("[0-9]{1,9}", domain) or int(domain) > LAST_DOMAIN:
        yield ConfigurationError(f"ROS_DOMAIN_ID is '{domain}'", f"set it to a number from 0 to {LAST_DOMAIN}")
    middleware, installed = environ.get("RMW_IMPLEMENTATION"), _middlewares(environ)
    if middleware and installed and middleware not in installed:
        remedy = f"unset it, or set it to one that is installed: {', '.join(sorted(installed))}"
        yield ConfigurationError(f"RMW_IMPLEMENTATION is '{middleware}', which is not installed here", remedy)
    limit = address_space()
    if limit is not None and limit < ADDRESS_SPACE:
        what = f"this process may map {limit >> 20} MiB of memory (ulimit -v), but ROS 2 needs {ADDRESS_SPACE >> 20}"
        yield StartError(what, "start it with `ulimit -v unlimited`; to limit its memory, use systemd's MemoryMax")
    needed, free = shared_memory(environ, shm)
    if free < needed:
        remedy = "remove unused files there (`fastdds shm clean`), or make it larger"
        if needed > _TRACING:
            remedy += "; with FASTDDS_BUILTIN_TRANSPORTS=UDPv4, ROS needs almost nothing there"
        yield StartError(f"{shm} has {free >> 10} KiB free, but ROS 2 needs {needed >> 10}", remedy)


def unresolved_peers(environ: Mapping[str, str]) -> Iterator[StartError]:
    """Yield the names in ROS_STATIC_PEERS that do not resolve now: with one of them, Fast DDS opens no node."""
    is_ignored = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "OFF" or environ.get("ROS_LOCALHOST_ONLY") == "1"
    if not _is_fast_dds(environ) or is_ignored:
        return
    for peer in filter(None, environ.get("ROS_STATIC_PEERS", "").split(";")):
        try:
            socket.getaddrinfo(peer, None)
        except (OSError, UnicodeError) as error:
            why = error.strerror if isinstance(error, OSError) else str(error)
            kind = ConfigurationError if _NO_NAME.fullmatch(peer) else StartError
            remedy = "correct it, or see that the name server or /etc/hosts knows it"
            yield kind(f"ROS_STATIC_PEERS names '{peer}', which does not resolve: {why}", remedy)


def ros_remedy() -> str:
    """Return the remedy if ROS 2 cannot be loaded."""
    install = "`pip install 'rover-router[ros]'`" if is_installed(asset("schemas")) else "'make setup'"
    return f"run {install}, or source the setup.sh of an installed ROS 2 Jazzy"


def ros_package_remedy(package: str) -> str:
    """Return the remedy if a ROS package is missing, cannot be loaded, or differs from that of the compiled table."""
    from router.types.ros import IGNORED

    ours = asset("schemas")
    source = f"source the workspace that has the ROS package '{package}'"
    if (ours / package / IGNORED).exists():
        return source
    if not is_installed(ours):
        return f"run 'make setup' and `. .venv/env.sh`, or install the ROS package '{package}'"
    if not (ours / package).is_dir():
        return f"{source}, or install it"
    commands = (
        "router init --rover .",
        "export AMENT_PREFIX_PATH=$VIRTUAL_ENV",
        f"colcon build --base-paths schemas/{package}",
        ". install/setup.sh",
    )
    return f"{source}, or build it in an activated environment: `{' && '.join(commands)}`"


def shared_memory(environ: Mapping[str, str], folder: Path = SHM) -> tuple[int, int]:
    """Return the bytes of shared memory that ROS needs in `folder`, and the bytes that are free there."""
    needed = _TRACING + (_FAST_DDS if uses_shared_memory(environ) else 0)
    try:
        room = os.statvfs(folder)
    except OSError:  # ROS works without shared memory
        return 0, 0
    return needed, room.f_bavail * room.f_frsize


def uses_shared_memory(environ: Mapping[str, str]) -> bool:
    """Return whether Fast DDS opens its shared memory transport, which is its default."""
    transports = environ.get("FASTDDS_BUILTIN_TRANSPORTS") or "DEFAULT"
    return _is_fast_dds(environ) and not transports.startswith(("UDP", "TCP", "NONE"))


def _is_fast_dds(environ: Mapping[str, str]) -> bool:
    return (environ.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp").startswith("rmw_fastrtps")


def _middlewares(environ: Mapping[str, str]) -> set[str]:
    """Return the middlewares registered by the sourced workspaces and this Python."""
    prefixes = [*filter(None, environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    folders = [Path(prefix, "share", "ament_index", "resource_index", "rmw_typesupport") for prefix in prefixes]
    return {file.name for folder in folders for file in folder.glob("*")} - {"rmw_implementation"}
