"""Saves the image of the running program for the head start of the next process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from router.inputs import are_same
from router.log import fault, logger
from router.startup_image import store
from router.threads import DaemonThread

if TYPE_CHECKING:
    from router.image.image import Image
    from router.inputs import Inputs, Plain


class ImageSaver:
    """Saves images, in a thread of its own.

    `selection` are the inputs that selected the table, `read` those of the first program, and `stored` those of the
    image on disk, or None.
    """

    def __init__(self, selection: Inputs, read: Inputs, stored: Plain | None) -> None:
        self.selection = selection
        self.read = read
        self._stored = stored
        self._thread = DaemonThread("image")
        self._has_failed = False

    def save(self, image: Image, read: Inputs) -> None:
        """Start to save the image of the running program, compiled from `read`."""
        try:
            self._thread.submit(self._save, image, read.plain())
        except (RuntimeError, MemoryError) as error:  # no thread can be started
            self._failed(error)

    def _save(self, image: Image, read: Plain) -> None:
        if self._stored is not None and are_same(read, self._stored):
            store.clear_tries()
            return
        try:
            store.write(read, image)
        except OSError as error:
            self._failed(error)
        except Exception as error:  # noqa: BLE001 - a bug, which is logged: the router runs all the same
            fault(error, "prevented it from keeping the compiled program").log()
        else:
            self._stored = read

    def _failed(self, error: Exception) -> None:
        """Log the first failure."""
        if not self._has_failed:
            logger.warning("the compiled program is not kept: the next start takes longer", why=str(error))
        self._has_failed = True
