"""Says which process holds a port, as far as /proc shows it; only for the text of an error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_LISTENING = {"udp": "07", "tcp": "0A"}
"""The state of a socket that waits for anybody, as /proc/net writes it."""


def port_taken(protocol: str, port: int) -> str:
    """Who has it, and what to do about that. `protocol` is udp or tcp."""
    process = _process(protocol, port)
    if process is not None and process.name == str(os.getpid()):
        return f"the router itself (pid {process.name}) has the port; restart it, or choose another port"
    return f"{_shown(process)} has the port; stop it, or choose another port"


def port_holder(protocol: str, port: int) -> str:
    """`python (pid 4711)`, or "another process" where /proc does not tell. `protocol` is udp or tcp."""
    return _shown(_process(protocol, port))


def _shown(process: Path | None) -> str:
    return f"{_name(process)} (pid {process.name})" if process is not None else "another process"


def _process(protocol: str, port: int) -> Path | None:
    wanted = {f"socket:[{inode}]" for inode in _inodes(protocol, port)}
    every = Path("/proc").glob("[0-9]*")
    return next((each for each in every if not wanted.isdisjoint(_open_files(each))), None)


def _inodes(protocol: str, port: int) -> Iterator[str]:
    for table in (Path("/proc/net", protocol), Path("/proc/net", f"{protocol}6")):
        if not table.exists():
            continue
        for line in table.read_text().splitlines()[1:]:
            columns = line.split()
            local, state, inode = columns[1], columns[3], columns[9]
            if state == _LISTENING[protocol] and int(local.rpartition(":")[2], 16) == port:
                yield inode


def _open_files(process: Path) -> Iterator[str]:
    try:
        descriptors = list((process / "fd").iterdir())
    except OSError:  # somebody else's process, or one that has just ended
        return
    for descriptor in descriptors:
        with suppress(OSError):  # closed meanwhile, as the one by which they were listed is
            yield str(descriptor.readlink())


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text().strip()
    except OSError:
        return "a process"
