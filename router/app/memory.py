"""Returns memory to the system: that of large messages once they are freed, and that of code which is not used."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from mmap import MADV_DONTNEED
from pathlib import Path
from typing import NamedTuple

_MAPS = Path("/proc/self/maps")

_IDLE = ("_protoc_compiler.",)
"""Prefixes of libraries that are used only at reloads."""


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_LARGE = 1 << 20


def return_large_blocks() -> None:
    """Have glibc return blocks of more than 1 MiB to the system when they are freed.

    By default the first such block that is freed raises that limit to its size, up to 32 MiB. Later blocks then come
    from heaps that shrink only at their end, so hundreds of megabytes of large messages would stay after their clients.
    """
    mallopt = ctypes.CDLL(None).mallopt
    for parameter in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
        mallopt(parameter, _LARGE)


class Mapping(NamedTuple):
    """A part of a file that is mapped into memory."""

    start: int
    size: int
    name: str


def drop_idle_code() -> None:
    """Unload idle code from memory. Code that is used again is read from the kernel's page cache."""
    try:
        maps = _MAPS.read_text()
    except OSError:  # it may not be readable; the code then stays
        return
    madvise = ctypes.CDLL(None).madvise
    for start, size, name in read_only(maps):
        if name.startswith(_IDLE):
            madvise(ctypes.c_void_p(start), ctypes.c_size_t(size), MADV_DONTNEED)


def read_only(maps: str) -> Iterator[Mapping]:
    """Yield the mappings that cannot have been modified: code, and the part of a library before it.

    `maps` is the text of /proc/PID/maps. Constants after the code are left out: they include pages that the loader
    has written and then protected.
    """
    for line in maps.splitlines():
        place, permissions, offset, _, _, *path = line.split(maxsplit=5)
        if path and (permissions == "r-xp" or (permissions == "r--p" and int(offset, 16) == 0)):
            start, end = (int(each, 16) for each in place.split("-"))
            yield Mapping(start, end - start, path[0].rpartition("/")[2])
