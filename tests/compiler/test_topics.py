"""ROS topics of a table: names, complete QoS, and who hears whom."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.topics import PROFILES, qos_of, resolved, topic_name_finding
from router.errors import Code, Located, SourceSpan
from router.table.model.settings import NodeSettings
from router.table.model.targets import Qos, Topic
from tests.compiler.conftest import CheckText

SPAN = SourceSpan("table.yaml")


def topic(name: str = "a", depth: int | None = None, qos: Qos | None = None) -> Topic:
    return Topic(
        topic=Located(name, SPAN),
        span=SPAN,
        type=Located("std_msgs/msg/Bool", SPAN),
        queue_depth=Located(depth, SPAN) if depth else None,
        qos=qos,
    )


@pytest.mark.parametrize("name", ["a", "/a", "~/a", "a/b_c/d2", "/a/b", "_a", "A", "a" * 247])
def test_topic_name_is_accepted(name: str) -> None:
    assert topic_name_finding(topic(name)) is None


@pytest.mark.parametrize(
    "name", ["", "/", "~", "~a", "a/", "a//b", "2a", "a/2b", "a b", "a-b", "é", "a.b", "{node}/a", "a\n", "a" * 248]
)
def test_topic_name_is_refused(name: str) -> None:
    finding = topic_name_finding(topic(name))
    assert finding is not None
    assert finding.code is Code.BAD_TOPIC_NAME


@given(st.text("aZ09_/~{}-. é", max_size=8))
def test_rclpy_is_of_the_same_opinion_on_topic_names(name: str) -> None:
    rclpy = pytest.importorskip("rclpy.validate_topic_name")
    exceptions = pytest.importorskip("rclpy.exceptions")
    # Tables have no use for substitutions and the node itself. What `~a` and `a//_` lack, rclpy finds out later.
    if "{" in name or "//_" in name or (name.startswith("~") and not name.startswith("~/")):
        return
    try:
        accepted = rclpy.validate_topic_name(name)
    except exceptions.InvalidTopicNameException:
        accepted = False
    assert (topic_name_finding(topic(name)) is None) == accepted


@pytest.mark.parametrize(
    ("name", "namespace", "absolute"),
    [
        ("a", "/", "/a"),
        ("a", "/rover", "/rover/a"),
        ("/a", "/rover", "/a"),
        ("~/a", "/", "/router/a"),
        ("~/a", "/rover/", "/rover/router/a"),
    ],
)
def test_topic_name_is_resolved_as_ros_does(name: str, namespace: str, absolute: str) -> None:
    assert resolved(name, NodeSettings("router", namespace)) == absolute


def test_profiles_are_those_of_rmw() -> None:
    profiles = pytest.importorskip("rclpy.qos")
    names = {name.lower(): profile for name, profile in profiles.QoSPresetProfiles.__members__.items()}
    for name, ours in PROFILES.items():
        theirs = names[name].value
        assert ours.reliability == theirs.reliability.name.lower(), name
        assert ours.durability == theirs.durability.name.lower(), name
        if name != "system_default":
            assert ours.history == theirs.history.name.lower(), name
            assert ours.depth == theirs.depth, name


def test_profile_is_completed_by_what_the_table_says() -> None:
    qos = Qos(SPAN, profile=Located("sensor_data", SPAN), durability=Located("transient_local", SPAN),
              deadline=Located(500, SPAN))  # fmt: skip
    plan = qos_of(topic(depth=7, qos=qos))
    assert (plan.reliability, plan.durability, plan.depth, plan.deadline) == ("best_effort", "transient_local", 7, 500)
    assert plan.serves_late_joiners


def test_queue_depth_alone_is_the_default_profile_with_that_depth() -> None:
    plan = qos_of(topic(depth=3))
    assert (plan.reliability, plan.history, plan.depth) == ("reliable", "keep_last", 3)


# several mentions of one topic

IN = """
routes:
  ph_info:
    source: board
    topics: [{{topic: a, type: std_msgs/msg/Float32, {first}, fields: {{data: ph_value}}}}]
  pressure_info:
    source: board
    topics: [{{topic: {name}, type: {type}, {second}, fields: {{data: pressure_kpa}}}}]
"""
BACK = """
routes:
  ph_info:
    source: board
    topics: [{{topic: a, type: comms/msg/ArmBoardTargetMovement, {first}, fields: {{}}}}]
  arm_target:
    source: {{topic: /a, type: comms/msg/ArmBoardTargetMovement, {second}}}
    fields: auto
    destinations: [board]
"""


def codes(check_text: CheckText, text: str, **parts: str) -> list[Code]:
    found = check_text(text.format(**parts)).diagnostics
    return [finding.code for finding in found if finding.code in (Code.QOS_CONFLICT, Code.TOPIC_TYPE_CLASH)]


@pytest.mark.parametrize(
    ("name", "type_name", "second", "expected"),
    [
        ("a", "std_msgs/msg/Float32", "queue_depth: 5", []),
        ("/a", "std_msgs/msg/Float32", "queue_depth: 5", []),
        ("~/a", "std_msgs/msg/Float64", "queue_depth: 6", []),
        ("a", "std_msgs/msg/Float64", "queue_depth: 5", [Code.TOPIC_TYPE_CLASH]),
        ("/a", "std_msgs/msg/Float64", "queue_depth: 5", [Code.TOPIC_TYPE_CLASH]),
        ("a", "std_msgs/msg/Float32", "queue_depth: 6", [Code.QOS_CONFLICT]),
        ("a", "std_msgs/msg/Float32", "qos: {depth: 5}", []),
        ("a", "std_msgs/msg/Float32", "qos: {depth: 5, reliability: best_effort}", [Code.QOS_CONFLICT]),
    ],
)
def test_routes_that_publish_one_topic_agree(
    check_text: CheckText, name: str, type_name: str, second: str, expected: list[Code]
) -> None:
    assert codes(check_text, IN, name=name, type=type_name, first="queue_depth: 5", second=second) == expected


@pytest.mark.parametrize(
    ("published", "subscribed", "is_heard"),
    [
        ("queue_depth: 1", "queue_depth: 9", True),
        ("qos: {profile: sensor_data}", "queue_depth: 1", False),
        ("queue_depth: 1", "qos: {profile: sensor_data}", True),
        ("queue_depth: 1", "qos: {durability: transient_local}", False),
        ("qos: {durability: transient_local}", "queue_depth: 1", True),
        ("qos: {deadline: 100ms}", "qos: {deadline: 200ms}", True),
        ("qos: {deadline: 200ms}", "qos: {deadline: 100ms}", False),
        ("queue_depth: 1", "qos: {deadline: 100ms}", False),
        ("qos: {liveliness: automatic}", "qos: {liveliness: manual_by_topic}", False),
        ("qos: {liveliness: manual_by_topic}", "qos: {liveliness: automatic}", True),
        ("qos: {liveliness_lease_duration: 2s}", "qos: {liveliness_lease_duration: 1s}", False),
        ("qos: {liveliness_lease_duration: 1s}", "qos: {liveliness_lease_duration: 2s}", True),
    ],
)
def test_subscriber_of_our_own_publisher_can_hear_it(
    check_text: CheckText, published: str, subscribed: str, is_heard: bool
) -> None:
    expected = [] if is_heard else [Code.QOS_CONFLICT]
    assert codes(check_text, BACK, first=published, second=subscribed) == expected


@pytest.mark.parametrize(
    ("qos", "has_conflict"),
    [
        ("queue_depth: 5, qos: {depth: 5}", False),
        ("queue_depth: 5, qos: {depth: 6}", True),
        ("queue_depth: 5, qos: {history: keep_all}", True),
        ("qos: {history: keep_all}", True),
        ("qos: {history: keep_all, reliability: best_effort}", False),
        ("qos: {history: keep_all, depth: 3}", True),
        ("qos: {durability: transient_local}", False),
        ("qos: {durability: transient_local, reliability: best_effort}", True),
        ("qos: {profile: sensor_data, durability: transient_local}", True),
    ],
)
def test_one_topic_does_not_contradict_itself(check_text: CheckText, qos: str, has_conflict: bool) -> None:
    text = """
    routes:
      ph_info:
        source: board
        topics: [{{topic: a, type: std_msgs/msg/Float32, {qos}, fields: {{data: ph_value}}}}]
    """
    assert codes(check_text, text, qos=qos) == [Code.QOS_CONFLICT] * has_conflict
