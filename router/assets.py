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


def page_policy(page: bytes) -> str:
    """The Content-Security-Policy of a page with inline scripts and styles only. Callers add permitted connections."""
    import base64
    import re
    from hashlib import sha256  # here, as `table` has imported it without OpenSSL

    sources: dict[bytes, list[str]] = {b"script": [], b"style": []}
    for kind, text in re.findall(rb"<(script|style)[^>]*>(.*?)</\1>", page, re.DOTALL):
        sources[kind].append(f"'sha256-{base64.b64encode(sha256(text).digest()).decode()}'")
    scripts, styles = (" ".join(hashes) or "'none'" for hashes in sources.values())
    return (
        f"default-src 'none'; script-src {scripts}; style-src {styles}; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
