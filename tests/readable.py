"""Whether a file descriptor can be read. Without `select`, which takes none above 1023, as long test runs have."""

from __future__ import annotations

import select


def readable(fd: int, timeout: float = 0) -> bool:
    """Wait up to `timeout` seconds."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    return bool(poll.poll(timeout * 1000))
