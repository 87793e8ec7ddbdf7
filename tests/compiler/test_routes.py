"""Checks of routes: sources, destinations, topics, and what several routes do to each other."""

from __future__ import annotations

import pytest

from router.compiler import Checked
from router.compiler.checked import CheckedSubscription, Target
from router.compiler.expressions.tree import Node, Read, Variable
from router.compiler.plan import Leaf, Record
from router.errors import Code, Diagnostic, Severity
from router.table.model.targets import OnLimit, Priority
from tests.compiler.conftest import CheckText

ROUTE = """
routes:
  detected_object:
    source: base
    collect: {collect}
    topics: [{{topic: a, type: comms/msg/DetectedObjectArray, fields: {fields}}}]
"""
COLLECT = "{by: frame_id, count: total_count, order: index, timeout: 1s}"


def check(check_text: CheckText, collect: str = COLLECT, fields: str = "{detections: items}") -> Checked:
    return check_text(ROUTE.format(collect=collect, fields=fields))


def findings(checked: Checked) -> list[Diagnostic]:
    return [finding for finding in checked.diagnostics if finding.code is not Code.UNCOVERED_PAYLOAD_CASE]


def test_topics_see_all_parts_their_number_and_the_fields_of_the_first(check_text: CheckText) -> None:
    checked = check(check_text, fields="{frame_id: 'frame_id if count > 1 else items[0].frame_id', detections: items}")
    assert findings(checked) == []
    (target,) = checked.routes[0].targets
    assert [row.target for row in target.rows] == ["frame_id", "detections"]


def test_one_part_does_not_see_the_others(check_text: CheckText) -> None:
    checked = check(check_text, collect=COLLECT.replace("total_count", "count"))
    assert [(finding.code, finding.message) for finding in findings(checked)] == [
        (Code.UNKNOWN_FIELD, "BasestationDetectedObject has no field 'count'")
    ]


@pytest.mark.parametrize(
    ("key", "value", "is_fine"),
    [
        ("frame_id", "str(frame_id)", True),
        ("frame_id", "type", True),
        ("frame_id", "confidence > 0.5", True),
        ("frame_id", "confidence", False),
        ("frame_id", "bbox", False),
        ("total_count", "4", True),
        ("total_count", "confidence", False),
        ("index", "index - 1", True),
        ("index", "str(index)", False),
    ],
)
def test_frames_are_named_by_whole_values_and_ordered_by_integers(
    check_text: CheckText, key: str, value: str, is_fine: bool
) -> None:
    found = findings(check(check_text, collect=COLLECT.replace(f": {key}", f': "{value}"')))
    assert [finding.code for finding in found] == ([] if is_fine else [Code.TYPE_MISMATCH])


# from ROS

OBJECTS = """
routes:
  detected_object:
    source: {{topic: a, type: comms/msg/DetectedObjectArray, when: {when}}}
    for_each: detections
    fields: {fields}
    destinations: [{{endpoint: base, when: {to_when}}}]
"""


def errors(checked: Checked) -> list[str]:
    return [str(finding) for finding in checked.diagnostics if finding.severity is Severity.ERROR]


def only_feed(checked: Checked) -> CheckedSubscription:
    assert errors(checked) == []
    ((feed,),) = (route.subscriptions for route in checked.routes)
    return feed


def objects(fields: str, when: str = "'true'", to_when: str = "'true'") -> str:
    return OBJECTS.format(fields=fields, when=when, to_when=to_when)


def shown(node: Node) -> str:
    """A variable, or a field of one."""
    if isinstance(node, Read):
        return f"{shown(node.holder)}.{node.field.name}"
    assert isinstance(node, Variable)
    return node.name


def source_of(plan: Record, name: str) -> str:
    """What fills a field."""
    made = next(inner for member, inner in plan.members if member.name == name)
    assert isinstance(made, Leaf)
    return shown(made.node)


def plan_of(feed: CheckedSubscription) -> Record:
    (served,) = feed.targets
    assert served.plan is not None
    return served.plan


def test_element_index_and_count_are_visible_beside_the_fields_of_the_message(check_text: CheckText) -> None:
    fields = "{frame_id: frame_id, total_count: count, index: index, confidence: item.confidence}"
    plan = plan_of(only_feed(check_text(objects(fields, "item.id > 0", "index < count"))))
    assert [source_of(plan, name) for name in ("frame_id", "total_count", "index", "confidence")] == [
        "message.frame_id",
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
        source: {topic: a, type: comms/msg/BasestationDetectedObject}
        for_each: "[bbox]"
        fields: {index: index, id: message.index}
        destinations: [base]
    """
    plan = plan_of(only_feed(check_text(routes)))
    assert (source_of(plan, "index"), source_of(plan, "id")) == ("index", "message.index")


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
    source: {{topic: a, type: {type}}}{ttl}
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
        source: [{topic: a, type: geometry_msgs/msg/Point32}, {topic: b, type: geometry_msgs/msg/Vector3}]
        fields: {x: float32(x)}
        destinations: [base, {endpoint: board, fields: {y: float32(y)}}]
        deadman: {none: not part of this test}
    """
    checked = check_text(routes)
    assert errors(checked) == []
    (route,) = checked.routes
    served = [(feed.topic.topic.value, target.label) for feed in route.subscriptions for target in feed.targets]
    assert served == [("a", "base"), ("a", "board"), ("b", "base"), ("b", "board")]
    assert [len(target.rows) for feed in route.subscriptions for target in feed.targets] == [1, 1, 1, 1]


# destinations

BOARD_AND_BASE = (
    "{board: {address: 127.0.0.2:8, kind: board, trim_trailing_zeros: true},"
    " base: {address: 127.0.0.3:9000, kind: basestation, bandwidth: 1kB/s},"
    " tool: {address: 127.0.0.4:9000, kind: tool}}"
)
INBOUND = """
routes:
  manual_brake:
    source: tool{priority}
    destinations: [board, {{endpoint: base, max_rate: 5 Hz, on_limit: latest}}]
    deadman: {{none: not part of this test}}
"""
OUTBOUND = """
routes:
  manual_brake:
    source: {{topic: a, type: std_msgs/msg/Bool}}{priority}
    fields: {{brake: data}}
    destinations: [board, {{endpoint: base, max_rate: 5 Hz, on_limit: latest}}]
    deadman: {{none: not part of this test}}
"""


def targets(check_text: CheckText, routes: str, priority: str = "") -> tuple[Target, Target]:
    said = f"\n    priority: {priority}" if priority else ""
    (route,) = check_text(routes.format(priority=said), endpoints=BOARD_AND_BASE).routes
    board, base = [*route.targets, *(target for feed in route.subscriptions for target in feed.targets)]
    return board, base


@pytest.mark.parametrize("routes", [INBOUND, OUTBOUND], ids=["inbound", "outbound"])
def test_what_goes_to_a_board_is_a_command_where_the_route_says_nothing(check_text: CheckText, routes: str) -> None:
    assert [target.priority for target in targets(check_text, routes)] == [Priority.COMMAND, Priority.TELEMETRY]
    assert [target.priority for target in targets(check_text, routes, "bulk")] == [Priority.BULK, Priority.BULK]


@pytest.mark.parametrize("routes", [INBOUND, OUTBOUND], ids=["inbound", "outbound"])
def test_what_feeds_a_deadman_is_a_command_whatever_it_goes_to(check_text: CheckText, routes: str) -> None:
    assert [target.is_command for target in targets(check_text, routes)] == [True, False]
    watched = routes.replace(
        "{{none: not part of this test}}",
        "{{timeout: 1s, send: {{manual_brake: {{}}}}, to: base, because: it is a test}}",
    )
    board, base = targets(check_text, f"{watched}    ttl: 1s\n")
    assert (board.is_command, base.is_command) == (True, True)
    assert base.priority is Priority.COMMAND


@pytest.mark.parametrize("routes", [INBOUND, OUTBOUND], ids=["inbound", "outbound"])
def test_target_has_what_its_endpoint_and_its_destination_say(check_text: CheckText, routes: str) -> None:
    board, base = targets(check_text, routes)
    assert board.endpoint is not None
    assert (board.endpoint.trim_trailing_zeros, board.is_deferred) == (True, False)
    assert (board.declared.max_rate, board.declared.on_limit) == (None, OnLimit.FIRST)
    assert base.endpoint is not None
    assert (base.endpoint.trim_trailing_zeros, base.endpoint.bandwidth, base.is_deferred) == (False, 1000, True)
    assert (base.declared.max_rate, base.declared.on_limit) == (5, OnLimit.LATEST)


def test_payload_is_made_for_ros_and_forwarded_from_udp(check_text: CheckText) -> None:
    assert [target.plan is None for target in targets(check_text, INBOUND)] == [True, True]
    assert [target.plan is None for target in targets(check_text, OUTBOUND)] == [False, False]


# across routes

TOOLS = (
    "{one: {address: 127.0.0.2:8, kind: tool}, two: {address: 127.0.0.3:8, kind: tool},"
    " three: {address: 127.0.0.4:8, kind: tool}}"
)
HOST = "{source: %s, destinations: [three]}"
TOPIC = "{source: {topic: %s, type: std_msgs/msg/Float32}, fields: {ph_value: data}, destinations: [%s]}"
PUBLISHED = "{source: %s, topics: [{topic: %s, type: std_msgs/msg/Float32, fields: {data: ph_value}}]}"


def codes(check_text: CheckText, *routes: str) -> list[Code]:
    text = f"routes: {{ph_info: [{', '.join(routes)}]}}"
    found = check_text(text, endpoints=TOOLS).diagnostics
    return [finding.code for finding in found if finding.code is not Code.UNCOVERED_PAYLOAD_CASE]


@pytest.mark.parametrize(
    ("first", "second", "is_clash"),
    [
        ("one", "two", False),
        ("one", "one", True),
        ("[one, two]", "two", True),
        ("any", "two", True),
        ("one", "any", True),
        ("any", "any", True),
    ],
)
def test_a_source_belongs_to_one_route_of_a_case(
    check_text: CheckText, first: str, second: str, is_clash: bool
) -> None:
    assert codes(check_text, HOST % first, HOST % second) == [Code.SOURCE_CLASH] * is_clash


@pytest.mark.parametrize(
    ("first", "second", "is_clash"), [("a", "b", False), ("a", "a", True), ("a", "/a", True), ("a", "~/a", False)]
)
def test_a_topic_feeds_one_route_of_a_case(check_text: CheckText, first: str, second: str, is_clash: bool) -> None:
    assert codes(check_text, TOPIC % (first, "one"), TOPIC % (second, "two")) == [Code.SOURCE_CLASH] * is_clash


def test_ros_is_no_part_of_any(check_text: CheckText) -> None:
    assert codes(check_text, HOST % "any", TOPIC % ("a", "three")) == []


@pytest.mark.parametrize(
    ("source", "published", "heard", "destination", "is_loop"),
    [
        ("one", "a", "a", "two", False),
        ("one", "a", "a", "one", True),
        ("[one, two]", "a", "/a", "two", True),
        ("one", "a", "b", "one", False),
    ],
)
def test_nobody_gets_back_through_a_topic_what_he_sent(
    check_text: CheckText, source: str, published: str, heard: str, destination: str, is_loop: bool
) -> None:
    found = codes(check_text, PUBLISHED % (source, published), TOPIC % (heard, destination))
    assert found == [Code.FORWARDING_LOOP] * is_loop


def test_an_answer_of_another_case_through_the_same_topic_is_no_loop(check_text: CheckText) -> None:
    asked, answered = PUBLISHED % ("one", "a"), (TOPIC % ("a", "one")).replace("ph_value", "pressure_kpa")
    found = check_text(f"routes: {{ph_info: {asked}, pressure_info: {answered}}}", endpoints=TOOLS).diagnostics
    assert {finding.code for finding in found} == {Code.UNCOVERED_PAYLOAD_CASE}
