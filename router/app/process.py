"""The router as a process: notifications to a service manager, as in sd_notify(3), and settings of the interpreter.

Without a service manager nothing is sent.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import resource
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from router.app.memory import return_large_blocks
from router.clock import monotonic_ns
from router.log import logger
from router.net.udp import unclaimed

_CHECKS = 4
"""Progress checks per watchdog interval."""

NOTIFY_TIMEOUT = 5.0
"""Seconds for which a notification waits for a busy service manager, and so the longest delay of a reload or stop."""

_REMEDY = "reinstall the service: ListenDatagram= in rover-router.socket differs from the table"


@contextmanager
def supervised(feed: Callable[[int, int], None] = lambda *_: None) -> Iterator[None]:
    """Notify the service manager that the router is ready, and at the end that it stops.

    `feed(socket, interval)` has native threads feed the service manager's watchdog every `interval` ns while they make
    progress; a socket of -1 ends that. If the router is stuck, the service manager kills it with SIGABRT, and the log
    shows a traceback of each thread.
    """
    for address in unclaimed():
        logger.warning("no listener of the table uses this inherited socket", address=address, remedy=_REMEDY)
    with ExitStack() as ending:
        notify("READY=1")
        if (limit := _watchdog_ns()) is not None and (notifying := _notify_socket()) is not None:
            faulthandler.enable()
            feed(ending.enter_context(notifying).fileno(), limit // _CHECKS)
            ending.callback(feed, -1, 0)
        ending.callback(notify, "STOPPING=1", "WATCHDOG=1")  # the service manager's stop timeout starts here
        yield


@contextmanager
def reloading() -> Iterator[None]:
    """Notify the service manager that a reload begins, and that it ends."""
    notify("RELOADING=1", f"MONOTONIC_USEC={monotonic_ns() // 1000}")
    try:
        yield
    finally:
        notify("READY=1")


def notify(*lines: str) -> None:
    """Send lines, for example `READY=1`, to the service manager, if there is one."""
    if (notifying := _notify_socket()) is None:
        return
    with notifying:
        try:
            notifying.send("\n".join(lines).encode())
        except OSError as error:
            logger.warning("the service manager cannot be notified", line=lines[0], error=str(error))


def _notify_socket() -> socket.socket | None:
    """Return a socket that is connected to the service manager; None without one, or where it cannot be reached."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return None
    with ExitStack() as opening:
        try:
            notifying = opening.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            notifying.settimeout(NOTIFY_TIMEOUT)
            notifying.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        except OSError as error:
            logger.warning("the service manager cannot be notified", address=address, error=str(error))
            return None
        opening.pop_all()
    return notifying


def _watchdog_ns() -> int | None:
    """Return the watchdog's timeout in ns, or None without a watchdog."""
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    is_ours = os.environ.get("WATCHDOG_PID") in (None, str(os.getpid()))
    return int(microseconds) * 1000 if is_ours and microseconds.isdecimal() and int(microseconds) else None


def tune_interpreter() -> None:
    """Set up the process for low latency. Call it once, from the main program, after start-up."""
    gc.freeze()  # objects made at start-up live as long as the process and need no scan
    may_open, may_request = resource.getrlimit(resource.RLIMIT_NOFILE)
    if may_open not in (resource.RLIM_INFINITY, may_request):  # 1024 descriptors are too few for gateway clients
        resource.setrlimit(resource.RLIMIT_NOFILE, (may_request, may_request))
    sys.setswitchinterval(0.0005)  # the longest time that gateways wait for a busy thread
    return_large_blocks()
    gc.enable()  # it may have been paused until here
