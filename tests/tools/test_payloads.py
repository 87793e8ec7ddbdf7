from __future__ import annotations

import math
from typing import Any

import pytest
from google.protobuf.json_format import MessageToDict

from router.datagrams import Wire, wire_of_protos
from router.tools.payloads import PayloadModel, pose
from router.types.protobuf import PayloadCase
from tests import everything
from tests.tables import PROTOS

EPOCH = 1_700_000_000.0
MODE_AUTO = 1


def test_speed_heading_and_turn_rate_belong_to_the_walked_path() -> None:
    step = 1e-3
    for t in (0.0, 11.0, 42.0, 77.7):
        here, there = pose(t, EPOCH), pose(t + step, EPOCH)
        north, east = there.north - here.north, there.east - here.east
        assert math.hypot(north, east) / step == pytest.approx(here.speed, rel=1e-2)
        assert math.degrees(math.atan2(east, north)) % 360 == pytest.approx(here.heading, abs=0.1)
        assert (there.heading - here.heading) / step == pytest.approx(here.turn_rate, rel=2e-2, abs=1e-2)


@pytest.fixture(scope="module")
def rover() -> Wire:
    return wire_of_protos(PROTOS)


def sequence(case: PayloadCase, seed: int, times: tuple[float, ...] = (0.0, 0.5, 1.0)) -> list[Any]:
    model = PayloadModel(case.name, case.type, seed)
    messages = []
    for t in times:
        message = case.message_class()
        model.fill(message, pose(t, EPOCH))
        messages.append(message)
    return messages


def test_the_same_seed_gives_the_same_values_and_another_others(rover: Wire) -> None:
    for case in rover.envelopes.first.cases.values():
        assert sequence(case, seed=7) == sequence(case, seed=7)
    assert sequence(rover.case("imu_info"), seed=1) != sequence(rover.case("imu_info"), seed=2)


def test_every_field_of_a_case_without_a_model_is_filled(every_kind: PayloadCase) -> None:
    first, _, last = sequence(every_kind, seed=1, times=(0.0, 3.0, 7.0))
    assert first.single != last.single
    assert first.text == "every_kind 0.0"
    assert len(first.points) == 3
    assert len(first.numbers) == 3
    assert first.HasField("point")
    assert first.mode in (0, 1, -2)


def test_well_known_types_have_values_with_a_json_form() -> None:
    for case in everything.wire().envelopes.first.cases.values():
        for message in sequence(case, seed=1, times=(0.0, 1.25, 59.9999999999)):
            MessageToDict(message)
    at = sequence(everything.wire().case("known"), seed=1, times=(1.25,))[0]
    assert (at.at.ToNanoseconds(), at.lasts.ToNanoseconds()) == (1_700_000_001_250_000_000, 1_250_000_000)


def test_payloads_fit_the_envelope_that_boards_take(rover: Wire) -> None:
    for case in rover.envelopes.first.cases.values():
        for message in sequence(case, seed=3):
            assert len(rover.encode(case, message)) <= rover.envelopes.first.max_size


def test_an_imu_at_rest_feels_gravity_alone(rover: Wire) -> None:
    for message in sequence(rover.case("imu_info"), seed=1, times=tuple(map(float, range(60)))):
        assert math.dist((message.accel_x, message.accel_y, message.accel_z), (0, 0, 9.80665)) < 0.5
        assert abs(message.gyro_z) < 20


def test_sensors_are_healthy_wherever_they_are(rover: Wire) -> None:
    message = sequence(rover.case("sensor_diag"), seed=1)[0]
    assert message.gps_sensor_1.state == 1
    assert message.imu_sensor.error_code == 0
    assert message.imu_sensor.accel_z > 9


def test_gps_time_is_the_wall_clock_in_milliseconds(rover: Wire) -> None:
    assert sequence(rover.case("gps_info"), seed=1, times=(2.5,))[0].utc_timestamp == 1_700_000_002_500


def test_the_operator_leaves_the_rover_to_itself(rover: Wire) -> None:
    for message in sequence(rover.case("control_mode"), seed=1, times=tuple(map(float, range(60)))):
        assert message.mode == MODE_AUTO
