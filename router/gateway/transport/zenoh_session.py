"""A gateway's Zenoh session: its configuration, its errors, and the owners of a key.

Each gateway that serves a key keeps a liveliness token at KEY/owner/SINCE/SESSION/HOST/PID.
"""

from __future__ import annotations

import json
import os
import re
import socket
from datetime import datetime, timezone
from typing import NamedTuple

import zenoh

from router.clock import wall_ns
from router.compiler.zenoh_config import is_default, library_config, reason
from router.errors import ConfigurationError, StartError
from router.net.kernel import port_taken
from router.table.model.gateways import ZenohSettings

LARGE_MESSAGE_US = 2_000_000
"""How long Zenoh waits for room for the fragments of a large message before dropping it (default: 50 ms). 7 MB take
0.6 s at 100 Mbit/s."""

LOOK_SECONDS = 1.5
"""Timeout of a query for tokens. All reachable sessions answer at once, unless one is suspended. Shorter than the
timeout for closing a session, which waits for the query."""

_TEMPORARY = "Unable to connect|timeout|os error (?:12|19|23|24|99|100|101|105|110|113)\\b"
"""Errors that end when others, or a network interface, appear, or when there is memory again, and so on."""

_LONGEST = 64
"""Maximum characters shown of a host name."""


def session_config(settings: ZenohSettings) -> zenoh.Config:
    """Return the table's `config` with the gateway's own settings. Raises ConfigurationError."""
    try:
        zenoh.KeyExpr(settings.key.value)
    except zenoh.ZError as error:
        raise ConfigurationError(f"'{settings.key.value}' is not a valid Zenoh key: {short(error)}") from error
    try:
        config = library_config(settings.config)
    except zenoh.ZError as error:  # a file that has changed since it was checked
        raise ConfigurationError(_refused(settings, error)) from None
    unless_said: dict[str, object] = {
        "scouting/multicast/enabled": not settings.connect and not settings.listen,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": LARGE_MESSAGE_US,
        "transport/link/tls/close_link_on_expiration": True,  # of the other side's certificate
    }
    values = {key: value for key, value in unless_said.items() if is_default(config, key)}
    values["mode"] = settings.mode
    if settings.connect:
        values["connect/endpoints"] = settings.connect
    if settings.listen:
        values["listen/endpoints"] = settings.listen
    for name, value in values.items():
        try:
            config.insert_json5(name, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigurationError(f"Zenoh rejects {value!r} for {name}: {short(error)}") from error
    return config


def connections(session: zenoh.Session) -> int:
    """Return the number of routers and peers that a session is connected to. Clients do not count."""
    return len(session.info.routers_zid()) + len(session.info.peers_zid())


def permanent(settings: ZenohSettings, error: str) -> StartError | None:
    """Return the error that ends the start; None if the gateway tries again while the router runs."""
    if "not supported" in error:
        locators = ", ".join((*settings.connect, *settings.listen))
        return ConfigurationError(f"Zenoh cannot use one of these: {locators}: {short(error)}")
    if "os error 98" not in error:
        is_refused = (settings.config is not None or "TLS" in error) and not re.search(_TEMPORARY, error)
        return ConfigurationError(_refused(settings, error)) if is_refused else None
    for locator in settings.listen:
        port = re.search(r":(\d+)$", locator)
        if port and locator in error:
            return StartError(f"{locator} cannot be used: {'; '.join(port_taken('tcp', int(port[1])))}")
    return StartError(f"Zenoh cannot listen: {short(error)}")


def short(error: object) -> str:
    """Return the text of an error without locations in Zenoh's source."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error))


def _refused(settings: ZenohSettings, error: object) -> str:
    if settings.config is None:
        return f"Zenoh needs a `config` for this: {reason(error)}"
    return f"{settings.config.span}: Zenoh rejects this `config`: {reason(error)}"


class Owner(NamedTuple):
    """A gateway that owns a key. The lesser of two was first: `since_ns` is wall-clock time, `session` a Zenoh id."""

    since_ns: int
    session: str
    host: str
    pid: str

    def __str__(self) -> str:
        since = datetime.fromtimestamp(self.since_ns // 1_000_000_000, timezone.utc)
        return f"pid {self.pid} on {self.host}, since {since:%Y-%m-%dT%H:%M:%SZ}, session {self.session}"

    def token(self, key: str) -> str:
        """Return the key expression of its token."""
        return "/".join((key, "owner", *map(str, self)))


def all_tokens(key: str) -> str:
    """Return a key expression that matches every token of a key, and nothing else."""
    return f"{key}/owner/*/*/*/*"


def this_owner(session: zenoh.Session) -> Owner:
    """Return this process as the owner of a key from now on."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "_", socket.gethostname())[:_LONGEST] or "unknown"
    return Owner(wall_ns(), str(session.zid()), host, str(os.getpid()))


def owner_of(token: object) -> Owner | None:
    """Return the gateway that declared a token; None if it is not a gateway's token."""
    since, session, host, pid = str(token).rsplit("/", 4)[1:]
    if not re.fullmatch("[0-9]{1,19}", since):
        return None
    return Owner(int(since), session[:_LONGEST], host[:_LONGEST], pid[:_LONGEST])


def owners(session: zenoh.Session, key: str) -> set[Owner] | None:
    """Return the owners of a key other than `session`; None if an answer is missing.

    Takes at most LOOK_SECONDS. Raises ZError.
    """
    others = set()
    for reply in session.liveliness().get(all_tokens(key), timeout=LOOK_SECONDS):
        if reply.ok is None:
            return None
        owner = owner_of(reply.ok.key_expr)
        if owner is not None and owner.session != str(session.zid()):
            others.add(owner)
    return others
