"""Finds what keeps a router from working on this computer, with remedies.

`examine` checks the table first, then this computer, then the running router if there is one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path

from router.compiler import Checked, check_table
from router.compiler.compiled_table import CompiledTable
from router.errors import Severity, TransportError, plural, shown_path
from router.observe.problems import Level
from router.table import summary
from router.tools.doctor_checks import (
    CheckResult,
    Grade,
    carrier,
    clock,
    endpoints,
    extras,
    fine,
    listeners,
    open_domain,
    page,
    ports,
    problem,
    receive_buffers,
    recordings,
    ros,
    ros_peers,
    ros_ports,
    shared_memory,
    warning,
    ways,
)
from router.tools.line_checks import lines
from router.tools.multicast_checks import groups
from router.tools.name_checks import Names
from router.tools.running_router import Health, health, url_of
from router.tools.service_checks import services


def examine(path: Path, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Yield each result as soon as it is known; pings take up to a second."""
    checked = check_table(path, variables)
    yield from _table(checked)
    program = checked.program
    if program is None:
        return
    running = _health(program)
    yield from carrier()
    yield from extras(program)
    yield from (results := [*ros(program)])
    if running is None and all(result.grade is Grade.FINE for result in results):
        yield from ros_peers(program)
    if all(result.grade is Grade.FINE for result in results):
        yield from services(program)
    yield from listeners(program)
    yield from groups(program)
    yield from lines(program, running=running is not None)
    yield from ports(program, running=running is not None)
    yield from ros_ports(program, variables)
    yield from receive_buffers(program)
    yield from recordings(program, running=running is not None)
    yield from shared_memory(variables)
    yield from open_domain(program, variables)
    yield from clock()
    found = Names(program)
    yield from found.results()
    yield from endpoints(found.program, _in_place_of(running))
    yield from _learned(program, running)
    yield from _running(program, running)


def before_start(path: Path, variables: Mapping[str, str]) -> Iterator[CheckResult]:
    """Yield only what would make the start fail, and warnings of missing networks, of devices of serial lines, and of
    what is in the ROS domain.

    Ports of listeners are not checked: systemd may hold them for the router.
    """
    checked = check_table(path, variables)
    needed = [_table(checked)]
    program = checked.program
    if program is not None:
        needed += [carrier(), extras(program), ros(program), ports(program, running=False, with_listeners=False)]
        needed += [recordings(program, running=False), ros_ports(program, variables)]
    problems = [result for result in chain.from_iterable(needed) if result.grade is Grade.PROBLEM]
    yield from problems
    if program is not None:
        found = Names(program)
        later = chain(found.results(), lines(program, running=False))
        yield from (result._replace(grade=Grade.WARNING) for result in later if result.grade != Grade.FINE)
        if not any(result.about == "ROS" for result in problems):
            yield from ros_peers(program)
        networks = chain(listeners(program), groups(program))
        yield from (result for result in networks if result.grade is not Grade.FINE)
        yield from ways(found.program, warning)


def _table(checked: Checked) -> Iterator[CheckResult]:
    warnings = 0
    for finding in checked.diagnostics:
        if finding.severity is Severity.ERROR:
            yield problem(
                "table", f"{finding.span}: {finding.message}", finding.hint or "run `router validate` to see the place"
            )
        else:
            warnings += 1
    if checked.program is None:
        return
    table = checked.program.table
    if warnings:
        yield warning(
            "table", plural(warnings, "warning"), f"run `router validate {shown_path(checked.path)}` to see them"
        )
    yield fine("table", f"{shown_path(checked.path)}: {summary(table)}")


def _running(program: CompiledTable, running: Health | None) -> Iterator[CheckResult]:
    if program.table.http is None:
        yield warning(
            "router",
            "the table has no `http.address`: a running router cannot be checked",
            "add `http: {address: 127.0.0.1:9108}`",
        )
    elif running is None:
        what = f"no router answers at {program.table.http.address.value}: its health was not checked"
        yield fine("router", what)
    else:
        yield from _reported(program, running)


def _reported(program: CompiledTable, running: Health) -> Iterator[CheckResult]:
    """Yield what a running router reports; it may be running another version of the table."""
    if running.table_sha256 != program.table.sha256:
        yield warning("router", "its table differs from this file", "router reload, or systemctl restart")
    for reported in running.problems:
        if reported.kind.level is Level.CALM:
            yield fine("router", reported.text)
            continue
        grade = problem if reported.kind.level is Level.CRITICAL else warning
        yield grade("router", reported.text, f"{reported.remedy} See {page(reported.page)}")
    if all(reported.kind.level is Level.CALM for reported in running.problems):
        yield fine("router", f"it runs and loses nothing; {plural(running.received, 'datagram')} received")


def _learned(program: CompiledTable, running: Health | None) -> Iterator[CheckResult]:
    """Yield where the running router has learned endpoints to be."""
    for endpoint in program.table.endpoints.values() if running is not None else ():
        if not endpoint.address.value.is_learned or running is None:
            continue
        if endpoint.name in running.learned:
            yield fine("endpoints", f"{endpoint.name}: learned at {running.learned[endpoint.name]}")
        else:
            what = f"{endpoint.name}: its address is not learned yet, so it gets nothing"
            yield warning("endpoints", what, "it is learned from the first message for a route with this source")


def _in_place_of(running: Health | None) -> Mapping[str, str]:
    """Return, by endpoint, the other host that sends its payloads, as the running router reports."""
    reported = [cause.labels for cause in running.problems] if running is not None else []
    return {labels["endpoint"]: labels["sender"] for labels in reported if "sender" in labels}


def _health(program: CompiledTable) -> Health | None:
    """Return the health of the running router; None if no router answers, or the table has no `http.address`."""
    try:
        return None if program.table.http is None else health(url_of(program.table))
    except TransportError:  # no answer, or another program's
        return None
