"""Processes on cores of their own, and what /proc tells of processes. Knows nothing of what they do."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import IO, NamedTuple

TICKS = os.sysconf("SC_CLK_TCK")

FIRST = -100


class Cores(NamedTuple):
    """The process under test has one to itself; everything else shares the other."""

    subject: int
    helpers: int


@cache
def cores() -> Cores:
    """Asked for the first time before this process confines itself to one of them."""
    usable = sorted(os.sched_getaffinity(0))
    if len(usable) < 2:
        sys.exit("the benchmark needs two processor cores: one for the process under test, one for all else")
    return Cores(*usable[:2])


def spawn(
    words: Sequence[object],
    core: int,
    priority: int | None = 0,
    environment: Mapping[str, str] | None = None,
    stdin: int | None = subprocess.DEVNULL,
    stdout: int | IO[str] | None = subprocess.DEVNULL,
    stderr: int | IO[str] | None = None,
) -> subprocess.Popen[str]:
    """Starts a program on one core.

    A `priority` below 0 takes a privilege, without which the program runs as any other. None is the lowest there is:
    it runs while nothing else wants to. FIRST is a real-time priority, above that of every process under test.
    """
    prefix = ["taskset", "-c", core]
    if priority is None:
        prefix += ["chrt", "--idle", 0]
    elif priority == FIRST:
        prefix += ["chrt", "--fifo", 10]
    elif priority:
        prefix += ["nice", "-n", priority]
    return subprocess.Popen(
        [*map(str, (*prefix, *words))], text=True, env=environment, stdin=stdin, stdout=stdout, stderr=stderr
    )


def read(path: str | Path) -> str:
    """A file of /proc; empty when its process has ended meanwhile."""
    try:
        return Path(path).read_text()
    except OSError:
        return ""


class Seen(NamedTuple):
    """`cpu` is in seconds, of user and system together."""

    parent: int
    cpu: float


def processes() -> dict[int, Seen]:
    """Everything that runs, by process id."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        if fields := read(path).rpartition(")")[2].split():
            found[int(path.parent.name)] = Seen(int(fields[1]), (int(fields[11]) + int(fields[12])) / TICKS)
    return found


def family(root: int, seen: Mapping[int, Seen]) -> set[int]:
    """A process and its descendants."""
    found = {root}
    while more := {pid for pid, (parent, _) in seen.items() if parent in found} - found:
        found |= more
    return found


def cpu_of_others() -> dict[int, float]:
    """CPU seconds of the processes that are no part of this measurement, by process id."""
    seen = processes()
    ours = family(os.getpid(), seen)
    return {pid: cpu for pid, (_, cpu) in seen.items() if pid not in ours}
