"""Detects commands that were stored on their way, for example by a radio that lost its link, and arrive all at once.

A UDP datagram does not tell when it was sent, so each of them looks new. But after a silence they come faster than
their sender ever sends. The criterion needs only the snapshots of health, so it costs nothing per datagram. It is
coarse: bursts after a silence below SILENCE, or of a sender whose usual rate is not known yet, are not detected.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from router.log import logger
from router.observe.snapshot import Snapshot

SILENCE = 2.0
"""Least silence before a burst, in seconds."""

FACTOR = 3.0
"""A burst is at least this many times as fast as the usual rate."""

FEWEST = 10
"""Least number of messages in a burst."""

STREAK = 2
"""Snapshots after a silence that do not count for the usual rate: a burst may extend over two."""


class Burst(NamedTuple):
    """Messages that arrived within `seconds` after a silence. `at`: boot clock, s."""

    at: float
    messages: int
    seconds: float
    silence: float


class Bursts:
    """Follows the number of messages that routes receive. `found`: the last burst of each route."""

    def __init__(self) -> None:
        self.found: dict[str, Burst] = {}
        self._usual: dict[str, float] = {}  # by route: the highest rate so far, outside of bursts
        self._heard: dict[str, tuple[float, int]] = {}  # by route: when last, and for how many snapshots in a row

    def note(self, before: Snapshot, now: Snapshot, routes: Iterable[str]) -> None:
        """Compare two consecutive snapshots, and log the bursts of these routes."""
        seconds = now.at - before.at
        for route in routes:
            count = now.total("messages_received", route) - before.total("messages_received", route)
            heard, streak = self._heard.get(route, (before.at, 0))
            if count <= 0:
                self._heard[route] = heard, 0
                continue
            self._heard[route] = now.at, streak + 1
            usual, silence = self._usual.get(route), before.at - heard
            if streak >= STREAK:
                self._usual[route] = max(usual or 0.0, count / seconds)
            elif usual and silence >= SILENCE and count >= max(FEWEST, FACTOR * usual * seconds):
                self.found[route] = Burst(now.at, count, seconds, silence)
                logger.info(
                    "many commands arrived at once after a silence: they may be old",
                    route=route,
                    messages=count,
                    in_seconds=round(seconds, 1),
                    silent_for=round(silence, 1),
                )

    def recent(self, now: float, within: float) -> Mapping[str, Burst]:
        return {route: burst for route, burst in self.found.items() if now - burst.at < within}
