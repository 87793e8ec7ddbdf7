"""What the doctor sees of this computer: limits of the kernel, clock, shared memory. Knows no network and no ROS."""

from __future__ import annotations

import ctypes
import os
import pwd
import shutil
import struct
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path

from router.compiler.program import Program
from router.recording.writer import recording_sizes
from router.ros.environment import SHM
from router.tools.doctor_report import Finding, fine, problem, warning

RMEM_MAX = Path("/proc/sys/net/core/rmem_max")

_BUILT = datetime(2025, 1, 1, tzinfo=timezone.utc)
"""A clock that says less was never set."""

_TIMEX = struct.Struct("@i4xqqqqi")
"""The beginning of Linux's struct timex: modes, offset, freq, maxerror, esterror, status."""
_TIMEX_BYTES = 256
_UNSYNCHRONISED = 0x40


def receive_buffers(program: Program) -> Iterator[Finding]:
    """Whether a burst has the room that the table wants for it."""
    if not program.listeners:
        return
    wanted = max(listener.receive_buffer for listener in program.listeners)
    try:
        allowed = int(RMEM_MAX.read_text())
    except FileNotFoundError:  # in a container with a network of its own
        what = "the kernel does not say here how large receive buffers may be"
        yield warning("buffers", what, "run this on the host as well; the router's log says when it got less")
        return
    if wanted <= allowed or os.geteuid() == 0:
        yield fine("buffers", f"a listener may have the {wanted} bytes that the table asks for")
        return
    yield warning(
        "buffers",
        f"the table asks for receive buffers of {wanted} bytes, the kernel allows {allowed}: bursts may be dropped",
        f"sysctl -w net.core.rmem_max={wanted}, and for good in /etc/sysctl.d/60-rover-router.conf; the service of "
        "`make install-service` need not be told",
    )


def recordings(program: Program) -> Iterator[Finding]:
    """Whether there is a place for them, and room for as many as the table keeps."""
    settings = program.table.record
    if settings is None:
        return
    directory = settings.directory.resolve()
    # os.path, since Path.exists raises where a folder above is not ours to read.
    there = next(folder for folder in (directory, *directory.parents) if os.path.exists(folder))  # noqa: PTH110
    if not there.is_dir():
        remedy = "move that file away, or give `record` another directory"
        yield problem("recordings", f"{there} is a file, and no folder", remedy)
        return
    if not os.access(there, os.R_OK | os.W_OK | os.X_OK):
        yield problem(
            "recordings",
            f"{_user(os.geteuid())} may not write to {there}",
            "chown it, or give `record` another directory; for a service, run deploy/install-service.sh again then",
        )
        return
    kept = sum(recording_sizes(directory, program.table.path.stem).values())
    free = shutil.disk_usage(there).free
    if settings.continuous and kept + free < settings.keep:
        yield warning(
            "recordings",
            f"the disk with {directory} has room for {(kept + free) >> 20} MiB, `keep` says {settings.keep >> 20}",
            "a smaller `keep`: the oldest files go before the disk is full",
        )
    else:
        yield fine("recordings", f"{directory}, with {free >> 20} MiB free")


def clock(now: datetime | None = None, status: int | None = None) -> Iterator[Finding]:
    """`ttl` compares stamps of computers, so their clocks have to agree. Other arguments than none are for tests."""
    now = now or datetime.now(timezone.utc)
    status = _clock_status() if status is None else status
    if now < _BUILT:
        yield problem("clock", f"it says {now:%Y-%m-%d %H:%M}", "set it: `timedatectl set-ntp true`, or `date -s`")
    elif status is None:
        yield warning("clock", "the kernel does not say whether it is synchronised", "look at `timedatectl`")
    elif status & _UNSYNCHRONISED:
        yield warning(
            "clock",
            "nothing synchronises it: messages of other computers may seem stale, and `ttl` then drops them",
            "install chrony on all computers of the rover, with one of them as the others' server; `timedatectl`",
        )
    else:
        yield fine("clock", "synchronised")


def _clock_status() -> int | None:
    """The status bits of adjtimex; None where it may not be asked."""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    if ctypes.CDLL(None).adjtimex(timex) < 0:
        return None
    return int(_TIMEX.unpack_from(timex)[-1])


def shared_memory(variables: Mapping[str, str], folder: Path = SHM) -> Iterator[Finding]:
    """Fast DDS shares memory with processes of its own user only, and tells nobody of what it could not hand over."""
    owners = {each.stat().st_uid for each in folder.glob("fastrtps_port*") if not each.name.endswith("_el")}
    if len(owners) > 1 or (owners - {os.geteuid()} and variables.get("FASTDDS_BUILTIN_TRANSPORTS") != "UDPv4"):
        yield warning(
            "ROS",
            f"nodes of {' and '.join(sorted(map(_user, owners)))} share memory here: Fast DDS loses what goes from one "
            "user's node to another's, without a word",
            "run all nodes as one user, or with FASTDDS_BUILTIN_TRANSPORTS=UDPv4 in their environment, as the service "
            "of the router has it; `fastdds shm clean` removes what ended nodes have left",
        )


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"
