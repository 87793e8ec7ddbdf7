"""Delays the import of large modules that a library imports and the router seldom needs."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


class _Lazy(ModuleType):
    """A stand-in for a module that is imported when one of its attributes is first read.

    Unlike with `importlib.util.LazyLoader` before Python 3.13, no other thread sees a module that is half loaded.
    """

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        value = getattr(importlib.import_module(self.__name__), attribute)
        setattr(self, attribute, value)  # so that this method is not called again
        return value


@contextmanager
def lazy_import(name: str) -> Iterator[None]:
    """Delay the import of a top-level module, by modules imported in this context, until its first use.

    A module that is already imported is not affected.
    """
    if name in sys.modules:
        yield
        return
    module = sys.modules[name] = _Lazy(name)
    try:
        yield
    finally:
        if sys.modules.get(name) is module:
            del sys.modules[name]
