"""The carrier and the Python threads behind it do together what the engine does in Python."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.carrier.building import MEMORY
from tests.carrier.conftest import SANITIZED
from tests.carrier.whole import compare, library


@pytest.mark.parametrize("publishes", [True, False])
@pytest.mark.parametrize("count", [3_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_same_datagrams_have_the_same_outcome(count: int, publishes: bool, tmp_path: Path) -> None:
    loaded = library(tmp_path / "carrier.so", MEMORY if SANITIZED in os.environ else "")
    difference, fates = compare(loaded, tmp_path, count, seed=count, publishes=publishes)
    assert difference is None
    assert fates["datagrams_sent", "manual_drive", "driving_board"]
    assert fates["datagrams_sent", "gps_info", "paced"]
    assert fates["messages_published", "imu_info_from_sensor_board", "accel"]
    assert fates["messages_filtered", "imu_info_from_sensor_board", "basestation"]
    assert fates["messages_dropped", "imu_info_from_sensor_board", "basestation", "mapping_error"]
    assert fates["deadman_trips", "manual_drive"]
