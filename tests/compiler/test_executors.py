"""Who serves a target: one executor for each endpoint, topic or source topic, and why."""

from __future__ import annotations

import pytest

from router.compiler import check_table, lowering
from router.compiler.executors import executors
from router.compiler.lookup import Definitions
from router.compiler.lowering.operations import Code
from router.compiler.program import Program
from tests.compiler.conftest import CheckText
from tests.tables import ROUTES

ENDPOINTS = """{
  board: {address: 127.0.0.2:8, kind: board},
  base: {address: 127.0.0.3:9000, kind: basestation},
  tool: {address: 127.0.0.4:9000, kind: tool, trim_trailing_zeros: true},
  slow: {address: 127.0.0.5:9000, kind: tool, bandwidth: 10kB/s}}"""


def told(check_text: CheckText, routes: str) -> dict[str, str]:
    """`route > endpoint` and the reason with its line, empty for the carrier."""
    checked = check_text(routes, endpoints=" ".join(ENDPOINTS.split()))
    assert not checked.has_errors, checked.diagnostics
    return {
        f"{route} > {endpoint}": f"{executor.reason} at line {executor.span.line}" if executor.span else ""
        for (route, topic, endpoint), executor in executors(checked.routes).items()
        if topic is None
    }


def test_what_is_forwarded_is_carried_also_with_a_condition(check_text: CheckText) -> None:
    routes = """\
        routes:
          manual_drive:
            source: base
            destinations: [{endpoint: board, max_rate: 10 Hz}, {endpoint: tool, when: turn > 1}]
            ttl: 200ms
            deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [board]}
          imu_info:
            source: board
            destinations: [base]
            topics: [{topic: imu, type: std_msgs/msg/Float32, fields: {data: accel_x}, when: accel_x > 1}]
    """
    assert told(check_text, routes) == {"manual_drive > board": "", "manual_drive > tool": "", "imu_info > base": ""}


def test_one_that_needs_python_has_all_others_of_its_endpoint_go_there(check_text: CheckText) -> None:
    routes = """\
        routes:
          ph_info: {source: board, destinations: [base, tool]}
          imu_info:
            source: board
            destinations: [{endpoint: base, max_rate: 5 Hz, on_limit: latest}]
    """
    assert told(check_text, routes) == {
        "ph_info > base": "it shares 'base' with imu_info, which needs Python at line 10",
        "ph_info > tool": "",
        "imu_info > base": "`on_limit: latest` needs it at line 10",
    }


def test_a_budget_needs_python(check_text: CheckText) -> None:
    routes = "routes: {ph_info: {source: board, destinations: [slow]}}"
    assert told(check_text, routes) == {"ph_info > slow": "the bandwidth of 'slow' needs it at line 5"}


def test_routes_from_ros_and_ignored_ones_have_no_part_in_it(check_text: CheckText) -> None:
    routes = """\
        routes:
          ph_info: {ignore: nobody wants it}
          imu_info:
            source: {topic: imu, type: std_msgs/msg/Float32}
            destinations: [{endpoint: tool, max_rate: 5 Hz, on_limit: latest}]
            fields: {accel_x: data}
          gps_info: {source: board, destinations: [tool]}
    """
    assert told(check_text, routes) == {"gps_info > tool": ""}


# ---- topics


def published(check_text: CheckText, routes: str) -> dict[str, str]:
    """`route > topic` and the reason with its line, empty for the carrier."""
    checked = check_text(routes)
    assert checked.program is not None, checked.diagnostics
    return {
        f"{route} > {topic}": f"{executor.reason} at line {executor.span.line}" if executor.span else ""
        for (route, topic, endpoint), executor in checked.program.executors.items()
        if endpoint is None
    }


def test_a_topic_is_published_by_the_carrier_with_condition_and_rate(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: board
            topics:
              - {topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}, when: accel_x > 1, max_rate: 10 Hz}
              - {topic: b, type: std_msgs/msg/String, fields: {data: "'x: ' + str(round(accel_x))"}}
            ttl: 200ms
    """
    assert published(check_text, routes) == {
        "imu_info > a": "",
        "imu_info > b": "",
    }


def test_all_routes_of_a_topic_have_one_executor_and_other_topics_of_them_their_own(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: board
            topics:
              - {topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}}
              - {topic: b, type: std_msgs/msg/Float32, fields: {data: accel_x}}
          ph_info:
            source: board
            topics: [{topic: a, type: std_msgs/msg/Float32, fields: {data: ph_value}, max_rate: 1 Hz, on_limit: latest}]
    """
    assert published(check_text, routes) == {
        "imu_info > a": "it shares 'a' with ph_info, which needs Python at line 14",
        "imu_info > b": "",
        "ph_info > a": "`on_limit: latest` needs it at line 14",
    }


# ---- messages from ROS


def test_all_that_a_source_topic_feeds_has_one_executor(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: {topic: imu, type: std_msgs/msg/Float32, when: data > 0}
            destinations: [{endpoint: tool, when: data > 1, fields: {accel_x: data * 2}}]
          ph_info:
            source: [{topic: imu, type: std_msgs/msg/Float32}, {topic: ph, type: std_msgs/msg/Float32}]
            destinations: [slow]
            fields: {ph_value: data}
          gps_info:
            source: {topic: gps, type: std_msgs/msg/Float32MultiArray}
            for_each: data
            destinations: [{endpoint: tool, fields: {altitude: item}}]
    """
    checked = check_text(routes, endpoints=" ".join(ENDPOINTS.split()))
    assert checked.program is not None, checked.diagnostics
    slow = "the bandwidth of 'slow' needs it"
    assert {key: executor.reason for key, executor in checked.program.executors.items()} == {
        ("imu_info", "imu", "tool"): slow,
        ("ph_info", "imu", "slow"): slow,
        ("ph_info", "ph", "slow"): slow,
        ("gps_info", "gps", "tool"): None,
    }


# ---- what is lowered


def test_what_the_carrier_serves_is_lowered_by_what_feeds_it(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: board
            destinations: [base, {endpoint: tool, when: accel_x > 1}]
            topics:
              - {topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}}
              - {topic: b, type: std_msgs/msg/Float32, fields: {data: accel_x}, max_rate: 1 Hz, on_limit: latest}
          ph_info: {source: board, destinations: [base]}
          gps_info:
            source: {topic: gps, type: std_msgs/msg/Float32}
            destinations: [base, {endpoint: tool, fields: {altitude: data * 2}}]
            fields: {altitude: data}
    """
    program = check_text(routes, endpoints=" ".join(ENDPOINTS.split())).program
    assert program is not None
    lowered = program.lowered
    assert {route: list(each.targets) for route, each in lowered.conditions.items()} == {"imu_info": ["tool"]}
    assert {route: list(each.targets) for route, each in lowered.topics.items()} == {"imu_info": ["a"]}
    (feed,) = lowered.from_ros["gps"]
    assert (feed.route, list(feed.targets)) == ("gps_info", ["base", "tool"])


def test_each_target_is_lowered_once(definitions: Definitions, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    kind = lowering.LoweredTarget

    def counted(label: str, condition: Code, message: Code, places: tuple[str, ...]) -> lowering.LoweredTarget:
        made.append(places[-1])
        return kind(label, condition, message, places)

    monkeypatch.setattr(lowering, "LoweredTarget", counted)
    program = check_table(ROUTES / "rover.yaml", {}, definitions).program
    assert program is not None
    assert made
    assert len(made) == len(set(made))


def test_the_carrier_serves_all_targets_of_the_rover(rover_program: Program) -> None:
    targets = {
        (handler.route, target.label if target.is_topic else handler.topic, None if target.is_topic else target.label)
        for handler in rover_program.handlers
        for target in handler.targets
    }
    assert len(targets) == 49
    assert {key for key, executor in rover_program.executors.items() if executor.is_carrier} == targets
