"""Who sends a datagram that comes from UDP, and who publishes: one executor for each endpoint or topic, and why."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from router.compiler import Checked, lowering
from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.executors import executors
from router.compiler.program import Program
from router.types.protobuf import Envelope
from tests.compiler.conftest import CheckText

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
        for (route, _, endpoint), executor in executors(checked.routes).items()
    }


def test_what_is_forwarded_unchanged_is_carried(check_text: CheckText) -> None:
    routes = """\
        routes:
          manual_drive:
            source: base
            destinations: [{endpoint: board, max_rate: 10 Hz}, tool]
            ttl: 200ms
            deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [board]}
          imu_info:
            source: board
            destinations: [base]
            topics: [{topic: imu, type: std_msgs/msg/Float32, fields: {data: accel_x}, when: accel_x > 1}]
    """
    assert told(check_text, routes) == {"manual_drive > board": "", "manual_drive > tool": "", "imu_info > base": ""}


@pytest.mark.parametrize(
    ("destination", "reason"),
    [
        ("{endpoint: base, when: accel_x > 1}", "`when: accel_x > 1` needs it at line 10"),
        ("{endpoint: base, max_rate: 5 Hz, on_limit: latest}", "`on_limit: latest` needs it at line 10"),
    ],
)
def test_one_that_needs_python_has_all_others_of_its_endpoint_go_there(
    check_text: CheckText, destination: str, reason: str
) -> None:
    routes = f"""\
        routes:
          ph_info: {{source: board, destinations: [base, tool]}}
          imu_info:
            source: board
            destinations: [{destination}]
    """
    assert told(check_text, routes) == {
        "ph_info > base": "it shares 'base' with imu_info, which needs Python at line 10",
        "ph_info > tool": "",
        "imu_info > base": reason,
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
            destinations: [{endpoint: tool, when: data > 1}]
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
        "imu_info > b": ("`data: 'x: ' + str(round(accel_x))` needs it: only Python writes a float as text at line 11"),
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


def test_a_route_has_what_is_lowered_of_it(check_text: CheckText) -> None:
    routes = """\
        routes:
          imu_info:
            source: board
            topics:
              - {topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}}
              - {topic: b, type: std_msgs/msg/Float32, fields: {data: accel_x}, max_rate: 1 Hz, on_limit: latest}
          ph_info: {source: board, destinations: [base]}
    """
    program = check_text(routes).program
    assert program is not None
    assert {route: list(lowered.targets) for route, lowered in program.lowered.items()} == {"imu_info": ["a"]}


def test_of_the_rovers_targets_all_but_one_are_the_carriers(rover_program: Program) -> None:
    found = rover_program.executors
    topics = [key for key in found if key[2] is None]
    assert len(topics) == 28
    assert all(found[key].is_carrier for key in topics)
    targets = {
        (handler.route, target.label if target.is_topic else handler.topic, None if target.is_topic else target.label)
        for handler in rover_program.handlers
        for target in handler.targets
    }
    assert targets == found.keys()
    needs_python = {key: executor.reason for key, executor in found.items() if not executor.is_carrier}
    assert (len(found), needs_python) == (
        49,
        {("detected_object_from_ros_2", "detected_objects", "basestation"): "`for_each` needs it"},
    )


def test_each_topic_is_lowered_once(rover: Checked, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[str, str]] = []
    lower = lowering.lower

    def counted(checked: CheckedRoute, targets: Sequence[CheckedTarget], envelope: Envelope) -> lowering.LoweredRoute:
        made.extend((checked.route.name, target.label) for target in targets)
        return lower(checked, targets, envelope)

    monkeypatch.setattr(lowering, "lower", counted)
    assert rover.program_in(None) is not None
    assert made
    assert len(made) == len(set(made))
