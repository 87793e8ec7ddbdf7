"""What a Zenoh session is opened with, and what its errors say. Opens nothing."""

from __future__ import annotations

import json
import re

import zenoh

from router.edges.port_holder import port_taken
from router.errors import StartError
from router.table.model import ZenohSettings

LARGE_MESSAGE_US = 2_000_000
"""How long Zenoh may wait for room for the fragments of one large message before it drops it: 7 MB take 0.6 s at
100 Mbit/s. By default it gives up after 50 ms."""


def session_config(settings: ZenohSettings) -> zenoh.Config:
    """Raises StartError."""
    try:
        zenoh.KeyExpr(settings.key.value)
    except zenoh.ZError as error:
        raise StartError(f"'{settings.key.value}' is no key of Zenoh's: {short(error)}") from error
    config: zenoh.Config = zenoh.Config()
    values: dict[str, object] = {
        "mode": settings.mode,
        "scouting/multicast/enabled": not settings.connect and not settings.listen,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": LARGE_MESSAGE_US,
    }
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
        return ""
    for locator in settings.listen:
        port = re.search(r":(\d+)$", locator)
        if port and locator in error:
            return f"{locator} cannot be used: {port_taken('tcp', int(port[1]))}"
    return f"Zenoh cannot listen: {short(error)}"


def short(error: object) -> str:
    """Without the places in Zenoh's own source."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error))
