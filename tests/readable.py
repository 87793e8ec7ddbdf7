"""Whether a file descriptor is readable, without `select`: long test runs have descriptors above its limit of 1023."""

from __future__ import annotations

import select


def readable(fd: int, timeout: float = 0) -> bool:
    """Wait up to `timeout` seconds. A negative timeout, for example a limit that has passed, does not wait."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(max(0.0, timeout) * 1000))
