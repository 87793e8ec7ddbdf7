"""How `router explain` says what routes and gateways have in common."""

from __future__ import annotations

from dataclasses import asdict

from router.compiler.topics import qos_of
from router.table.model import Topic


def quality(topic: Topic) -> str:
    """A line with the whole QoS of a topic."""
    qos = {name: value for name, value in asdict(qos_of(topic)).items() if value is not None}
    return f"    qos: {', '.join(f'{name} {value}' for name, value in qos.items())}"


def at_start(sends: bool) -> str:
    """What a deadman does when the router starts."""
    return "and once when the router starts" if sends else "but not when the router starts"
