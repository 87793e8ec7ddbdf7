"""Finds and loads the carrier's library, which `carrier/build.py` makes, and declares its functions.

A library that was built from other sources is rejected, because its structures may differ from `router.declared`.
A wheel contains no sources.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from functools import cache

from router import declared
from router.shortage import is_shortage

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pathlib import Path

    from router.errors import ConfigurationError

_CARRIER = f"{os.path.dirname(__file__)}/carrier"  # noqa: PTH120 - pathlib takes 5 ms to import
NATIVE = f"{_CARRIER}/native"
LIBRARY = f"{NATIVE}/libcarrier.so"
"""The file that `build.py` makes."""


@cache
def library() -> ctypes.CDLL:
    """Return the library, loaded once. Raises ConfigurationError if it cannot be used, or OSError."""
    return load()


def load(path: str | Path = LIBRARY) -> ctypes.CDLL:
    """Load the library and declare its functions. Raises ConfigurationError, or OSError."""
    try:
        built = os.stat(path).st_mtime_ns  # noqa: PTH116 - as above
    except FileNotFoundError:
        raise _refused(f"{path} was not built, and nothing runs without it") from None
    try:
        library = ctypes.CDLL(str(path))
        made_of = _text(library.carrier_checksum)
    except (OSError, AttributeError) as error:  # for another architecture, or not a carrier library at all
        if is_shortage(error):
            raise
        raise _refused(f"{path} cannot be loaded: {error}") from None
    if made_of != declared.CHECKSUM or (any(changed >= built for changed in _changes()) and made_of != _checksum()):
        raise _refused(f"{path} was built from other sources")
    for name, (returned, taken) in declared.FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = returned, taken
    return library


def _text(function: ctypes._NamedFuncPointer) -> str:
    function.restype = ctypes.c_char_p
    return str(function().decode())


def _changes() -> Iterator[int]:
    """Yield the modification times of the sources, as reading all sources takes longer than the rest of a start."""
    for folder, endings in (NATIVE, (".c", ".h")), (_CARRIER, ("build.py", "headers.py")):
        with os.scandir(folder) as files:
            yield from (file.stat().st_mtime_ns for file in files if file.name.endswith(endings))


def _checksum() -> str:
    """Return the checksum of the sources. The build script belongs to no layer: it runs before there is a library."""
    from runpy import run_path

    return str(run_path(f"{_CARRIER}/build.py")["checksum"]())


def _refused(what: str) -> ConfigurationError:
    from router.assets import asset, is_installed
    from router.errors import ConfigurationError

    hint = "run 'make setup'"
    if is_installed(asset("schemas")):
        hint = "reinstall the router on a machine with a C compiler"
    return ConfigurationError(what, hint)
