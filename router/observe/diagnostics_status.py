"""What ROS's monitors are told: one status for the router, each listener, endpoint, route and gateway.

Takes what the router counts at two times and makes words of it. Knows no thread, no clock and no bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from router.compiler.metrics import RECORD_DROP_REASONS
from router.compiler.program import GatewayPlan
from router.observe.diagnostics_findings import (
    Status,
    deadman,
    drops,
    is_silent,
    rejections,
    silence,
    stale,
    status_of,
    unsent,
    warning,
)
from router.observe.diagnostics_snapshot import SEEN, Rest, Situation
from router.table.model import Endpoint, Route


def statuses(seen: Situation) -> Iterator[Status]:
    """The router's own first."""
    table = seen.program.table
    yield _router(seen)
    for listener in table.listeners:
        yield _listener(seen, listener)
    for endpoint in table.endpoints.values():
        yield _endpoint(seen, endpoint)
    for route in table.routes:
        if not route.ignore:
            yield _route(seen, route)
    for gateway in seen.program.gateways:
        yield _gateway(seen, gateway)


def _router(seen: Situation) -> Status:
    table = seen.program.table
    findings = [
        *(
            warning(f"the recording lacks {n}: {reason}")
            for reason in RECORD_DROP_REASONS
            for _, n in seen.grown("record_dropped", reason)
        ),
        *(warning(f"recordings and taps were not shown {n}") for _, n in seen.grown("mirror_dropped")),
    ]
    if not seen.count("config_last_reload_successful"):
        findings.append(warning("the last reload failed, and the table from before it goes on"))
    values = [("table", table.path), ("table sha256", table.sha256), ("protos sha256", seen.program.protos_sha256)]
    return status_of("router", seen.host, findings, "routing", values)


def _listener(seen: Situation, name: str) -> Status:
    findings = [warning(f"the kernel dropped {n}") for _, n in seen.grown("kernel_drops", name)]
    findings += rejections(seen, name)
    values = [
        ("address", seen.program.table.listeners[name].bound_to),
        ("received", seen.count("datagrams_received", name)),
        ("dropped by the kernel", seen.count("kernel_drops", name)),
        *((f"rejected: {reason}", n) for (reason,), n in seen.counted("datagrams_rejected", name)),
    ]
    return status_of(f"listener/{name}", seen.host, findings, "receives what arrives", values)


def _endpoint(seen: Situation, endpoint: Endpoint) -> Status:
    name, table = endpoint.name, seen.program.table
    speaks = any(source.value == name for route in table.routes for source in route.sources)
    findings = [stale(seen, name)] if speaks and is_silent(seen, endpoint) else []
    routes = [route.name for route in table.routes if name in _destinations(route)]
    findings += drops(
        _of_all(
            ((name, reason), n)
            for route in routes
            for (target, reason), n in seen.grown("messages_dropped", route)
            if target == name
        )
    )
    findings += [
        unsent(n, name)
        for route in table.routes
        for (target,), n in seen.grown("deadman_send_errors", route.name)
        if target == name
    ]
    dropped = _of_all(
        ((reason,), n)
        for route in routes
        for (target, reason), n in seen.counted("messages_dropped", route)
        if target == name
    )
    values = [
        ("address", endpoint.address.value),
        ("kind", endpoint.kind.value),
        ("silent for", silence(seen, name)),
        ("received", seen.second("messages_received", name)),
        ("sent", seen.second("datagrams_sent", name)),
        *((f"dropped: {reason}", n) for (reason,), n in dropped),
    ]
    well = "sends" if seen.count(SEEN, name) else "nothing came yet" if speaks else "is not expected to send"
    return status_of(f"endpoint/{name}", str(endpoint.address.value), findings, well, values)


def _destinations(route: Route) -> list[str]:
    return [destination.endpoint.value for destination in route.destinations]


def _of_all(counts: Iterable[tuple[Rest, int]]) -> Iterable[tuple[Rest, int]]:
    """With those of the same labels added up."""
    sums: dict[Rest, int] = {}
    for labels, count in counts:
        sums[labels] = sums.get(labels, 0) + count
    return sums.items()


def _route(seen: Situation, route: Route) -> Status:
    name, table = route.name, seen.program.table
    sources = [table.endpoints[source.value] for source in route.sources if source.value in table.endpoints]
    findings = deadman(seen, name)
    if sources and all(is_silent(seen, source) for source in sources):
        findings += [stale(seen, source.name) for source in sources]
    findings += drops(seen.grown("messages_dropped", name))
    received, fresh = seen.count("messages_received", name), sum(n for _, n in seen.grown("messages_received", name))
    values = [
        ("received", received),
        ("received per second", f"{fresh / seen.seconds:.1f}"),
        *((f"sent to {target}", n) for (target,), n in seen.counted("datagrams_sent", name)),
        *((f"published on {topic}", n) for (topic,), n in seen.counted("messages_published", name)),
        *((f"dropped for {target}: {reason}", n) for (target, reason), n in seen.counted("messages_dropped", name)),
        *((f"sent by the deadman to {target}", n) for (target,), n in seen.counted("deadman_datagrams_sent", name)),
    ]
    return status_of(f"route/{name}", seen.host, findings, "routes" if received else "nothing came yet", values)


def _gateway(seen: Situation, gateway: GatewayPlan) -> Status:
    name = gateway.settings.name
    findings = [*rejections(seen, name), *drops(seen.grown("messages_dropped", name))]
    for inbound in gateway.inbound.values():
        if inbound.deadman is not None:
            findings += deadman(seen, inbound.deadman.route)
    values = [
        ("clients", seen.count("gateway_clients", name)),
        *((f"topics {state}", n) for (state,), n in seen.counted("gateway_topics", name)),
        ("sent", seen.count("messages_sent", name)),
        *((f"received from {source}", n) for (source,), n in seen.counted("messages_received", name)),
        *((f"rejected: {reason}", n) for (reason,), n in seen.counted("datagrams_rejected", name)),
        *((f"dropped for {target}: {reason}", n) for (target, reason), n in seen.counted("messages_dropped", name)),
    ]
    return status_of(f"gateway/{name}", seen.host, findings, "serves its clients", values)
