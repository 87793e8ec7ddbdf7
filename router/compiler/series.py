"""Opens all series of a program before anything is counted, so that scrapes show every series from the start."""

from __future__ import annotations

from collections.abc import Iterable

from router.compiler.compiled_table import (
    STRANGER,
    CompiledTable,
    DeadmanPlan,
    GatewayPlan,
    RoutePlan,
    StatePlan,
    is_service,
    source_label,
)
from router.compiler.metrics import (
    CALL_OUTCOMES,
    CLIENT_DROP_REASONS,
    CLIENTS,
    DROP_REASONS,
    ENDPOINT_METRICS,
    GATEWAY_DROP_REASONS,
    GATEWAY_REJECT_REASONS,
    INBOUND_DROP_REASONS,
    QOS_POLICIES,
    RECORD_DROP_REASONS,
    REJECT_REASONS,
    RELOAD_RESULTS,
    TOPIC_STATES,
    UNKNOWN_CASE,
    UNSAVED_REASONS,
    Counters,
)
from router.compiler.resolution import unresolved
from router.table.addresses import LinkPlace
from router.table.model import RouteTable
from router.table.model.routes import ROS
from router.types.table_envelopes import Envelopes


def open_series(program: CompiledTable) -> None:
    """Open the series of a program in its counters."""
    counters, table = program.counters, program.table
    _open_listeners(counters, table, program.envelopes)
    _open_own(counters, table)
    for plan in program.routes:
        _open_route(counters, table, plan)
    for deadman in program.deadmen:
        _open_deadman(counters, deadman)
    for gateway in program.gateways:
        _open_gateway(counters, gateway)
    for state in program.states:
        _open_state(counters, state)
    for name in program.service_names:
        _open_each(counters, "service_calls", name, last=CALL_OUTCOMES)
        _open(counters, _OF_SERVICES, name)


def _open(counters: Counters, metrics: Iterable[str], *labels: str) -> None:
    for metric in metrics:
        counters.index(metric, *labels)


def _open_each(counters: Counters, metric: str, *labels: str, last: Iterable[str]) -> None:
    """Open a series for each value of the last label."""
    for value in last:
        counters.index(metric, *labels, value)


def _open_listeners(counters: Counters, table: RouteTable, envelopes: Envelopes) -> None:
    for listener in table.listeners:
        _open(
            counters,
            (
                "datagrams_received",
                "received_bytes",
                "datagrams_padded",
                "superseded_members",
            ),
            listener,
        )
        if table.listeners[listener].link is None:
            _open(counters, ("kernel_drops", "listener_waiting"), listener)
        if table.listeners[listener].groups:
            _open(counters, ("groups_not_joined",), listener)
        _open_each(counters, "datagrams_rejected", listener, last=REJECT_REASONS)
    _open_each(counters, "unhandled", last=(*envelopes.numbers, UNKNOWN_CASE))
    for metric in ENDPOINT_METRICS:
        _open_each(counters, metric, last=table.endpoints)
    for endpoint in table.endpoints.values():
        if isinstance(endpoint.address.value, LinkPlace):
            _open(counters, ("link_up", "link_openings"), endpoint.name)
    _open_each(counters, "endpoint_unresolved", last=unresolved(table))
    learned = (each.name for each in table.endpoints.values() if each.address.value.is_learned)
    _open_each(counters, "endpoint_learned", last=learned)


def _open_own(counters: Counters, table: RouteTable) -> None:
    """Open the series of the mirror, the recorder and reloads."""
    _open(counters, ("mirror_dropped", "config_last_reload_successful", "config_last_reload_timestamp_seconds"))
    _open_each(counters, "config_reloads", last=RELOAD_RESULTS)
    if table.record is not None:
        _open(counters, ("recorded_datagrams", "recorded_bytes", "recordings_lost"))
        _open_each(counters, "record_dropped", last=RECORD_DROP_REASONS)
        _open_each(counters, "recordings_unsaved", last=UNSAVED_REASONS)


_OF_SERVICES = "service_calls_open", "service_call_seconds", "service_retries", "service_replies_unmatched"


def _open_route(counters: Counters, table: RouteTable, plan: RoutePlan) -> None:
    """Open the series of a route, or of one source topic of a route from ROS."""
    route = plan.route
    _open(counters, ("route_duration_seconds", "route_silence_seconds"), route)
    published = [target.label for target in plan.targets if target.is_topic]
    topics = published if plan.topic is None else [plan.topic]
    for topic in (name for name in topics if not is_service(name)):
        _open_each(counters, "qos_incompatible", route, topic, last=QOS_POLICIES)
    if plan.topic is None:
        sources = [source for source in (*table.endpoints, STRANGER) if source in plan.sources]
        _open_each(counters, "messages_received", route, last=map(source_label, sources))
    else:
        counters.index("messages_received", route, plan.topic)
    for target in plan.targets:
        counters.set_commands(route, target.label, are_commands=target.is_command)
        _open_each(counters, "messages_dropped", route, target.label, last=DROP_REASONS)
        _open(counters, ("messages_filtered", "messages_waiting"), route, target.label)
        delivered = ("messages_published",) if target.is_topic else ("datagrams_sent", "sent_bytes")
        _open(counters, delivered, route, target.label)
        if target.is_topic and plan.collect_timeout is not None:
            counters.index("messages_collected", route, target.label)
        if target.for_each is not None:
            counters.index("messages_split", route, target.label)


def _open_state(counters: Counters, plan: StatePlan) -> None:
    _open(counters, ("state_changes",) if plan.is_text else ("state", "state_changes"), plan.name)
    for route, sources in plan.setters.items():
        _open_each(counters, "state_set_seconds", plan.name, last=sorted(sources))
        counters.set_commands(route, plan.label, are_commands=True)  # what it lets pass may be commands
        _open_each(counters, "messages_dropped", route, plan.label, last=DROP_REASONS)


def _open_deadman(counters: Counters, plan: DeadmanPlan) -> None:
    _open(counters, ("deadman_active", "deadman_trips"), plan.route)
    for to, _ in plan.datagrams:
        _open(counters, ("deadman_datagrams_sent", "deadman_send_errors"), plan.route, to)
    for endpoint in plan.obeyed.endpoints if plan.obeyed else ():
        _open(counters, ("deadman_disobeyed", "deadman_stopping_seconds"), plan.route, endpoint)


def _open_gateway(counters: Counters, plan: GatewayPlan) -> None:
    name = plan.settings.name
    _open(counters, ("datagrams_received", "received_bytes", "gateway_clients", "gateway_client_clock_ahead"), name)
    _open(counters, ("route_silence_seconds",), name)
    _open_each(counters, "datagrams_rejected", name, last=GATEWAY_REJECT_REASONS)
    _open_each(counters, "messages_received", name, last=(ROS, CLIENTS))
    _open(counters, ("messages_sent", "messages_filtered"), name, CLIENTS)
    _open_each(counters, "messages_dropped", name, CLIENTS, last=GATEWAY_DROP_REASONS)
    _open(counters, ("datagrams_sent", "sent_bytes"), name, plan.settings.transport.value.value)
    if plan.settings.zenoh is not None:
        _open(counters, ("gateway_key_conflicts",), name)
        _open(counters, ("gateway_connections",), name, plan.settings.zenoh.mode)
    _open_each(counters, "gateway_topics", name, last=TOPIC_STATES)
    _open_each(counters, "client_messages_dropped", name, last=CLIENT_DROP_REASONS)
    for topic, inbound in plan.inbound.items():
        counters.set_commands(name, topic, are_commands=inbound.is_command)
        _open(counters, ("messages_published",), name, topic)
        _open_each(counters, "messages_dropped", name, topic, last=INBOUND_DROP_REASONS)
        _open_each(counters, "qos_incompatible", name, topic, last=QOS_POLICIES)
        if inbound.deadman is not None:
            _open_deadman(counters, inbound.deadman)
    for call in plan.calls.values():
        _open_each(counters, "service_calls", call.name, last=CALL_OUTCOMES)
        _open(counters, ("service_calls_open", "service_call_seconds"), call.name)
