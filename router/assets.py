"""Where the files that belong to the router lie: within the package in a wheel, at the root in a checkout.

Knows no file's meaning. `routes/`, `protos/` and `schemas/` are such files.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent
_PLACES = (_PACKAGE / "_assets", _PACKAGE.parent)


def asset(relative: str) -> Path:
    """The absolute path of a file or folder of ours, such as `schemas/route-table.schema.json`.

    Raises FileNotFoundError when the installation lacks it.
    """
    for place in _PLACES:
        if (path := place / relative).exists():
            return path
    raise FileNotFoundError(f"this installation of the router has no '{relative}'; install it again")


def is_installed(path: Path) -> bool:
    """Whether `path` is within the installed package: the next version overwrites what is changed there."""
    return path.resolve().is_relative_to(_PACKAGE.resolve())
