"""Finds and loads the carrier's library, which `build.py` makes, and declares its functions.

A library of other sources than those beside it is refused: its structures may differ from those in `router.declared`.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from router import declared
from router.assets import asset, is_installed
from router.carrier.build import LIBRARY, checksum
from router.errors import StartError


@cache
def library() -> ctypes.CDLL:
    """The library, loaded once. Raises StartError where it cannot be used."""
    return load()


def load(path: Path = LIBRARY) -> ctypes.CDLL:
    """Load the library, without which nothing runs, and declare its functions. Raises StartError."""
    if not path.exists():
        raise StartError(f"{path} was not built, and nothing runs without it", _remedy())
    try:
        library = ctypes.CDLL(str(path))
        made_of = _text(library.carrier_checksum)
    except (OSError, AttributeError) as error:  # of another architecture, or no such library at all
        raise StartError(f"{path} cannot be loaded: {error}", _remedy()) from None
    if not made_of == declared.CHECKSUM == checksum():
        raise StartError(f"{path} was built from other sources", _remedy())
    for name, (returned, taken) in declared.FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = returned, taken
    return library


def _text(function: ctypes._NamedFuncPointer) -> str:
    function.restype = ctypes.c_char_p
    return str(function().decode())


def _remedy() -> str:
    if is_installed(asset("schemas")):
        return "install the router again where there is a C compiler"
    return "run 'make setup'"
