"""What stands on top of a dashboard: whether the router is well, and what goes wrong anywhere. Knows no JSON."""

from __future__ import annotations

from collections.abc import Iterator

from router.table.model import RouteTable
from router.tools.dashboard_layout import Column
from router.tools.dashboard_panels import DEADMAN, GREEN, LOST, MESSAGES, RED, SECONDS, Query, lines, number, states
from router.tools.dashboard_queries import INTERVAL, Series, selector

_RELOAD = {"1": ("running", GREEN), "0": ("refused", RED)}


def overview(table: RouteTable, series: Series) -> Iterator[Column]:
    yield from _process(series)
    yield from _losses(table, series)


def _process(series: Series) -> Iterator[Column]:
    """Whether the router is well: two columns of numbers."""
    reload = Query(series.of("config_last_reload_successful"), "table")
    yield [
        number("Up for", Query(f"time() - {selector('process_start_time_seconds')}", "up"), SECONDS, 4, 4),
        number("Table", reload, "none", 4, 4, names=_RELOAD, note="refused: the last reload changed nothing"),
    ]
    processor = Query(f"rate({selector('process_cpu_seconds_total')}[{INTERVAL}])", "processor")
    memory = Query(selector("process_resident_memory_bytes"), "memory")
    yield [
        number("Processor", processor, "percentunit", 4, 4, ((None, GREEN), (0.9, RED)), note="of one"),
        number("Memory", memory, "bytes", 4, 4),
    ]


def _losses(table: RouteTable, series: Series) -> Iterator[Column]:
    received = [
        Query(series.rate("datagrams_received", "listener"), "received by {{listener}}"),
        Query(f"{series.rate('datagrams_rejected', 'listener, reason')} > 0", "rejected by {{listener}}: {{reason}}"),
    ]
    if series.has("kernel_drops"):
        received.append(Query(f"{series.rate('kernel_drops', 'listener')} > 0", "lost by the kernel, {{listener}}"))
    yield [lines("Datagrams", received, MESSAGES, 16, LOST)]
    if table.endpoints:
        silence = Query(series.seconds_since("endpoint_last_seen_timestamp_seconds"), "{{endpoint}}")
        yield [lines("Silence of endpoints", [silence], SECONDS, 8, note="Time since each sent; none if it never did.")]
    if series.has("messages_dropped"):
        dropped = Query(f"{series.rate('messages_dropped', 'route, reason')} > 0", "{{route}}: {{reason}}")
        yield [lines("Dropped", [dropped], MESSAGES, 8, note="Messages that a target should have got, and did not.")]
    unhandled = Query(f"{series.rate('unhandled', 'payload_case')} > 0", "{{payload_case}}")
    yield [lines("Without a route", [unhandled], MESSAGES, 8, note="Payload cases that the table does not have.")]
    if series.has("route_duration_seconds"):
        latency = [
            Query(series.quantile(share, "route_duration_seconds"), f"{share:.0%}") for share in (0.5, 0.9, 0.99)
        ]
        yield [lines("Time in the router", latency, SECONDS, 8, note="From message received to all targets served.")]
    if series.has("deadman_active"):
        active = Query(series.of("deadman_active"), "{{route}}")
        yield [states("Deadmen", [active], 8, DEADMAN, "Red: commands stopped coming, and the deadman sends.")]
    missing = [Query(series.rate("mirror_dropped"), "lost by recordings and taps")]
    if table.record is not None:
        missing += [
            Query(series.rate("recorded_datagrams"), "recorded"),
            Query(f"{series.rate('record_dropped', 'reason')} > 0", "lost by the recording: {{reason}}"),
        ]
    yield [lines("Recording", missing, MESSAGES, 8, LOST)]
