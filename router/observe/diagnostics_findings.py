"""What goes wrong, in words, and how grave it is, for diagnostics. Knows what is counted, and no route or endpoint."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import NamedTuple

from router.compiler.metrics import INTENDED_REASONS
from router.observe.diagnostics_snapshot import SEEN, Rest, Situation
from router.table.model import Endpoint

ERRORS = frozenset({"send_error", "publish_error"})
"""Drop reasons that say that something is broken."""


class Level(enum.IntEnum):
    """As diagnostic_msgs/msg/DiagnosticStatus has them."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


_GRAVITY = (Level.OK, Level.WARN, Level.STALE, Level.ERROR)


class Status(NamedTuple):
    """One DiagnosticStatus; `name` without the node's."""

    level: Level
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...]


class Finding(NamedTuple):
    level: Level
    text: str


def status_of(
    name: str, host: str, findings: Iterable[Finding], well: str, values: Iterable[tuple[str, object]]
) -> Status:
    """The gravest finding gives the level, and all of that are told."""
    found = sorted(findings, key=lambda finding: -_GRAVITY.index(finding.level))
    level = found[0].level if found else Level.OK
    message = "; ".join(finding.text for finding in found) or well
    return Status(level, name, message, host, tuple((key, str(value)) for key, value in values))


def warning(text: str) -> Finding:
    return Finding(Level.WARN, text)


def rejections(seen: Situation, listener: str) -> list[Finding]:
    grown = seen.grown("datagrams_rejected", listener)
    return [warning(f"rejected {n}: {reason}") for (reason,), n in grown if reason not in INTENDED_REASONS]


def drops(grown: Iterable[tuple[Rest, int]]) -> list[Finding]:
    """Of series whose other labels are target and reason."""
    return [
        Finding(Level.ERROR if reason in ERRORS else Level.WARN, f"dropped {n} for {target}: {reason}")
        for (target, reason), n in grown
        if reason not in INTENDED_REASONS
    ]


def deadman(seen: Situation, route: str) -> list[Finding]:
    findings = [unsent(n, target) for (target,), n in seen.grown("deadman_send_errors", route)]
    if seen.count("deadman_active", route):
        findings.append(Finding(Level.ERROR, "commands stopped coming: the deadman sends in their place"))
    return findings


def unsent(times: int, target: str) -> Finding:
    return Finding(Level.ERROR, f"the deadman could not send {times} to {target}")


def is_silent(seen: Situation, endpoint: Endpoint) -> bool:
    return endpoint.stale_after is not None and seen.silent.get(endpoint.name, 0) > endpoint.stale_after


def stale(seen: Situation, endpoint: str) -> Finding:
    return Finding(Level.STALE, f"{endpoint} is silent for {silence(seen, endpoint)}")


def silence(seen: Situation, endpoint: str) -> str:
    since = "" if seen.count(SEEN, endpoint) else ", since the router started"
    return f"{seen.silent.get(endpoint, 0) / 1e9:.1f} s{since}"
