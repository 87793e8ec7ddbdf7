"""What keeps a router from working on this computer, and what to do about it.

`examine` checks the table first, then this computer, then the running router if there is one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from router.compiler import Checked, check_table
from router.compiler.metrics import INTENDED_REASONS
from router.compiler.program import Program
from router.errors import Severity, TransportError, plural, shown_path
from router.observe.snapshot import Snapshot
from router.table import summary
from router.table.model import RouteTable
from router.table.units import duration
from router.tools.doctor_checks import (
    CheckResult,
    Grade,
    carrier,
    clock,
    endpoints,
    fine,
    listeners,
    open_domain,
    ports,
    problem,
    receive_buffers,
    recordings,
    ros,
    shared_memory,
    warning,
    ways,
)
from router.tools.running_router import metrics, url_of


def examine(path: Path, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Each result as soon as it is known; pings take up to a second."""
    checked = check_table(path, variables)
    yield from _table(checked)
    program = checked.program
    if program is None:
        return
    running = health(program)
    yield from carrier()
    yield from ros(program)
    yield from listeners(program)
    yield from ports(program, running=running is not None)
    yield from receive_buffers(program)
    if running is None:
        yield from recordings(program)
    yield from shared_memory(variables)
    yield from open_domain(program, variables)
    yield from clock()
    yield from endpoints(program)
    yield from _running(program, running)


def before_start(path: Path, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Only what would make the start fail, and warnings of networks that the table needs and that are not there.

    Without the ports of listeners: systemd may hold them for the router.
    """
    checked = check_table(path, variables)
    needed = [_table(checked)]
    program = checked.program
    if program is not None:
        needed += [carrier(), ros(program), ports(program, running=False, with_listeners=False)]
        needed += [recordings(program)]
    yield from (result for result in chain.from_iterable(needed) if result.grade is Grade.PROBLEM)
    if program is not None:
        yield from (result for result in listeners(program) if result.grade is not Grade.FINE)
        yield from ways(program, warning)


def _table(checked: Checked) -> Iterator[CheckResult]:
    warnings = 0
    for found in checked.diagnostics:
        if found.severity is Severity.ERROR:
            yield problem("table", f"{found.span}: {found.message}", found.hint or "`router validate` shows the place")
        else:
            warnings += 1
    if checked.program is None:
        return
    table = checked.program.table
    if warnings:
        yield warning("table", plural(warnings, "warning"), f"`router validate {shown_path(checked.path)}` shows them")
    yield fine("table", f"{shown_path(checked.path)}: {summary(table)}")


def _running(program: Program, running: Health | None) -> Iterator[CheckResult]:
    if program.table.http is None:
        yield warning(
            "router",
            "the table has no `http.address`: a running router cannot be asked",
            "add `http: {address: 127.0.0.1:9108}`",
        )
    elif running is None:
        what = f"none answers at {program.table.http.value}: stale endpoints, QoS and drops were not looked at"
        yield fine("router", what)
    else:
        yield from running.findings()


_SHOWN = 3
"""Targets that are named for each reason of a loss."""


@dataclass(frozen=True, slots=True)
class Health:
    """The metrics of a router that may run another version of `table` by now."""

    table: RouteTable
    snapshot: Snapshot

    def findings(self) -> Iterator[CheckResult]:
        found = [*self._table(), *self._waiting(), *self._silent(), *self._lost(), *self._kept_away(), *self._deadmen()]
        yield from found or [fine("router", "it runs, hears every endpoint that sends, and loses nothing")]

    def _table(self) -> Iterator[CheckResult]:
        if self.snapshot.counts("config_last_reload_successful").get(()) == 0:
            what = "its last reload failed, and the table from before it goes on"
            yield problem("router", what, "`router reload` says why")
        elif self.snapshot.table_sha256 != self.table.sha256:
            yield warning("router", "it runs another table than this file", "router reload, or systemctl restart")

    def _waiting(self) -> Iterator[CheckResult]:
        for (name,), is_waiting in self.snapshot.counts("listener_waiting").items():
            if is_waiting:
                what = f"listener '{name}' waits for its address or network interface: nothing comes in by it"
                yield warning("router", what, "`ip address` shows those there are")

    def _silent(self) -> Iterator[CheckResult]:
        sources = {source.value for route in self.table.routes for source in route.sources}
        for (name,), seen in self.snapshot.counts("endpoint_last_seen_timestamp_seconds").items():
            endpoint = self.table.endpoints.get(name)
            if endpoint is None or endpoint.stale_after is None or name not in sources:
                continue
            believed_by = endpoint.listener.value if endpoint.listener else None
            listeners = [each for each in self.table.listeners.values() if believed_by in (None, each.name)]
            listening = ", ".join(each.bound_to for each in listeners)
            remedy = (
                f"is it on, and does it send to this computer, where the router listens ({listening})? "
                f"`tcpdump -n udp and host {endpoint.address.value.host}` shows whether anything comes"
            )
            if not seen:
                yield warning("endpoints", f"{name} was never heard since the router started", remedy)
            elif self.snapshot.at - seen > endpoint.stale_after / 1e9:
                limit = duration(endpoint.stale_after)
                what = f"{name} is stale: silent for {self.snapshot.at - seen:.0f} s, and more than {limit} is too long"
                yield problem("endpoints", what, remedy)

    def _lost(self) -> Iterator[CheckResult]:
        for (listener,), count in self.snapshot.counts("kernel_drops").items():
            if count:
                yield warning(
                    "router",
                    f"the kernel has dropped {count:.0f} datagrams of listener '{listener}'",
                    "a larger `receive_buffer`, or less load on this computer; `router top` shows whether it goes on",
                )
        lost: dict[str, list[tuple[float, str]]] = defaultdict(list)
        for (route, target, reason), count in self.snapshot.counts("messages_dropped").items():
            if count and reason not in INTENDED_REASONS:
                lost[reason].append((count, f"{count:.0f} of {route} for {target}"))
        for reason, each in lost.items():
            worst = [text for _, text in sorted(each, reverse=True)[:_SHOWN]]
            others = f" and {len(each) - _SHOWN} more targets" if len(each) > _SHOWN else ""
            yield warning(
                "router",
                f"messages lost as {reason}: {', '.join(worst)}{others}",
                "the reason is in docs/reference/metrics.md, what happened in the log: journalctl -u rover-router",
            )

    def _kept_away(self) -> Iterator[CheckResult]:
        for (route, topic, policy), peers in self.snapshot.counts("qos_incompatible").items():
            if peers:
                yield problem(
                    "ROS",
                    f"topic {topic}: no exchange with {plural(int(peers), 'peer')} of another {policy}",
                    f"`ros2 topic info -v {topic}` shows their QoS, `router explain {route}` ours",
                )

    def _deadmen(self) -> Iterator[CheckResult]:
        for (route,), active in self.snapshot.counts("deadman_active").items():
            if active:
                yield warning(
                    "router",
                    f"{route}: commands stopped coming, and the deadman sends in their place",
                    "do commands still come, often enough, and from a clock that agrees with this one?",
                )


def health(program: Program) -> Health | None:
    """The health of the running router. None if none answers, or the table has no `http.address`."""
    table = program.table
    if table.http is None:
        return None
    try:
        return Health(table, metrics(url_of(table)))
    except TransportError:  # no answer, or another program's
        return None
