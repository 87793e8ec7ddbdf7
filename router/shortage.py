"""Memory, threads, descriptors or buffers that have run out: not a bug of the router, and perhaps temporary."""

from __future__ import annotations

import errno
import os
import resource

NO_THREAD = "can't start new thread"
"""Python's message when the kernel refuses a thread."""

_NUMBERS = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS})
_TEXTS = tuple(map(os.strerror, _NUMBERS))

ADDRESS_SPACE = 1 << 30
"""Bytes that a router with a few topics maps (it uses a tenth of them); without ROS, a fifth is enough."""


def is_shortage(error: BaseException) -> bool:
    """Return whether the error means that something has run out."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _NUMBERS
    if isinstance(error, (ImportError, OSError)):  # of a library that cannot be loaded
        return str(error).endswith(_TEXTS)
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and str(error) == NO_THREAD)


def address_space() -> int | None:
    """Return how many bytes this process may map (`ulimit -v`), or None if there is no limit."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit
