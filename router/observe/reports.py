"""Logs losses, deadmen and silences, and remembers senders whose messages no route accepts."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable, Mapping
from typing import Any

from router.clock import boottime_ns
from router.compiler.compiled_table import DeadmanPlan
from router.compiler.metrics import UNSENT_REASONS, Mismatch, Report
from router.log import SUMMARY_INTERVAL_NS, FloodLog, fault, logger
from router.net.links import why_closed
from router.net.udp import why_not_sent
from router.table.addresses import Address, parse_address
from router.threads import Thread, join_or_abandon

MOST_MISMATCHES = 64
"""Maximum mismatches remembered, the latest ones: any stranger can cause them."""

_EVENTS = {
    "reject": "datagram rejected",
    "supersede": "datagram has several payloads; only the last one counts",
    "drop": "message dropped",
    "deadman": "deadman could not send",
    "call": "call of a service was not answered",
    "reply": "reply for a service was dropped",
}
"""Log events by kind of report."""
_PLACES = {"reject": "listener", "supersede": "listener", "call": "service", "reply": "service"}
"""What the place of a report is, if it is not a route."""


class Reporter:
    """Logs the first report of a kind at once, then summaries, in a thread of its own."""

    def __init__(self, address_of: Callable[[str], Address | None]) -> None:
        """`address_of` returns the address of an endpoint of the running table, None for any other target."""
        self._address_of = address_of
        self._floods = FloodLog()
        self._mismatches: dict[Mismatch, int] = {}
        self._lock = threading.Lock()
        self._lost: dict[tuple[str, str], tuple[int, Report]] = {}
        """The time and report of the last loss, by route and target."""
        self._learned: dict[str, str] = {}
        """The learned addresses, by endpoint."""
        self._unsent: dict[str, Report] = {}
        """By route whose deadman tripped because commands could not be sent: the last loss."""
        self._stopped = threading.Event()
        self._thread = Thread(self._summarise, "log")  # the start may fail
        self._thread.start()

    def close(self) -> None:
        """Log the remaining reports."""
        self._stopped.set()
        join_or_abandon(self._thread)
        self._floods.flush(final=True)

    def mismatches(self) -> Mapping[Mismatch, int]:
        """Return when each of the latest mismatches last occurred (boot clock, ns)."""
        with self._lock:
            return self._mismatches.copy()

    def forget_mismatches(self) -> None:
        """Forget what an earlier table rejected."""
        with self._lock:
            self._mismatches.clear()

    def _remember(self, mismatch: Mismatch) -> None:
        with self._lock:
            self._mismatches.pop(mismatch, None)
            self._mismatches[mismatch] = boottime_ns()
            if len(self._mismatches) > MOST_MISMATCHES:
                del self._mismatches[next(iter(self._mismatches))]

    def report(self, report: Report) -> None:
        if report.mismatch is not None:
            self._remember(report.mismatch)
        if report.kind == "drop":
            self._lost[report.place, report.target] = boottime_ns(), report
        where = _PLACES.get(report.kind, "route")
        values: dict[str, Any] = {
            where: report.place,
            "target": report.target,
            "reason": report.reason,
            "error": self._text(report.error, report.target) if report.error is not None else "",
            "detail": report.detail,
        }
        self._floods.note(
            (report.kind, report.place, report.target, report.reason),
            logger.warning,
            _EVENTS[report.kind],
            times=report.times,
            **{key: value for key, value in values.items() if value},
        )

    def _text(self, error: BaseException, target: str) -> str:
        if not isinstance(error, OSError) or (address := self._address_of(target)) is None:
            return str(error)
        if address.is_learned and error.errno != errno.EDESTADDRREQ and target in self._learned:
            address = parse_address(self._learned[target])
        return why_not_sent(error, address)

    def failed(self, error: Exception) -> None:
        found = fault(error, "lost a message")
        self._floods.note(("bug", type(error)), found.emit, found.event, found.error)

    def deadman_changed(self, route: str, active: bool, plan: DeadmanPlan | None) -> None:
        """Log that the deadman of a route has tripped or was released. `plan` is its plan in the running table.

        While a board does not answer, the kernel takes a few commands every 3 s, and drops them: each time the deadman
        is released and trips again. So these two lines are summarised.
        """
        if not active and (unsent := self._unsent.pop(route, None)):
            what = "commands are sent again; the deadman has stopped sending, but the target may not get them"
            self._floods.note(("released", route), logger.warning, what, route=route, target=unsent.target)
        elif not active:
            logger.warning("commands arrive again; the deadman has stopped sending", route=route)
        elif (lost := self._lost_for(plan)) is None:
            logger.warning("no commands arrive; the deadman sends in their place", route=route)
        else:
            what = "commands arrive but are dropped; the deadman sends in their place"
            values: dict[str, Any] = {"target": lost.target, "reason": lost.reason, "detail": lost.detail}
            if lost.reason in UNSENT_REASONS:
                self._unsent[route] = lost
                self._floods.note(("tripped", route), logger.warning, what, route=route, **values)
            else:
                logger.warning(what, route=route, **values)

    def returned(self, endpoint: str, silence: float) -> None:
        """Log that an endpoint is heard again, after `silence` seconds: for example, a board was reset."""
        logger.warning(f"{endpoint} was silent for {silence:.1f} s and is back", endpoint=endpoint)

    def learned(self, endpoint: str, before: str, after: str) -> None:
        """Log that the address of an endpoint was learned, as in `carrier.events.Learned`."""
        self._learned[endpoint] = after
        if not after:
            del self._learned[endpoint]
            what = "the table excludes the address that was learned: nothing is sent to it until another one is learned"
            logger.warning(what, endpoint=endpoint, before=before)
        elif before:
            logger.warning("another address was learned", endpoint=endpoint, address=after, before=before)
        else:
            logger.info("address learned", endpoint=endpoint, address=after)

    def link_changed(self, endpoint: str, error: int) -> None:
        """Log that the link to an endpoint was opened (`error` is 0), was closed, or cannot be opened (errno)."""
        if not error:
            self._floods.note(("link opened", endpoint), logger.info, "the link is open", endpoint=endpoint)
            return
        why, remedy = why_closed(error)
        what = "the link is closed; nothing is received or sent until it is open again"
        self._floods.note(
            ("link closed", endpoint, error), logger.warning, what, endpoint=endpoint, why=why, remedy=remedy
        )

    def _lost_for(self, plan: DeadmanPlan | None) -> Report | None:
        """Return the last command that was lost within the timeout, or None."""
        if plan is None:
            return None
        since, last = boottime_ns() - plan.timeout, None
        for target, _ in plan.datagrams:
            place = plan.route.removesuffix(f":{target}")  # for a client's deadman, the gateway
            at, lost = self._lost.get((place, target), (0, None))
            if at >= since:
                since, last = at, lost
        return last

    def _summarise(self) -> None:
        while not self._stopped.wait(SUMMARY_INTERVAL_NS / 1e9):
            self._floods.flush()
