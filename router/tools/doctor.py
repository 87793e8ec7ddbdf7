"""Looks for what keeps a router from working on this computer, and says what to do about it.

`examine` goes from what is needed first, the table, to what only a running router can tell. What is looked at where is
in the modules doctor_*.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from router.compiler import check_table
from router.compiler.program import Program
from router.errors import Severity, shown_path
from router.tools.doctor_host import clock, receive_buffers, recordings, shared_memory
from router.tools.doctor_network import endpoints, interfaces, ports
from router.tools.doctor_report import Finding, fine, problem, warning
from router.tools.doctor_ros import open_domain, ros
from router.tools.doctor_running import Health, health


def examine(path: Path, variables: Mapping[str, str]) -> Iterator[Finding]:
    """Each finding as soon as there is one; a reachable board or none takes a second."""
    program = None
    for finding in _table(path, variables):
        if isinstance(finding, Program):
            program = finding
        else:
            yield finding
    if program is None:
        return
    running = health(program)
    yield from ros(program)
    yield from interfaces(program)
    yield from ports(program, running=running is not None)
    yield from receive_buffers(program)
    if running is None:
        yield from recordings(program)
    yield from shared_memory(variables)
    yield from open_domain(program, variables)
    yield from clock()
    yield from endpoints(program)
    yield from _running(program, running)


def before_start(path: Path, variables: Mapping[str, str]) -> Iterator[Finding]:
    """Only what would make the start fail. Ports of listeners are left out: systemd may keep them for the router."""
    for finding in _table(path, variables):
        if isinstance(finding, Program):
            yield from ros(finding)
            yield from interfaces(finding)
            yield from ports(finding, running=False, with_listeners=False)
            yield from recordings(finding)
        else:
            yield finding


def _table(path: Path, variables: Mapping[str, str]) -> Iterator[Finding | Program]:
    """What is wrong with it, and at the end the program, if it can run."""
    checked = check_table(path, variables)
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
        count = f"{warnings} warning{'s' if warnings > 1 else ''}"
        yield warning("table", count, f"`router validate {shown_path(path)}` shows them")
    counts = {"route": len(table.routes), "endpoint": len(table.endpoints), "gateway": len(table.gateways)}
    told = ", ".join(f"{count} {noun}{'s' * (count > 1)}" for noun, count in counts.items() if count)
    yield fine("table", f"{shown_path(path)}: {told}")
    yield checked.program


def _running(program: Program, running: Health | None) -> Iterator[Finding]:
    if program.table.metrics is None:
        yield warning(
            "router",
            "the table has no `metrics.address`: a running router cannot be asked",
            "add `metrics: {address: 127.0.0.1:9108}`",
        )
    elif running is None:
        what = f"none answers at {program.table.metrics.value}: stale endpoints, QoS and drops were not looked at"
        yield fine("router", what)
    else:
        yield from running.findings()
