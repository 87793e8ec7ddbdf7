"""What a service manager hears of the router, as sd_notify(3) has it: ready, alive, reloading, stopping.

Without a service manager nothing is said. Knows no router, only a number that changes while one works.
"""

from __future__ import annotations

import faulthandler
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from router.app.timers import TimerThread
from router.clock import monotonic_ns
from router.log import logger
from router.net.udp import inherited

_LOOKS = 4
"""How often the watchdog looks in the time that it is given."""

PATIENCE = 5.0
"""Seconds for which a service manager may be too busy to listen; reloads and the end wait that long at most."""

_REMEDY = "ListenDatagram= in rover-router.socket says something else than the table: install the service anew"


@contextmanager
def supervised(progress: Callable[[], int]) -> Iterator[None]:
    """Inside, the router is ready; at the end it stops.

    The service manager's watchdog is fed while `progress()` changes, which it must do at least every half second. A
    router that is stuck is ended by SIGABRT then, and its log shows where each of its threads stood.
    """
    for address in inherited().unclaimed():
        logger.warning("nobody listens on a socket that was handed over", address=address, remedy=_REMEDY)
    with ExitStack() as ending:
        tell("READY=1")
        if (limit := _watchdog_ns()) is not None:
            faulthandler.enable()
            keeper = TimerThread("watchdog", monotonic_ns, _tell_fault)
            keeper.add(Watchdog(progress, limit // _LOOKS, monotonic_ns()))
            keeper.start()
            ending.callback(keeper.stop)
        ending.callback(tell, "STOPPING=1", "WATCHDOG=1")  # from here on the time for stopping counts
        yield


@contextmanager
def reloading() -> Iterator[None]:
    """Inside, the router takes a new table; whether it could, it says elsewhere."""
    tell("RELOADING=1", f"MONOTONIC_USEC={monotonic_ns() // 1000}")
    try:
        yield
    finally:
        tell("READY=1")


class Watchdog:
    """A machine that tells of life every `interval` ns, if `progress()` has changed since."""

    def __init__(self, progress: Callable[[], int], interval: int, now: int) -> None:
        self.next_due: int | None = now + interval
        self._progress = progress
        self._interval = interval
        self._seen: int | None = None

    def due(self, now: int) -> None:
        self.next_due = now + self._interval
        if (reached := self._progress()) != self._seen:
            self._seen = reached
            tell("WATCHDOG=1")

    def end(self, now: int) -> None:
        self.next_due = None


def tell(*lines: str) -> None:
    """Sends lines such as `READY=1` to the service manager, if there is one."""
    place = os.environ.get("NOTIFY_SOCKET")
    if not place:
        return
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as telling:
            telling.settimeout(PATIENCE)
            telling.connect(f"\0{place[1:]}" if place.startswith("@") else place)
            telling.send("\n".join(lines).encode())
    except OSError as error:  # it will do about that what it does about a router that is silent
        logger.warning("the service manager cannot be told", told=lines[0], error=str(error))


def _watchdog_ns() -> int | None:
    """For how long the service manager waits for a sign of life; None if it does not."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    is_ours = os.environ.get("WATCHDOG_PID") in (None, str(os.getpid()))
    return int(microseconds) * 1000 if is_ours and microseconds.isdecimal() and int(microseconds) else None


def _tell_fault(error: Exception) -> None:
    logger.error("the watchdog cannot be fed", error=str(error))
