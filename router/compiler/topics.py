"""ROS topics one by one: their names and their QoS. Who meets on one topic is for `meetings`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

from router.compiler.program import QosPlan
from router.errors import Code, Diagnostic, SourceSpan
from router.table.model import Located, NodeSettings, Topic

DEFAULT_DEPTH = 10
LONGEST_NAME = 247
DIAGNOSTICS, DIAGNOSTICS_TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)

PROFILES: Mapping[str, QosPlan] = {
    "default": QosPlan("reliable", "volatile", "keep_last", DEFAULT_DEPTH),
    "sensor_data": QosPlan("best_effort", "volatile", "keep_last", 5),
    "services_default": QosPlan("reliable", "volatile", "keep_last", DEFAULT_DEPTH),
    "parameters": QosPlan("reliable", "volatile", "keep_last", 1000),
    "parameter_events": QosPlan("reliable", "volatile", "keep_last", 1000),
    "action_status_default": QosPlan("reliable", "transient_local", "keep_last", 1),
    "system_default": QosPlan("system_default", "system_default", "system_default", DEFAULT_DEPTH),
    "best_available": QosPlan("best_available", "best_available", "keep_last", DEFAULT_DEPTH),
}
"""rmw's profiles by rclpy's names."""


def diagnostics_topic(node: NodeSettings) -> Topic | None:
    """What ROS's monitors read, where the table asks for it."""
    if node.diagnostics is None:
        return None
    span = node.diagnostics
    return Topic(Located(DIAGNOSTICS, span), Located(DIAGNOSTICS_TYPE, span), span)


def topic_name_finding(topic: Topic) -> Diagnostic | None:
    name = topic.topic.value
    if not _NAME.fullmatch(name):
        hint = "names are letters, digits and '_' with '/' between; no part begins with a digit"
        return Diagnostic(topic.topic.span, Code.BAD_TOPIC_NAME, f"'{name}' is not a ROS topic name", hint)
    if len(name) > LONGEST_NAME:
        message = f"a ROS topic name has at most {LONGEST_NAME} characters, this one {len(name)}"
        return Diagnostic(topic.topic.span, Code.BAD_TOPIC_NAME, message)
    return None


def resolved(name: str, node: NodeSettings) -> str:
    """The absolute name under which ROS knows a topic of this node."""
    namespace = node.namespace.rstrip("/")
    if name.startswith("~/"):
        return f"{namespace}/{node.name}/{name[2:]}"
    return name if name.startswith("/") else f"{namespace}/{name}"


def qos_of(topic: Topic) -> QosPlan:
    """The complete QoS: the profile, what the table adds to it, and `queue_depth` as its depth."""
    given = topic.qos
    plan = PROFILES[given.profile.value if given and given.profile else "default"]
    words = ("reliability", "durability", "history", "depth", "deadline", "lifespan", "liveliness",
             "liveliness_lease_duration")  # fmt: skip
    said = {word: getattr(given, word).value for word in words if given and getattr(given, word) is not None}
    if topic.queue_depth is not None:
        said["depth"] = topic.queue_depth.value
    return replace(plan, **said)


def qos_findings(topic: Topic, *, publishes: bool) -> Iterator[Diagnostic]:
    """What one topic's QoS says twice, can never mean, or would let a subscriber do to the router."""
    given = topic.qos
    if given is None:
        return
    plan = qos_of(topic)

    def conflict(span: SourceSpan, message: str, hint: str) -> Diagnostic:
        return Diagnostic(span, Code.QOS_CONFLICT, message, hint)

    if given.depth and topic.queue_depth and given.depth.value != topic.queue_depth.value:
        message = f"depth {given.depth.value} contradicts queue_depth {topic.queue_depth.value}"
        yield conflict(given.depth.span, message, "say it once")
    if given.history and given.history.value == "keep_all":
        if depth := given.depth or topic.queue_depth:
            yield conflict(depth.span, "history keep_all has no depth", "leave the depth out, or say keep_last")
        elif publishes and plan.reliability != "best_effort":
            # The middleware makes a reliable publisher wait for a full history: measured, 100 ms per message.
            message = "one subscriber that stalls would stop the router, which keeps all for it"
            yield conflict(given.history.span, message, "say a depth instead, or reliability: best_effort")
    if plan.durability == "transient_local" and plan.reliability == "best_effort":
        span = given.durability or given.reliability or given.profile
        yield conflict(span.span if span else given.span, "late joiners get nothing from a best_effort publisher",
                       "transient_local goes with reliability: reliable")  # fmt: skip
