"""Imports that a library makes and the router does not need: large modules that are loaded later, or not at all."""

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
    """Takes the place of a module, and imports it when one of its attributes is read."""

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        value = getattr(importlib.import_module(self.__name__), attribute)
        setattr(self, attribute, value)  # the next time it is found without this method
        return value


@contextmanager
def postponed(*names: str) -> Iterator[None]:
    """Have modules that are imported inside import these, which are no parts of packages, when they first use them.

    What has been imported before stays as it is.
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
    """Have imports of these modules fail inside, for libraries that work without them.

    What has been imported before stays as it is.
    """
    absent = [name for name in names if name not in sys.modules]
    for name in absent:
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]
