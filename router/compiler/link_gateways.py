"""Plans of checked gateways, with every series that they count in.

Expects gateways without errors: nothing here is checked, and nothing is found.
"""

from __future__ import annotations

from router.compiler.checked import CheckedGateway, CheckedInbound
from router.compiler.metrics import (
    CLIENT_DROP_REASONS,
    CLIENTS,
    GATEWAY_DROP_REASONS,
    GATEWAY_REJECT_REASONS,
    INBOUND_DROP_REASONS,
    QOS_POLICIES,
    TOPIC_STATES,
    Counters,
)
from router.compiler.program import DeadmanPlan, GatewayPlan, InboundPlan
from router.table.model import ROS, Gateway, InboundDeadman


def link_gateway(checked: CheckedGateway, counters: Counters) -> GatewayPlan:
    """The plan of one gateway; opens its series in the counters."""
    settings = checked.settings
    _open_counters(counters, settings)
    return GatewayPlan(settings, {entry.topic: _inbound(entry, settings.name, counters) for entry in checked.inbound})


def _inbound(entry: CheckedInbound, gateway: str, counters: Counters) -> InboundPlan:
    topic, inbound = entry.topic, entry.inbound
    counters.index("messages_published", gateway, topic)
    for reason in INBOUND_DROP_REASONS:
        counters.index("messages_dropped", gateway, topic, reason)
    for policy in QOS_POLICIES:
        counters.index("qos_incompatible", gateway, topic, policy)
    deadman = None
    if inbound.deadman is not None and entry.stop is not None:
        deadman = _deadman(f"{gateway}:{topic}", inbound.deadman, topic, entry.stop, counters)
    return InboundPlan(
        topic=topic,
        name=inbound.topic.topic.value,
        type=entry.type,
        ttl=inbound.ttl.value if inbound.ttl else None,
        max_rate=inbound.max_rate.value if inbound.max_rate else None,
        deadman=deadman,
    )


def _deadman(name: str, deadman: InboundDeadman, topic: str, stop: bytes, counters: Counters) -> DeadmanPlan:
    for metric in ("deadman_active", "deadman_trips"):
        counters.index(metric, name)
    for metric in ("deadman_datagrams_sent", "deadman_send_errors"):
        counters.index(metric, name, topic)
    return DeadmanPlan(name, deadman.timeout.value, deadman.repeat.value, ((topic, stop),), deadman.at_start)


def _open_counters(counters: Counters, gateway: Gateway) -> None:
    name = gateway.name
    for metric in ("datagrams_received", "received_bytes", "gateway_clients"):
        counters.index(metric, name)
    counters.index("route_last_message_timestamp_seconds", name)
    for reason in GATEWAY_REJECT_REASONS:
        counters.index("datagrams_rejected", name, reason)
    for source in (ROS, CLIENTS):
        counters.index("messages_received", name, source)
    for metric in ("messages_sent", "messages_filtered"):
        counters.index(metric, name, CLIENTS)
    for reason in GATEWAY_DROP_REASONS:
        counters.index("messages_dropped", name, CLIENTS, reason)
    for metric in ("datagrams_sent", "sent_bytes"):
        counters.index(metric, name, gateway.transport.value.value)
    if gateway.zenoh is not None:
        counters.index("gateway_key_conflicts", name)
    for state in TOPIC_STATES:
        counters.index("gateway_topics", name, state)
    for reason in CLIENT_DROP_REASONS:
        counters.index("client_messages_dropped", name, reason)
