"""A route in parts, as a carrier has it: what it does not serve itself gets what the whole handler would give it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.app.parts import OF_PYTHON, Part, divided
from router.compiler.program import Program
from router.engine import PartEngine
from router.engine.freshness import Born
from tests.engine.rig import SENSOR_BOARD, PublishError, Rig, program
from tests.engine.test_both_directions import MS, enveloped
from tests.engine.wire import framed

ROUTES = """\
  imu_info:
    source: sensor_board
    destinations: [basestation, {endpoint: recorder, when: accel_x > 1, max_rate: 1000 Hz, on_limit: latest}]
    topics:
      - {topic: accel/x, type: std_msgs/msg/Float32, fields: {data: accel_x}, when: accel_x < 5}
      - {topic: accel_x, type: std_msgs/msg/Float32, fields: {data: accel_x}, max_rate: 10 Hz}
    ttl: 200ms
  ph_info:
    source: any
    destinations: [basestation]
    topics: [{topic: ph, type: std_msgs/msg/Float32, fields: {data: 1 / ph_value}}]
  gps_info: {source: any, destinations: [basestation]}
"""
PARTS = {Part.TOPICS: {"imu_info", "ph_info"}, Part.DESTINATIONS: {"imu_info"}}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return program(tmp_path_factory.mktemp("parts"), ROUTES)


class Carried:
    """A rig whose datagrams are accepted and queued by somebody else, who is quick."""

    def __init__(self, made: Program) -> None:
        self.rig = Rig(made)
        parts = divided(made, publishes=False)
        self.engines = {part: PartEngine(made, self.rig.context, parts[part]) for part in OF_PYTHON}
        self.parts = {part: engine.functions() for part, engine in self.engines.items()}

    def serve(self, route: str, payload: bytes | None, datagram: bytes, born: int = 0) -> None:
        for part in (Part.DESTINATIONS, Part.TOPICS):
            if route in self.parts[part]:
                serve, _ = self.parts[part][route]
                serve(payload, datagram, Rig.WALL + self.rig.now, self.rig.now, "sensor_board", Born(born, born))


@pytest.fixture
def carried(made: Program) -> Iterator[Carried]:
    made_of_it = Carried(made)
    yield made_of_it
    for engine in made_of_it.engines.values():
        engine.close()


def test_only_routes_that_have_the_part_have_a_function(carried: Carried) -> None:
    assert {part: set(functions) for part, functions in carried.parts.items()} == PARTS


def test_a_part_serves_its_targets_alone(made: Program) -> None:
    [handler] = made.inbound[13]
    parts = divided(made, publishes=False)
    topics, destinations = (handler.part(parts[part]["imu_info"]) for part in OF_PYTHON)
    assert handler.targets == (handler.targets[0], *destinations.targets, *topics.targets)  # whose state is kept by it
    assert [target.label for target in destinations.targets] == ["recorder"]
    assert [target.identifier for target in topics.targets] == ["accel_x", "accel_x_2"]
    assert "basestation" not in topics.source.text() + destinations.source.text()


@given(values=st.lists(st.tuples(st.sampled_from([0.0, 2.0, 7.0]), st.integers(0, 300 * MS)), max_size=20))
def test_all_parts_together_do_what_the_whole_handler_does(made: Program, values: list[tuple[float, int]]) -> None:
    """But for what the carrier forwards, here to the basestation."""
    whole, parts = Rig(made), Carried(made)
    for value, passes in values:
        datagram = enveloped(imu_info={"accel_x": value})
        whole.arrived_before = passes // 2
        whole.receive(datagram, SENSOR_BOARD)
        parts.serve("imu_info", datagram[2:], datagram, parts.rig.now - passes // 2)
        whole.pass_time(passes)
        parts.rig.pass_time(passes)
    counted = ("messages_published", "messages_dropped", "messages_filtered", "datagrams_sent", "sent_bytes")
    assert parts.rig.published == whole.published
    assert parts.rig.sent == [sent for sent in whole.sent if sent[0] == "recorder"]
    assert parts.rig.counted(*counted) == {
        key: count for key, count in whole.counted(*counted).items() if key[2] != "basestation"
    }


def test_of_several_fields_the_envelope_is_parsed(carried: Carried) -> None:
    first, second = enveloped(gps_info={"hdop": 1}), enveloped(imu_info={"accel_x": 2})
    third = enveloped(imu_info={"accel_x": 1e-45})
    carried.serve("imu_info", None, first + second)
    carried.serve("imu_info", None, first + third)
    assert carried.rig.sent == [("recorder", first + second)]
    assert [topic for topic, _ in carried.rig.published] == ["accel/x", "accel_x", "accel/x"]
    assert carried.rig.counted("messages_dropped") == {("messages_dropped", "imu_info", "accel_x", "rate_limited"): 1}


def test_what_fails_is_counted_and_raises_nothing(carried: Carried) -> None:
    carried.serve("ph_info", b"", framed(1, b""))  # 1 / 0
    carried.serve("ph_info", b"\xff", framed(1, b"\xff"))  # which no carrier accepts
    carried.rig.failures["accel/x"] = PublishError("gone")
    carried.serve("imu_info", b"", framed(13, b""))
    assert carried.rig.dropped("ph_info", "ph") == {"mapping_error": 2}
    assert carried.rig.dropped("imu_info", "accel/x") == {"publish_error": 1}


def test_it_is_told_which_counters_its_messages_are_taken_off(carried: Carried) -> None:
    counters = carried.rig.program.counters
    _, waiting = carried.parts[Part.TOPICS]["imu_info"]
    assert waiting == [counters.index("messages_waiting", "imu_info", topic) for topic in ("accel/x", "accel_x")]


FRAMES = """\
  imu_info:
    source: sensor_board
    destinations: [{endpoint: basestation, when: accel_x > 1, max_rate: 1000 Hz, on_limit: latest}]
    collect: {by: 1, count: 2, order: "round(accel_x / 2)", timeout: 100ms}
    topics: [{topic: both, type: std_msgs/msg/Float32, fields: {data: "items[1].accel_x"}}]
"""


def test_the_topics_collect_and_the_destinations_do_not(tmp_path: Path) -> None:
    carried = Carried(program(tmp_path, FRAMES))
    for value in (0, 2):
        datagram = enveloped(imu_info={"accel_x": value})
        carried.serve("imu_info", datagram[2:], datagram)
    assert [endpoint for endpoint, _ in carried.rig.sent] == ["basestation"]
    assert [topic for topic, _ in carried.rig.published] == ["both"]
    assert carried.rig.counted("messages_collected") == {("messages_collected", "imu_info", "both"): 1}
