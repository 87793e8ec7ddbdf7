"""A reload: the table is read and compiled again beside the running program, which ends when all is ready for another.

Knows what came of it; how a program takes over, `edges` knows.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence

from router.app.accounts import Accounts
from router.app.changes import all_moved, changes, unchangeable
from router.app.edges import Edges
from router.app.interpreter import beside_traffic
from router.app.sockets import is_replaceable
from router.app.supervision import reloading
from router.app.watching import PATIENCE, wait_for_rest, watched_files
from router.clock import monotonic_ns, wall_ns
from router.compiler import check_table
from router.compiler.check import Checked
from router.compiler.lookup import Definitions
from router.compiler.program import Program
from router.errors import Diagnostic, Severity, StartError
from router.log import logger
from router.observe.running import ReloadResult
from router.threads import StuckError, background_threads


class Reloader:
    """One reload at a time. `environ` has the values of the table's variables; None means the process environment.

    `settled` is called when another program runs, and nothing is left of the one before.
    """

    def __init__(
        self, edges: Edges, accounts: Accounts, environ: Mapping[str, str] | None, settled: Callable[[], None]
    ) -> None:
        self._edges = edges
        self._accounts = accounts
        self._environ = environ
        self._settled = settled
        self._is_open = False
        self._one_at_a_time = threading.Lock()

    def open(self) -> None:
        """The router runs. What it has now counts as loaded."""
        self._is_open = True
        self._remember(is_good=True)

    def close(self) -> None:
        """Waits for a reload that is going on; none begins any more."""
        with self._one_at_a_time:
            self._is_open = False

    def reload(self) -> ReloadResult:
        """Raises nothing for a bad table, nor for what cannot be opened: then nothing changes."""
        with self._one_at_a_time:
            if not self._is_open or self._edges.wiring is None:
                return ReloadResult(False, (), "the router is not running")
            began = monotonic_ns()
            with background_threads(), beside_traffic(), reloading():
                kind, result = self._attempt(self._edges.wiring.program)
            self._count(kind)
            self._remember(is_good=result.ok)
            seconds = round((monotonic_ns() - began) / 1e9, 3)
        log = logger.info if result.ok else logger.error
        event = "table reloaded" if result.ok else "the table was not taken over, and nothing has changed"
        log(event, result=result.text, findings=[str(finding) for finding in result.findings], seconds=seconds)
        return result

    def reopen(self) -> None:
        """Opens listeners of the running program anew whose network interface was replaced, if there are any."""
        with self._one_at_a_time:
            wiring = self._edges.wiring
            replaceable = [each for each in self._edges.sockets.listeners.values() if is_replaceable(each)]
            if not self._is_open or wiring is None or not replaceable:
                return
            try:
                self._edges.take_over(self._edges.prepare(wiring.program))
            except (StartError, StuckError, OSError) as error:  # tried again
                logger.warning("a listener cannot be opened on its network interface", why=str(error))
            else:
                logger.info("network interfaces are back", listeners=[each.name for each in replaceable])

    def _attempt(self, now: Program) -> tuple[str, ReloadResult]:
        """As what it is counted, and what came of it."""
        findings: Sequence[Diagnostic] = ()
        try:
            checked = self._check(now)
            findings = checked.diagnostics
            then = checked.program_in(now.counters.continued())
            if then is None:
                return "invalid", _refused(findings)
            if refused := unchangeable(now.table, then.table):
                return "invalid", _refused([*findings, *refused])
            text = changes(now, then)
            self._edges.take_over(self._edges.prepare(then))
            if moved := all_moved(now.table, then.table):
                logger.warning("the reload has moved every endpoint to another address", endpoints=moved)
        except (StartError, StuckError) as error:
            why = str(error)
        except OSError as error:  # files come and go while they are read, and descriptors may be short
            why = f"the table cannot be read or opened now: {error}"
        except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, must not end who asked
            logger.critical("a fault in the router itself kept it from reloading; please report it", exc_info=error)
            why = f"a fault in the router itself: {error!r}"
        else:
            self._settle()
            return "ok", ReloadResult(True, tuple(findings), text)
        return "failed", ReloadResult(False, tuple(findings), why)

    def _check(self, now: Program) -> Checked:
        """The table, once no file of it is being written. Raises StartError if that takes too long, or OSError."""
        until = monotonic_ns() + round(PATIENCE * 1e9)
        wait_for_rest(watched_files(now.table), until)
        while True:
            checked = check_table(now.table.path, self._environ, Definitions(now.protos))
            if checked.table is None or not wait_for_rest(watched_files(checked.table), until):
                return checked  # else it was read while it was written, or names other files than before

    def _settle(self) -> None:
        try:
            self._settled()
        except Exception as error:  # noqa: BLE001 as above; the table runs already
            logger.critical("a fault in the router itself after a reload; please report it", exc_info=error)

    def _count(self, kind: str) -> None:
        self._accounts.own[self._accounts.counters.index("config_reloads", kind)] += 1

    def _remember(self, *, is_good: bool) -> None:
        counters, own = self._accounts.counters, self._accounts.own
        own[counters.index("config_last_reload_successful")] = int(is_good)
        if is_good:
            own[counters.index("config_last_reload_timestamp_seconds")] = wall_ns()


def _refused(findings: Sequence[Diagnostic]) -> ReloadResult:
    errors = sum(finding.severity is Severity.ERROR for finding in findings)
    return ReloadResult(False, tuple(findings), f"the table has {errors} error{'s' * (errors != 1)}")
