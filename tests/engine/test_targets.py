"""What becomes of an accepted message at each of its targets: delivered, dropped for a reason, or filtered."""

from __future__ import annotations

import errno
import math
import struct
from bisect import bisect_left

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.compiler.metrics import HISTOGRAM_BOUNDS_NS
from router.compiler.program import Program
from tests.engine.rig import BASESTATION, DRIVING_BOARD, SENSOR_BOARD, STRANGER, PublishError, Rig, program
from tests.engine.wire import I32, envelopes, framed, rover_envelope, tag
from tests.oracles.python_engine.delivery import Stale

ROUTES = """\
  imu_info:
    source: sensor_board
    destinations: [basestation, recorder]
    topics:
      - {topic: imu_data, type: comms/msg/ImuSensorInformation, fields: auto}
      - {topic: accel, type: std_msgs/msg/Float32, fields: {data: accel_x}}
  ph_info:
    source: sensor_board
    destinations: [{endpoint: basestation, when: ph_value > 7}, recorder]
    topics:
      - {topic: inverse, type: std_msgs/msg/Float64, fields: {data: 1 / ph_value}}
      - {topic: whole, type: std_msgs/msg/Int32, fields: {data: "clamp(round(ph_value), -100, 100)"}}
      - {topic: narrow, type: std_msgs/msg/Float32, fields: {data: ph_value * 1e10}, when: ph_value < 1e30}
      - {topic: root, type: std_msgs/msg/Float64, fields: {data: sqrt(ph_value)}, max_rate: 10 Hz}
  gps_info:
    source: any
    destinations: [{endpoint: basestation, max_rate: 5 Hz, when: hdop < 10}]
    topics:
      - {topic: late, type: comms/msg/SensorBoardGPSInfo, qos: {durability: transient_local}, fields: auto}
"""
IMU, PH, GPS = 13, 1, 12


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return program(tmp_path_factory.mktemp("targets"), ROUTES)


@pytest.fixture
def rig(made: Program) -> Rig:
    return Rig(made)


def ph(value: float) -> bytes:
    return framed(PH, tag(1, I32) + struct.pack("<f", value))


# ---- the outlets fail


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (BlockingIOError(errno.EAGAIN, "no room"), "send_buffer_full"),
        (OSError(errno.ENOBUFS, "no buffers"), "send_buffer_full"),
        (ConnectionRefusedError(errno.ECONNREFUSED, "nobody there"), "send_error"),
        (OSError(errno.ENETUNREACH, "no way there"), "send_error"),
        (OSError(errno.EMSGSIZE, "too long"), "send_error"),
    ],
)
def test_a_destination_that_fails_is_counted_and_the_others_are_served(rig: Rig, error: OSError, reason: str) -> None:
    rig.failures["basestation"] = error
    rig.receive(framed(IMU, b""))

    assert rig.dropped("imu_info", "basestation") == {reason: 1}
    assert rig.count("sent_bytes", "imu_info", "basestation") == 0
    assert [name for name, _ in rig.sent + rig.published] == ["recorder", "imu_data", "accel"]
    [report] = rig.reports
    assert (report.kind, report.place, report.target) == ("drop", "imu_info", "basestation")
    assert (report.reason, report.error) == (reason, error)
    rig.assert_counters_balance()


def test_a_message_that_expires_when_it_is_sent_is_stale(rig: Rig) -> None:
    rig.failures["basestation"] = Stale()
    rig.receive(framed(IMU, b""))

    assert rig.dropped("imu_info", "basestation") == {"stale": 1}
    assert [(report.reason, report.error) for report in rig.reports] == [("stale", None)]
    rig.assert_counters_balance()


@pytest.mark.parametrize("error", [PublishError("gone"), OSError(errno.EAGAIN, "full")])
def test_a_topic_that_fails_is_counted_and_the_others_are_served(rig: Rig, error: Exception) -> None:
    rig.failures["imu_data"] = error
    rig.receive(framed(IMU, b""))

    assert rig.dropped("imu_info", "imu_data") == {"publish_error": 1}
    assert [name for name, _ in rig.sent + rig.published] == ["basestation", "recorder", "accel"]
    rig.assert_counters_balance()


def test_everything_may_fail_at_once(rig: Rig) -> None:
    rig.failures = dict.fromkeys(("basestation", "recorder", "imu_data", "accel"), OSError(errno.EIO, "broken"))
    rig.receive(framed(IMU, b""))
    assert len(rig.reports) == 4
    rig.assert_counters_balance()


def test_a_fault_of_our_own_is_loud(rig: Rig) -> None:
    """Only what a value, the network or the middleware can cause is counted as lost."""
    rig.failures["imu_data"] = AttributeError("a bug")
    with pytest.raises(AttributeError, match="a bug"):
        rig.receive(framed(IMU, b""))


# ---- the mapping fails


def test_a_value_without_a_result_costs_its_own_target_only(rig: Rig) -> None:
    rig.receive(ph(0.0))
    assert rig.dropped("ph_info", "inverse") == {"mapping_error": 1}
    assert [name for name, _ in rig.published] == ["whole", "narrow", "root"]
    rig.assert_counters_balance()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_has_a_reason_of_its_own(rig: Rig, value: float) -> None:
    rig.receive(ph(value))
    assert rig.dropped("ph_info", "whole") == {"non_finite": 1}
    rig.assert_counters_balance()


def test_forwarding_waits_for_no_mapping(rig: Rig) -> None:
    rig.receive(ph(-1.0))
    assert rig.dropped("ph_info", "root") == {"mapping_error": 1}
    assert [name for name, _ in rig.sent] == ["recorder"]


def test_a_float_keeps_what_is_not_finite(rig: Rig) -> None:
    rig.receive(framed(IMU, tag(1, I32) + struct.pack("<f", math.inf)))
    assert rig.dropped("imu_info", "accel") == {}
    assert rig.published[1] == ("accel", b"\0\1\0\0" + struct.pack("<f", math.inf))


# ---- on purpose


def test_a_topic_that_nobody_wants_is_filtered_and_not_filled(made: Program) -> None:
    rig = Rig(made, unwanted=frozenset({"inverse"}))
    rig.receive(ph(0.0))  # filling it would fail

    assert rig.dropped("ph_info", "inverse") == {}
    assert rig.count("messages_filtered", "ph_info", "inverse") == 1
    rig.wanted["inverse"][0] = True
    rig.receive(ph(2.0))
    assert rig.count("messages_published", "ph_info", "inverse") == 1
    rig.assert_counters_balance()


def test_when_filters_without_a_word(rig: Rig) -> None:
    rig.receive(ph(6.5))
    rig.receive(ph(7.5))

    assert [name for name, _ in rig.sent] == ["recorder", "basestation", "recorder"]
    assert rig.count("messages_filtered", "ph_info", "basestation") == 1
    assert rig.reports == []
    rig.assert_counters_balance()


def test_max_rate_thins_out_and_counts_what_it_dropped(rig: Rig) -> None:
    for index in range(1000):  # 10 s of 100 Hz
        rig.now = index * 10_000_000
        rig.receive(framed(GPS, b""), STRANGER)

    delivered = rig.count("datagrams_sent", "gps_info", "basestation")
    assert abs(delivered - 50) <= 1
    assert rig.dropped("gps_info", "basestation") == {"rate_limited": 1000 - delivered}
    assert rig.count("messages_published", "gps_info", "late") == 1000
    assert rig.reports == []
    rig.assert_counters_balance()


def test_what_when_refuses_takes_no_place_in_the_rate(rig: Rig) -> None:
    poor = rover_envelope().message_class(gps_info={"hdop": 99.0})
    rig.receive(poor.SerializeToString())
    rig.receive(framed(GPS, b""))
    assert rig.count("messages_filtered", "gps_info", "basestation") == 1
    assert rig.count("datagrams_sent", "gps_info", "basestation") == 1


# ---- time


@pytest.mark.parametrize("work_ns", [0, *HISTOGRAM_BOUNDS_NS, 60_000_000])
def test_a_route_is_timed_up_to_its_last_target(rig: Rig, work_ns: int) -> None:
    rig.now, rig.work_ns = 1_000_000, work_ns // 4  # four outlets
    rig.receive(framed(IMU, b""))

    elapsed = 4 * rig.work_ns
    assert rig.count("route_duration_seconds", "imu_info", part=bisect_left(HISTOGRAM_BOUNDS_NS, elapsed)) == 1
    assert rig.count("route_duration_seconds", "imu_info", part=len(HISTOGRAM_BOUNDS_NS) + 1) == elapsed
    assert rig.count("route_last_message_timestamp_seconds", "imu_info") == rig.WALL + 1_000_000


# ---- all together

FULL, GONE = BlockingIOError(errno.EAGAIN, "full"), ConnectionRefusedError(errno.ECONNREFUSED, "gone")
FAILURES: list[dict[str, Exception]] = [
    {},
    {"basestation": FULL},
    {"recorder": GONE, "basestation": FULL},
    {"imu_data": PublishError()},
    {"whole": PublishError(), "late": PublishError(), "recorder": GONE},
]


@given(data=st.data())
def test_the_counters_balance_whatever_happens(made: Program, data: st.DataObject) -> None:
    """After every single datagram, and by listener: each is rejected once or accepted once."""
    rig = Rig(made, unwanted=frozenset(data.draw(st.sets(st.sampled_from(["accel", "late", "root"])))))
    datagrams = envelopes() | st.floats(width=32).map(ph) | st.binary(max_size=20)
    for _ in range(data.draw(st.integers(1, 30))):
        listener = data.draw(st.sampled_from(["trimmed", "exact"]))
        rig.failures = data.draw(st.sampled_from(FAILURES))
        rig.now += data.draw(st.integers(0, 200_000_000))
        before = rig.ledger.total("datagrams_rejected", listener) + rig.ledger.total("messages_received")
        peer = data.draw(st.sampled_from([SENSOR_BOARD, SENSOR_BOARD, DRIVING_BOARD, BASESTATION, STRANGER]))
        rig.receive(data.draw(datagrams), peer, listener)
        assert rig.ledger.total("datagrams_rejected", listener) + rig.ledger.total("messages_received") == before + 1
        rig.assert_counters_balance()
