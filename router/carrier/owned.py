"""Structures that the carrier's library opens and frees."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    import ctypes
    from collections.abc import Callable


class OwnedPointer:
    """A structure of the carrier at `address`, freed with this object. `keep` is kept alive for it.

    `close` is the library function that frees it.
    """

    def __init__(self, close: Callable[[int], None], address: int, keep: object = None) -> None:
        self.address = address
        self._close = close
        self._keep = keep

    def __del__(self) -> None:
        if self.address:
            self._close(self.address)


def open_native(library: ctypes.CDLL, function: str, *arguments: object) -> int:
    """Return the address that a library function returns. Raises MemoryError if it is 0."""
    address = int(getattr(library, function)(*arguments) or 0)
    if not address:
        raise MemoryError(f"{function} failed: no memory or descriptors")
    return address
