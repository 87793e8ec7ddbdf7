"""`nan` and `inf` of a table through the running router: as rclpy gets them, and in datagrams."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.site import RouterProcess, site, total, wait_until
from tests.test_docs import examples

TABLE = """\
version: 1
envelope: {{protos: {root}/protos, message: PBEnvelope, oneof: payload}}
metrics: {{address: 127.0.0.1:{metrics}}}
networks: [127.0.0.0/8]
listen:
  rover: {{address: 127.0.0.5:{listen}}}
endpoints:
{endpoints}routes:
  drive_diag:
    source: board
    topics:
      - BATTERY
      - topic: variance
        type: sensor_msgs/msg/Temperature
        fields: {{temperature: -inf, variance: nan}}
  rock_measure_result:
    source: ros
    topics: [{{topic: measured, type: std_msgs/msg/Float32}}]
    fields: {{length_cm: data, width_cm: nan}}
    destinations: [station]
    deadman: {{timeout: 1h, send: {{rover_localization: {{x: nan, y: -inf, z: 1}}}}, to: [station]}}
"""
TOPICS = {"battery": "sensor_msgs/msg/BatteryState", "variance": "sensor_msgs/msg/Temperature"}
HOSTS = {"board": "127.0.0.31", "station": "127.0.0.32"}


def documented() -> str:
    """The topic that docs/table.md shows, on one line, for `str.format`."""
    [example] = (text for text in examples("table.md", "yaml") if "BatteryState" in text)
    [topic] = yaml.safe_load(example)["routes"]["drive_diag"]["topics"]
    line: str = yaml.safe_dump(topic, default_flow_style=True, width=10_000, sort_keys=False)
    return line.strip().replace("{", "{{").replace("}", "}}")


def test_what_is_not_measured_is_nan_in_rclpy_and_in_datagrams(tmp_path: Path) -> None:
    payload: Any = WIRE.envelope.cases["drive_diag"].message_class()
    payload.front_left_motor.voltage = 24.5
    given = sample("drive_diag", payload).datagram
    table = TABLE.replace("BATTERY", documented())
    with site(tmp_path, HOSTS) as place, RouterProcess(tmp_path, place.table(table)):
        at_start: Any = WIRE.decode(place.receive("station")).message
        assert math.isnan(at_start.x)
        assert (at_start.y, at_start.z) == (-math.inf, 1)
        with RosPeer(TOPICS) as peer:

            def published() -> bool:
                place.send("board", given)
                return all(total(place.scrape(), "messages_published", topic=topic) for topic in TOPICS)

            wait_until(published, "the match")
            arrived: dict[str, Any] = {}
            while arrived.keys() != TOPICS.keys():
                topic, message = peer.receive()
                arrived[topic] = message
            peer.open_heard({"measured": "std_msgs/msg/Float32"})
            peer.say("measured", {"data": 2.5})
            result: Any = WIRE.decode(place.receive("station")).message
            assert result.length_cm == 2.5
            assert math.isnan(result.width_cm)
    battery, temperature = arrived["battery"], arrived["variance"]
    assert (battery["voltage"], battery["percentage"], battery["present"]) == (24.5, 0.5, True)
    unmeasured = ("temperature", "current", "charge", "capacity", "design_capacity")
    assert all(math.isnan(battery[name]) for name in unmeasured)
    assert temperature["temperature"] == -math.inf
    assert math.isnan(temperature["variance"])
