"""What a browser lets a page of ours do: run what is written in it, and nothing from elsewhere. Knows no server."""

from __future__ import annotations

import base64
import re
from hashlib import sha256

_INLINE = re.compile(rb"<(script|style)[^>]*>(.*?)</\1>", re.DOTALL)


def page_policy(page: bytes) -> str:
    """The Content-Security-Policy of a page whose scripts and styles are all in it; it may connect to nothing yet."""
    sources: dict[bytes, list[str]] = {b"script": [], b"style": []}
    for kind, text in _INLINE.findall(page):
        sources[kind].append(f"'sha256-{base64.b64encode(sha256(text).digest()).decode()}'")
    scripts, styles = (" ".join(hashes) or "'none'" for hashes in sources.values())
    return (
        f"default-src 'none'; script-src {scripts}; style-src {styles}; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
