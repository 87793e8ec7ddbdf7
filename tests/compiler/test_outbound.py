"""Routes from ROS: what expressions see, what `auto` takes from, and how old a message is."""

from __future__ import annotations

import ast

import pytest

from router.compiler import Checked
from router.compiler.checked import CheckedFeed
from router.compiler.plan import Leaf, Record
from router.errors import Code, Severity
from tests.compiler.conftest import CheckText

OBJECTS = """
routes:
  detected_object:
    source: ros
    for_each: detections
    topics: [{{topic: a, type: comms/msg/DetectedObjectArray, when: {when}}}]
    fields: {fields}
    destinations: [{{endpoint: base, when: {to_when}}}]
"""


def errors(checked: Checked) -> list[str]:
    return [str(finding) for finding in checked.diagnostics if finding.severity is Severity.ERROR]


def only_feed(checked: Checked) -> CheckedFeed:
    assert errors(checked) == []
    ((feed,),) = (route.feeds for route in checked.routes)
    return feed


def objects(fields: str, when: str = "'true'", to_when: str = "'true'") -> str:
    return OBJECTS.format(fields=fields, when=when, to_when=to_when)


def source_of(plan: Record, name: str) -> str:
    """What fills a field, as code."""
    made = next(inner for member, inner in plan.members if member.name == name)
    assert isinstance(made, Leaf)
    return ast.unparse(made.node)


def plan_of(feed: CheckedFeed) -> Record:
    (served,) = feed.targets
    assert served.target.plan is not None
    return served.target.plan


def test_element_index_and_count_are_visible_beside_the_fields_of_the_message(check_text: CheckText) -> None:
    fields = "{frame_id: frame_id, total_count: count, index: index, confidence: item.confidence}"
    plan = plan_of(only_feed(check_text(objects(fields, "item.id > 0", "index < count"))))
    assert [source_of(plan, name) for name in ("frame_id", "total_count", "index", "confidence")] == [
        "m_frame_id",
        "count",
        "index",
        "item.confidence",
    ]


def test_auto_takes_the_fields_of_the_element(check_text: CheckText) -> None:
    plan = plan_of(only_feed(check_text(objects("auto"))))
    assert source_of(plan, "frame_id") == "item.frame_id"


def test_names_of_for_each_win_over_fields_which_the_message_still_reaches(check_text: CheckText) -> None:
    routes = """
    routes:
      detected_object:
        source: ros
        for_each: "[bbox]"
        topics: [{topic: a, type: comms/msg/BasestationDetectedObject}]
        fields: {index: index, id: message.index}
        destinations: [base]
    """
    plan = plan_of(only_feed(check_text(routes)))
    assert (source_of(plan, "index"), source_of(plan, "id")) == ("index", "m_index")


def test_list_itself_does_not_see_its_elements(check_text: CheckText) -> None:
    routes = objects("auto").replace("for_each: detections", "for_each: item.detections")
    assert [finding.code for finding in check_text(routes).diagnostics if "item" in finding.message] == [
        Code.UNKNOWN_FIELD
    ]


@pytest.mark.parametrize(("written", "what"), [("frame_id", "not uint32"), ("'[]'", "not an empty one")])
def test_for_each_takes_a_list_and_what_depends_on_it_is_no_finding(
    check_text: CheckText, written: str, what: str
) -> None:
    routes = objects("{index: index}").replace("for_each: detections", f"for_each: {written}")
    (error,) = errors(check_text(routes))
    assert "'for_each' takes a list" in error
    assert what in error


STAMPED = """
routes:
  rover_localization:
    source: ros{ttl}
    topics: [{{topic: a, type: {type}}}]
    fields: {{x: 1}}
    destinations: [base]
"""


@pytest.mark.parametrize(
    ("ttl", "type_name", "has_stamp"),
    [
        ("\n    ttl: 1s", "geometry_msgs/msg/PointStamped", True),
        ("\n    ttl: 1s", "geometry_msgs/msg/Point", False),
        ("", "geometry_msgs/msg/PointStamped", False),
    ],
)
def test_stamp_counts_where_there_is_a_ttl_and_the_type_has_one(
    check_text: CheckText, ttl: str, type_name: str, has_stamp: bool
) -> None:
    feed = only_feed(check_text(STAMPED.format(ttl=ttl, type=type_name)))
    assert (feed.stamp is not None) == has_stamp


def test_each_topic_feeds_each_destination(check_text: CheckText) -> None:
    routes = """
    routes:
      rover_localization:
        source: ros
        topics: [{topic: a, type: geometry_msgs/msg/Point32}, {topic: b, type: geometry_msgs/msg/Vector3}]
        fields: {x: float32(x)}
        destinations: [base, {endpoint: board, fields: {y: float32(y)}}]
        deadman: not part of this test
    """
    checked = check_text(routes)
    assert errors(checked) == []
    (route,) = checked.routes
    served = [(feed.topic.topic.value, target.target.name) for feed in route.feeds for target in feed.targets]
    assert served == [("a", "base"), ("a", "board"), ("b", "base"), ("b", "board")]
    assert [len(target.rows) for feed in route.feeds for target in feed.targets] == [1, 1, 1, 1]
