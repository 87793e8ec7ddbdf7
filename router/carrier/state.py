"""The state that a program keeps between messages and passes on to the next program."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    import ctypes
    from collections.abc import Callable, Hashable
    from typing import TypeVar

    T = TypeVar("T")
    Place = tuple[str | None, ...]


class State:
    """The state of a program, by key; survives a reload.

    Objects with the same key are taken from the state of the `previous` program: then both programs use the same
    object, whichever of them runs. A key must therefore contain everything that its object depends on.

    The first program takes objects that a head start has opened, by place.
    """

    def __init__(
        self, library: ctypes.CDLL, previous: State | None = None, *, opened: dict[Place, int] | None = None
    ) -> None:
        self._library = library
        self._opened = {} if opened is None else opened
        self._previous: dict[Hashable, object] = previous._kept if previous else {}
        self._kept: dict[Hashable, object] = {}

    def get_or_make(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the object with this key, of this program or the previous one; make it if there is none."""
        if key not in self._kept:
            self._kept[key] = self._previous[key] if key in self._previous else make()
        return self._kept[key]  # type: ignore[return-value]  # the key says what it is

    def get_or_open(
        self, place: Place, rest: Hashable, wrap: Callable[[int], T], function: str, *arguments: object
    ) -> T:
        """Like `get_or_make`, for an object that a library function opens; `wrap` gets its address. Raises MemoryError.

        `place` identifies the object within its program; the key is `place` with `rest`.
        """
        return self.get_or_make((place, rest), lambda: wrap(self._open(place, function, *arguments)))

    def _open(self, place: Place, function: str, *arguments: object) -> int:
        return self._opened.pop(place, 0) or open_native(self._library, function, *arguments)

    def forget_previous(self) -> None:
        self._previous = {}


class Native:
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
