"""Whether a file descriptor can be read. Without `select`, which takes none above 1023, as long test runs have."""

from __future__ import annotations

import select


def readable(fd: int, timeout: float = 0) -> bool:
    """Wait up to `timeout` seconds; not at all if it is negative, as what is left until a limit may be."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(max(0.0, timeout) * 1000))
