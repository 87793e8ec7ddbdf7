"""Delays or skips large modules that a library imports and the router does not need."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


class _Postponed(ModuleType):
    """A stand-in for a module that is imported when one of its attributes is first read."""

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        value = getattr(importlib.import_module(self.__name__), attribute)
        setattr(self, attribute, value)  # so that this method is not called again
        return value


@contextmanager
def postponed(*names: str) -> Iterator[None]:
    """Delay the import of these top-level modules, by modules imported in this context, until their first use.

    Modules that are already imported are not affected.
    """
    standing = {name: _Postponed(name) for name in names if name not in sys.modules}
    sys.modules.update(standing)
    try:
        yield
    finally:
        for name, module in standing.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]


@contextmanager
def left_out(*names: str) -> Iterator[None]:
    """Make imports of these modules fail in this context, for libraries that work without them.

    Modules that are already imported are not affected.
    """
    absent = [name for name in names if name not in sys.modules]
    for name in absent:
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]
