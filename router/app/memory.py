"""Code that a running router does not use, and that need not be in its memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from mmap import MADV_DONTNEED
from pathlib import Path
from typing import NamedTuple

_MAPS = Path("/proc/self/maps")

_IDLE = ("_protoc_compiler.", "_foxglove_py.")
"""How the names of libraries begin that a router uses at reloads only, or once a client has come: 14 MB together."""


class Mapping(NamedTuple):
    """A part of a file that is mapped into memory."""

    start: int
    size: int
    name: str


def drop_idle_code() -> None:
    """Take code that is idle out of this process. What is used again comes from the kernel's cache of the file."""
    try:
        maps = _MAPS.read_text()
    except OSError:  # it may not be readable; the code then stays
        return
    madvise = ctypes.CDLL(None).madvise
    for start, size, name in read_only(maps):
        if name.startswith(_IDLE):
            madvise(ctypes.c_void_p(start), ctypes.c_size_t(size), MADV_DONTNEED)


def read_only(maps: str) -> Iterator[Mapping]:
    """The mappings that nobody can have written to: code, and what precedes it in a library.

    `maps` is the text of /proc/PID/maps. Constants behind the code are left out, which include what the loader has
    written to and protected afterwards.
    """
    for line in maps.splitlines():
        place, permissions, offset, _, _, *path = line.split(maxsplit=5)
        if path and (permissions == "r-xp" or (permissions == "r--p" and int(offset, 16) == 0)):
            start, end = (int(each, 16) for each in place.split("-"))
            yield Mapping(start, end - start, path[0].rpartition("/")[2])
