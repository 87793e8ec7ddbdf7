"""Reloads: compiles the table again while the old program runs, and replaces it once everything is ready."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

from router import inputs
from router.app.image_saver import ImageSaver
from router.app.memory import drop_idle_code
from router.app.process import reloading
from router.app.runtime import Runtime
from router.app.watching import UNCHANGED_TIMEOUT, wait_until_unchanged, watched_files
from router.clock import monotonic_ns, wall_ns
from router.compiler import check_table
from router.compiler.check import Checked, uncollected
from router.compiler.compiled_table import CompiledTable
from router.compiler.lookup import Definitions
from router.compiler.resolution import names, resolved
from router.errors import Code, Diagnostic, Severity, SourceSpan, StartError, plural
from router.image.writer import write_image
from router.log import fault, logger
from router.observe.running import ReloadResult
from router.table.keys import are_same
from router.table.model import RouteTable
from router.table.model.settings import NodeSettings
from router.threads import StuckError, background_threads

_MOST_NAMED = 12
"""Maximum number of changes that the summary of a reload lists."""


class Reloader:
    """Reloads the table, one at a time. `environ` has the values of the table's variables (None: process environment).

    `replaced` is called once another program runs and the earlier one is closed. `saver` saves its image. `hosts`
    returns the addresses of host names.
    """

    def __init__(
        self,
        runtime: Runtime,
        environ: Mapping[str, str] | None,
        replaced: Callable[[], None],
        saver: ImageSaver | None = None,
        hosts: Callable[[], Mapping[str, str]] = dict,
    ) -> None:
        self._runtime = runtime
        self._hosts = hosts
        self._counts = runtime.counts
        self._environ = environ
        self._replaced = replaced
        self._saver = saver
        self._is_open = False
        self._one_at_a_time = threading.Lock()
        self._remember(is_good=True)  # the first table, before anybody can scrape

    def open(self) -> None:
        """Allow reloads, once the router runs."""
        self._is_open = True
        drop_idle_code()

    def close(self) -> None:
        """Wait for a running reload, which changes nothing if it is still compiling; reject later ones."""
        self._is_open = False
        with self._one_at_a_time:
            pass

    def reload(self) -> ReloadResult:
        """Reload the table. If it is invalid or cannot be opened, nothing changes, and the result says why."""
        with self._one_at_a_time:
            if not self._is_open or self._runtime.program is None:
                return ReloadResult(False, (), "the router is not running")
            began = monotonic_ns()
            with background_threads(), reloading(), uncollected():
                kind, result = self._attempt(self._runtime.program)
            self._count(kind)
            self._remember(is_good=result.ok)
            drop_idle_code()
            seconds = round((monotonic_ns() - began) / 1e9, 3)
        log = logger.info if result.ok else logger.error
        event = "table reloaded" if result.ok else "reload rejected; the old table is still running"
        log(event, result=result.text, findings=[str(finding) for finding in result.findings], seconds=seconds)
        return result

    def reopen(self) -> None:
        """Reopen listeners, join groups, and send to groups, where addresses and network interfaces have appeared."""
        with self._one_at_a_time:
            program = self._runtime.program
            if not self._is_open or program is None:
                return
            self._runtime.sockets.follow_interfaces()
            replaceable = [each for each in self._runtime.sockets.listeners.values() if each.is_replaceable()]
            if not replaceable:
                return
            try:
                self._runtime.take_over(program)
            except (StartError, StuckError, OSError) as error:  # the watcher tries again
                logger.warning("a listener cannot be reopened", why=str(error))
            else:
                names = [each.name for each in replaceable]
                logger.info("these listeners now receive: their networks are up", listeners=names)

    def readdress(self) -> bool:
        """Send to the present addresses of host names, and recognise senders by them. Return whether that is done."""
        with self._one_at_a_time:
            program = self._runtime.program
            if not self._is_open or program is None:
                return False
            try:
                self._runtime.take_over(resolved(program, self._hosts()))
            except (StartError, StuckError, OSError) as error:
                logger.warning("another address of a host name cannot be adopted", why=str(error))
                return False
            self._notify_replaced()
            return True

    def _attempt(self, now: CompiledTable) -> tuple[str, ReloadResult]:
        """Return the label under which the reload is counted, and its result."""
        findings: Sequence[Diagnostic] = ()
        try:
            with inputs.recording(self._saver.selection if self._saver else None) as read:
                checked = self._check(now)
            findings = checked.diagnostics
            then = checked.program_in(now.counters.continued())
            if then is None:
                return "invalid", _refused(findings)
            then = resolved(then, self._hosts())
            if refused := _unchangeable(now.table, then.table):
                return "invalid", _refused([*findings, *refused])
            text = _changes(now, then)
            if not self._is_open:
                raise StartError("the router is stopping")
            self._runtime.take_over(then)
            if moved := _all_moved(now.table, then.table):
                logger.warning("the reload has changed the address of every endpoint", endpoints=moved)
        except (StartError, StuckError) as error:
            why = str(error)
        except OSError as error:  # files may change while they are read, or descriptors run out
            why = f"the table cannot be read or opened now: {error}"
        except Exception as error:  # noqa: BLE001 a bug of the router is logged; it must not end the caller
            found = fault(error, "prevented the reload")
            found.log()
            why = f"{found.event}: {error!r}"
        else:
            self._notify_replaced()
            if self._saver is not None and (image := self._runtime.plane.image) is not None:
                # Another process resolves the names itself.
                self._saver.save(write_image(then.named) if names(then) and then.named else image.image, read)
            return "ok", ReloadResult(True, tuple(findings), text)
        return "failed", ReloadResult(False, tuple(findings), why)

    def _check(self, now: CompiledTable) -> Checked:
        """Check the table once none of its files is being written. Raises StartError after a timeout, or OSError."""
        until = monotonic_ns() + round(UNCHANGED_TIMEOUT * 1e9)
        wait_until_unchanged(watched_files(now.table), until)
        while True:
            checked = check_table(now.table.path, self._environ, Definitions(now.envelopes.schemas))
            if checked.table is None or not wait_until_unchanged(watched_files(checked.table), until):
                return checked  # else the files changed while they were read

    def _notify_replaced(self) -> None:
        try:
            self._replaced()
        except Exception as error:  # noqa: BLE001 as above; the new table runs already
            fault(error, "occurred after a reload").log()

    def _count(self, kind: str) -> None:
        self._counts.own[self._counts.counters.index("config_reloads", kind)] += 1

    def _remember(self, *, is_good: bool) -> None:
        counters, own = self._counts.counters, self._counts.own
        own[counters.index("config_last_reload_successful")] = int(is_good)
        if is_good:
            own[counters.index("config_last_reload_timestamp_seconds")] = wall_ns()


def _refused(findings: Sequence[Diagnostic]) -> ReloadResult:
    errors = sum(finding.severity is Severity.ERROR for finding in findings)
    return ReloadResult(False, tuple(findings), f"the table has {plural(errors, 'error')}")


def _unchangeable(now: RouteTable, then: RouteTable) -> list[Diagnostic]:
    """Return a finding for each changed setting that needs a restart."""
    top = SourceSpan(str(then.path))
    settings = {
        "node": (_node(now.node), _node(then.node), then.node.span),
        "http": (now.http, then.http, then.http and then.http.span),
        "record": (now.record, then.record, then.record and then.record.span),
        "foxglove": (now.foxglove, then.foxglove, then.foxglove and then.foxglove.span),
    }
    return [
        Diagnostic(
            span or top,
            Code.BAD_VALUE,
            f"'{key}' cannot change while the router runs",
            "restart it, or undo the change",
        )
        for key, (before, after, span) in settings.items()
        if not are_same(before, after)
    ]


def _node(node: NodeSettings) -> object:
    return node.name, node.namespace, node.diagnostics is not None


def _changes(before: CompiledTable, after: CompiledTable) -> str:
    """Describe a reload in one line, for example `route imu_info changed, endpoint arm_board added`."""
    now, then = before.table, after.table
    found = [
        *_differing("envelope", now.envelopes, then.envelopes),
        *_differing("listener", now.listeners, then.listeners),
        *_differing("endpoint", now.endpoints, then.endpoints),
        *_differing("route", _routes(now), _routes(then)),
        *_differing("state", now.states, then.states),
        *_differing("service", {**now.services, **now.called}, {**then.services, **then.called}),
        *_differing("gateway", now.gateways, then.gateways),
        *(["protos changed"] if before.protos_sha256 != after.protos_sha256 else []),
    ]
    if not found:
        return "nothing changed"
    named, others = found[:_MOST_NAMED], len(found) - _MOST_NAMED
    return ", ".join([*named, *([f"and {others} more"] if others > 0 else [])])


def _all_moved(now: RouteTable, then: RouteTable) -> list[str]:
    """Return `sensor_board 127.0.0.30:8 -> 192.168.0.30:8` for each common endpoint, if all of them have moved."""
    both = [
        (name, endpoint.address.value, then.endpoints[name].address.value)
        for name, endpoint in now.endpoints.items()
        if name in then.endpoints
    ]
    if any(before == after for _, before, after in both):
        return []
    return [f"{name} {before} -> {after}" for name, before, after in both]


def _routes(table: RouteTable) -> Mapping[str, object]:
    return {route.name: route for route in table.routes}


def _differing(kind: str, now: Mapping[str, object], then: Mapping[str, object]) -> Iterator[str]:
    """Yield what was added, removed or changed; `envelope` has no name."""
    for name in [*now, *(then.keys() - now.keys())]:
        what = f"{kind} {name}".rstrip()
        if name not in now:
            yield f"{what} added"
        elif name not in then:
            yield f"{what} removed"
        elif not are_same(now[name], then[name]):
            yield f"{what} changed"
