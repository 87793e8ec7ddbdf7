"""Where the table says what a native operation does, for the log of what it refuses."""

from __future__ import annotations

from router.compiler.checked import Target
from router.declared import Op
from tests.compiler.conftest import CheckText


def lowered(check_text: CheckText, topic: str, payload: str = "imu_info") -> Target:
    checked = check_text(f"routes:\n  {payload}:\n    source: board\n    topics:\n      - {topic}\n")
    assert checked.program is not None, checked.diagnostics
    [target] = checked.program.lowered.to_topics[payload].targets.values()
    return target


def test_each_operation_has_the_place_of_what_it_fills(check_text: CheckText) -> None:
    target = lowered(
        check_text,
        """\
topic: a
        type: geometry_msgs/msg/TwistStamped
        when: accel_x > 1
        fields:
          twist.linear.x: 1 / accel_x
          twist.angular: {y: float32(accel_y)}
""",
    )
    nothing, condition, _, elements, *operations = target.places
    assert (nothing, condition, elements) == ("", "table.yaml:12:15: when", "")
    placed = dict(zip([each.kind for each in target.message], operations, strict=True))
    assert placed[Op.REAL_DIVIDE] == "table.yaml:14:27: twist.linear.x"
    assert placed[Op.FLOAT32] == "table.yaml:15:30: twist.angular.y"


def test_without_a_condition_there_is_no_place_for_it(check_text: CheckText) -> None:
    target = lowered(check_text, "{topic: a, type: std_msgs/msg/Float32, fields: {data: accel_x}}")
    assert target.places[:4] == ("", "", "", "")


def test_elements_of_lists_have_places_of_their_own(check_text: CheckText) -> None:
    target = lowered(
        check_text,
        """\
topic: a
        type: sensor_msgs/msg/Imu
        fields:
          orientation_covariance: [0, 0, 0, 0, 1 / accel_x, 0, 0, 0, sqrt(accel_y)]
""",
    )
    placed = dict(zip([each.kind for each in target.message], target.places[4:], strict=True))
    assert placed[Op.REAL_DIVIDE] == "table.yaml:13:48: orientation_covariance"
    assert placed[Op.SQRT] == "table.yaml:13:70: orientation_covariance"


def test_what_makes_frames_has_a_place(check_text: CheckText) -> None:
    checked = check_text(
        """\
routes:
  imu_info:
    source: board
    collect: {by: 1, count: 2, order: round(accel_x), timeout: 1s}
    topics: [{topic: a, type: std_msgs/msg/Float32, fields: {data: "items[1].accel_x"}}]
"""
    )
    assert checked.program is not None, checked.diagnostics
    (target,) = checked.program.lowered.to_topics["imu_info"].targets.values()
    assert target.places[2] == "table.yaml:9:5: collect"
