"""Numbers that stand for the names of listeners, endpoints, routes and targets in native threads."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable


class Names:
    """Numbers for names, in both directions. A name keeps its number as long as the process lives."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        self._names: list[str] = [*names]
        self._numbers = {name: number for number, name in enumerate(self._names)}

    def number(self, name: str) -> int:
        if name not in self._numbers:
            self._numbers[name] = len(self._names)
            self._names.append(name)
        return self._numbers[name]

    def name(self, number: int) -> str:
        return self._names[number]

    def all(self) -> list[str]:
        """Return all names, by number."""
        return [*self._names]
