"""What a Zenoh session is opened with, and what its errors say. Opens nothing."""

from __future__ import annotations

import json
import re

import zenoh

from router.compiler.zenoh_config import is_default, library_config, reason
from router.errors import StartError
from router.net.port_holder import port_taken
from router.table.model import ZenohSettings

LARGE_MESSAGE_US = 2_000_000
"""How long Zenoh may wait for room for the fragments of one large message before it drops it: 7 MB take 0.6 s at
100 Mbit/s. By default it gives up after 50 ms."""


_PASSING = "Unable to connect|timeout|os error (?:19|99|100|101|110|113)\\b"
"""Errors that pass when others, or a network interface, are there."""


def session_config(settings: ZenohSettings) -> zenoh.Config:
    """What `config` of the table says, and what the gateway sets itself. Raises StartError."""
    try:
        zenoh.KeyExpr(settings.key.value)
    except zenoh.ZError as error:
        raise StartError(f"'{settings.key.value}' is no key of Zenoh's: {short(error)}") from error
    try:
        config = library_config(settings.config)
    except zenoh.ZError as error:  # a file that has changed since it was checked
        raise StartError(_refused(settings, error)) from None
    unless_said: dict[str, object] = {
        "scouting/multicast/enabled": not settings.connect and not settings.listen,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": LARGE_MESSAGE_US,
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
            raise StartError(f"Zenoh does not take {value!r} for {name}: {short(error)}") from error
    return config


def why_in_vain(settings: ZenohSettings, error: str) -> str:
    """What to do about an error that does not pass by itself; empty for others."""
    if "not supported" in error:
        return f"Zenoh cannot use one of these: {', '.join((*settings.connect, *settings.listen))}: {short(error)}"
    if "os error 98" not in error:
        is_refused = settings.config is not None or "TLS" in error
        return _refused(settings, error) if is_refused and not re.search(_PASSING, error) else ""
    for locator in settings.listen:
        port = re.search(r":(\d+)$", locator)
        if port and locator in error:
            return f"{locator} cannot be used: {port_taken('tcp', int(port[1]))}"
    return f"Zenoh cannot listen: {short(error)}"


def _refused(settings: ZenohSettings, error: object) -> str:
    if settings.config is None:
        return f"Zenoh needs a `config` for this: {reason(error)}"
    return f"{settings.config.span}: Zenoh does not take this `config`: {reason(error)}"


def short(error: object) -> str:
    """Without the places in Zenoh's own source."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error))
