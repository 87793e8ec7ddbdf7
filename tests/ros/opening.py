"""A ROS edge with topics of strings, for tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rclpy.serialization import serialize_message
from std_msgs.msg import String

from router.compiler.compiled_table import QosPlan, TopicPlan
from router.errors import SourceSpan
from router.ros.router_node import RouterNode
from router.table.model.settings import NodeSettings

STRING = "std_msgs/msg/String"
RELIABLE = QosPlan("reliable", "volatile", "keep_last", 10)
SPAN = SourceSpan("routes/rover.yaml", 40, 16, 24)


def cdr(text: str) -> bytes:
    """The CDR bytes of a std_msgs/msg/String."""
    return padded(serialize_message(String(data=text)))


def padded(data: bytes) -> bytes:
    """The bytes as DDS delivers them: padded to a multiple of four."""
    return bytes(data) + bytes(-len(data) % 4)


HELLO = cdr("hello, rover")


def string_topic(qos: QosPlan = RELIABLE, topic: str = "greeting") -> TopicPlan:
    return TopicPlan(topic, topic, STRING, qos, {STRING: (("data", "string"),)})


def open_ros(
    *plans: TopicPlan,
    subscriptions: Sequence[TopicPlan] = (),
    args: Sequence[str] = (),
    incompatible: Callable[[str, str, int], None] = lambda *_: None,
) -> RouterNode:
    spans = {plan.label: SPAN for plan in (*plans, *subscriptions)}
    return RouterNode(NodeSettings("router_test", "/"), plans, subscriptions, spans, args, incompatible)
