"""Saves the compiled program for the head start of the next process."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import TYPE_CHECKING

from router.compiler.program import Program
from router.kept import store
from router.log import fault, logger
from router.threads import DaemonThread

if TYPE_CHECKING:
    from router.inputs import Inputs, Plain


class Keeper:
    """Saves compiled programs, in a thread of its own.

    `selection` are the inputs that selected the table, `read` the inputs of the first program, and `kept` the inputs of
    the program on disk, or None.
    """

    def __init__(self, library: ctypes.CDLL, selection: Inputs, read: Inputs, kept: Plain | None) -> None:
        self.selection = selection
        self.read = read
        self._library = library
        self._kept = kept
        self._thread = DaemonThread("keep")
        self._has_failed = False

    def keep(self, program: Callable[[], Program | None], read: Inputs) -> None:
        """Start to save the running program, compiled from `read`. `program` returns it with counters of its own."""
        try:
            self._thread.submit(self._keep, program, read.plain())
        except (RuntimeError, MemoryError) as error:  # no thread can be started
            self._failed(error)

    def _keep(self, program: Callable[[], Program | None], read: Plain) -> None:
        if read == self._kept:
            store.clear_tries()
            return
        from router.carrier.image import image_of

        try:
            if (compiled := program()) is not None:
                store.write(read, *image_of(self._library, compiled))
        except OSError as error:
            self._failed(error)
        except Exception as error:  # noqa: BLE001 - a bug, which is logged: the router runs all the same
            fault(error, "prevented it from keeping the compiled program").log()
        else:
            self._kept = read

    def _failed(self, error: Exception) -> None:
        """Log the first failure."""
        if not self._has_failed:
            logger.warning("the compiled program is not kept: the next start takes longer", why=str(error))
        self._has_failed = True
