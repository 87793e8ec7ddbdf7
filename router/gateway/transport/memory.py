"""Gives memory of large messages back to the system: the C library keeps it for the process otherwise."""

from __future__ import annotations

import asyncio
import ctypes
import threading

LARGE = 1 << 20
"""Bytes that are worth it."""

TRIM_SECONDS = 1.0
"""From when something large was freed, and between two times."""

_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
"""The GNU C library's. Others keep less."""


class Trimmer:
    """For one thread, and its event loop."""

    def __init__(self) -> None:
        self._due: asyncio.TimerHandle | None = None

    def freed(self, size: int) -> None:
        """`size` bytes are freed, or will be soon."""
        if size >= LARGE and self._due is None:
            self._due = asyncio.get_running_loop().call_later(TRIM_SECONDS, self._give_back)

    def close(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _give_back(self) -> None:
        self._due = None
        if _trim is not None:  # it takes 10 ms for 64 MiB, and needs no interpreter lock
            threading.Thread(target=_trim, args=(0,), name="gateway memory", daemon=True).start()
