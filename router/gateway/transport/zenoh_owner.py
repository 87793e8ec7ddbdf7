"""Who has a Zenoh key. Each gateway that serves a key keeps a liveliness token at KEY/owner/SINCE/SESSION/HOST/PID."""

from __future__ import annotations

import os
import re
import socket
from datetime import datetime, timezone
from typing import NamedTuple

import zenoh

from router.clock import wall_ns

LOOK_SECONDS = 1.5
"""How long tokens are asked for. All that are reachable answer at once, unless one of them stands still. Less than a
session has to end: closing waits for it."""

_LONGEST = 64
"""Characters of a host's name that are told."""


class Owner(NamedTuple):
    """One that has a key. The lesser of two came first: `since_ns` is wall-clock time. `session` is a Zenoh id."""

    since_ns: int
    session: str
    host: str
    pid: str

    def __str__(self) -> str:
        since = datetime.fromtimestamp(self.since_ns // 1_000_000_000, timezone.utc)
        return f"pid {self.pid} on {self.host}, since {since:%Y-%m-%dT%H:%M:%SZ}, session {self.session}"

    def token(self, key: str) -> str:
        """The key expression of its token."""
        return "/".join((key, "owner", *map(str, self)))


def all_tokens(key: str) -> str:
    """A key expression that has every token of a key, and no other."""
    return f"{key}/owner/*/*/*/*"


def this_owner(session: zenoh.Session) -> Owner:
    """The gateway of this process, as of now."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "_", socket.gethostname())[:_LONGEST] or "unknown"
    return Owner(wall_ns(), str(session.zid()), host, str(os.getpid()))


def owner_of(token: object) -> Owner | None:
    """Who has declared it. None where it is no token of a gateway."""
    since, session, host, pid = str(token).rsplit("/", 4)[1:]
    if not re.fullmatch("[0-9]{1,19}", since):
        return None
    return Owner(int(since), session[:_LONGEST], host[:_LONGEST], pid[:_LONGEST])


def owners(session: zenoh.Session, key: str) -> set[Owner] | None:
    """Those that have tokens now, other than `session` itself. None when not all who were asked have answered.

    Takes LOOK_SECONDS at most. Raises ZError.
    """
    found = set()
    for reply in session.liveliness().get(all_tokens(key), timeout=LOOK_SECONDS):
        if reply.ok is None:
            return None
        owner = owner_of(reply.ok.key_expr)
        if owner is not None and owner.session != str(session.zid()):
            found.add(owner)
    return found
