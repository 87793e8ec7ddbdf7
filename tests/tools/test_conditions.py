"""Expressions of the table's language over payloads, as `router tap --where` asks them."""

from __future__ import annotations

import pytest

from router.errors import UsageError
from router.tools.conditions import Condition
from tests.observe.fake_running import sim_program

CASES = sim_program().envelope.cases


def holds(text: str, case: str, source: str = "sensor_board", **fields: object) -> bool:
    return Condition(text, [CASES[case]]).holds(case, CASES[case].message_class(**fields), source, 0)


@pytest.mark.parametrize(
    ("text", "is_true"),
    [
        ("accel_z > 9", True),
        ("accel_z > 10", False),
        ("abs(accel_x) < 1 and is_calibrated", True),
        ("state == SensorState.SENSOR_OPERATING", True),
        ("source == 'sensor_board'", True),
        ("source == 'arm_board'", False),
        ("received_at == 0", False),
    ],
)
def test_a_condition_is_an_expression_over_the_payload(text: str, is_true: bool) -> None:
    if "received_at" in text:
        with pytest.raises(UsageError, match="--where: "):
            holds(text, "imu_info")
        return
    assert holds(text, "imu_info", accel_z=9.5, is_calibrated=True, state=1) == is_true


def test_cases_without_the_field_are_left_out() -> None:
    condition = Condition("satellites < 4", list(CASES.values()))
    assert condition.cases == {"gps_info"}
    assert not condition.holds("imu_info", CASES["imu_info"].message_class(), "sensor_board", 0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("satelites < 4", "--where: SensorBoardGPSInfo has no field 'satelites'; did you mean 'satellites'?"),
        ("satellites", "--where: it is int32, not a bool; compare something, as in speed > 0"),
        ("satellites <", "--where: not an expression: invalid syntax"),
        ("__import__('os')", "--where: "),
    ],
)
def test_what_is_no_condition_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as refused:
        Condition(text, list(CASES.values()) if "<" in text else [CASES["gps_info"]])
    assert str(refused.value).startswith(complaint)


def test_where_it_cannot_be_computed_it_does_not_hold_and_is_remembered() -> None:
    condition = Condition("altitude / speed > 1", [CASES["gps_info"]])
    assert not condition.holds("gps_info", CASES["gps_info"].message_class(), "sensor_board", 0)
    assert condition.failure.startswith("gps_info: ")
