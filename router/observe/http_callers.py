"""Who may have a running router do something, or hand out what it receives: programs on the same computer.

Knows addresses and headers only. Metrics and the status page are for everybody who can reach them.
"""

from __future__ import annotations

import ipaddress
from email.message import Message

COLLECTED_AT = "X-Collected-At"
"""Header of /metrics: when the numbers were read, in seconds of the router's wall clock."""

_BY_BROWSERS = ("Origin", "Sec-Fetch-Site", "Sec-Fetch-Mode")


def refusal(peer: str, own: str, headers: Message) -> str | None:
    """Why a caller at IP address `peer`, who reached us at `own`, is turned away; None where he is not.

    A browser would call for any page that is open in it, and a name may have been made to lead here only after that
    page was loaded (DNS rebinding): so no browsers, and no names.
    """
    if not is_own_computer(peer, own):
        return f"only from the router's own computer, not from {peer}"
    if any(name in headers for name in _BY_BROWSERS):
        return "not for browsers: use the command line"
    hosts = headers.get_all("Host", [])
    if len(hosts) != 1 or not _is_plain(hosts[0]):
        return "only by an IP address or localhost, not by a name"
    return None


def is_own_computer(peer: str, own: str) -> bool:
    """Return whether a caller at IP address `peer`, who reached us at `own`, is on the router's computer."""
    return ipaddress.ip_address(peer).is_loopback or peer == own


def _is_plain(host: str) -> bool:
    name = host.rpartition(":")[0] if ":" in host else host
    try:
        ipaddress.IPv4Address(name)
    except ValueError:
        return name == "localhost"
    return True
