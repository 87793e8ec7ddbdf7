from __future__ import annotations

import math

import pytest

from router.tools.models import moment

EPOCH = 1_700_000_000.0


def test_speed_heading_and_turn_rate_belong_to_the_walked_path() -> None:
    step = 1e-3
    for t in (0.0, 11.0, 42.0, 77.7):
        here, there = moment(t, EPOCH), moment(t + step, EPOCH)
        north, east = there.north - here.north, there.east - here.east
        assert math.hypot(north, east) / step == pytest.approx(here.speed, rel=1e-2)
        assert math.degrees(math.atan2(east, north)) % 360 == pytest.approx(here.heading, abs=0.1)
        assert (there.heading - here.heading) / step == pytest.approx(here.turn_rate, rel=2e-2, abs=1e-2)


def test_the_walk_is_a_closed_path_without_jumps() -> None:
    for second in range(120):
        here, there = moment(second, EPOCH), moment(second + 1, EPOCH)
        assert math.dist((here.north, here.east), (there.north, there.east)) < 1
    start, end = moment(0, EPOCH), moment(120, EPOCH)
    assert (start.north, start.east) == pytest.approx((end.north, end.east), abs=1e-9)
