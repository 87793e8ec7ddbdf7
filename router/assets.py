"""Finds the files shipped with the router: within the package in a wheel, at the root in a checkout.

They are in `routes/`, `protos/`, `schemas/` and `docs/`.
"""

from __future__ import annotations

import os
from pathlib import Path

_PACKAGE = Path(__file__).parent
_PLACES = (_PACKAGE / "_assets", _PACKAGE.parent)


def asset(relative: str) -> Path:
    """Return the absolute path of a shipped file or folder, such as `schemas/route-table.schema.json`.

    Raises FileNotFoundError if the installation lacks it.
    """
    for place in _PLACES:
        if (path := place / relative).exists():
            return path
    raise FileNotFoundError(f"this installation of the router has no '{relative}'; install it again")


def is_installed(path: Path) -> bool:
    """Return whether `path` is within the installed package: the next version overwrites what is changed there."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(_PACKAGE))  # `resolve` raises for a link loop


def page_policy(page: bytes) -> str:
    """Return the Content-Security-Policy of a page with inline scripts and styles only. Callers add connect-src."""
    import base64
    import re
    from hashlib import sha256

    sources: dict[bytes, list[str]] = {b"script": [], b"style": []}
    for kind, text in re.findall(rb"<(script|style)[^>]*>(.*?)</\1>", page, re.DOTALL):
        sources[kind].append(f"'sha256-{base64.b64encode(sha256(text).digest()).decode()}'")
    scripts, styles = (" ".join(hashes) or "'none'" for hashes in sources.values())
    return (
        f"default-src 'none'; script-src {scripts}; style-src {styles}; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
