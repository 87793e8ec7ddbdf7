"""A valid table for the tests of this folder, and shortcuts to load texts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from router.errors import Code, Diagnostic
from router.table import load_table
from router.table.keys import flat
from router.table.model import RouteTable
from router.table.schema import table_schema

GOOD = """\
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
node: {name: rover_router, namespace: /}
http: {address: 127.0.0.1:9108}
listen:
  rover: {address: 0.0.0.0:5000, framing: exact, receive_buffer: 64kB}
endpoints:
  sensor_board: {address: 192.168.0.30:8, kind: board, source_port: 9}
  basestation: {address: "${BASESTATION:-192.168.0.10:9000}", kind: tool, trim_trailing_zeros: true, bandwidth: 500kB/s}
routes:
  imu_info:
    source: sensor_board
    destinations: [basestation, {endpoint: basestation, when: accel_x > 1, max_rate: 30 Hz}]
    topics:
      - topic: imu_data
        type: comms/msg/ImuSensorInformation
        queue_depth: 10
        fields: auto
      - topic: imu/data_raw
        type: sensor_msgs/msg/Imu
        qos: {profile: sensor_data, depth: 5, deadline: 500ms}
        max_rate: 0.5
        fields:
          auto: true
          header.stamp: received_at
          header.frame_id: "'imu_link'"
          linear_acceleration: {x: accel_x, y: 9.81}
          orientation_covariance: [-1, 0, accel_y]
  arm_target:
    source: {topic: arm_target, type: comms/msg/ArmBoardTargetMovement}
    fields: auto
    destinations: [basestation]
  ph_info: {ignore: nobody needs it}
  manual_drive:
    source: basestation
    destinations: [{endpoint: sensor_board, max_rate: 20 Hz, on_limit: latest}]
    priority: command
    ttl: 200ms
    deadman: {timeout: 300 ms, send: {manual_brake: {brake: true, by.who: "'router'"}}, to: [sensor_board, basestation],
      disarmed_by: [arm_target]}
  detected_object:
    - source: {topic: detected_objects, type: comms/msg/DetectedObjectArray}
      for_each: detections
      fields: {auto: true, total_count: count}
      destinations: [basestation]
      deadman: {none: nothing moves because of it}
    - source: [basestation, sensor_board]
      collect: {by: frame_id, count: total_count, order: index, timeout: 1s}
      topics: [{topic: objects, type: comms/msg/DetectedObjectArray, fields: {detections: items}}]
    - {source: {topic: it, type: comms/msg/DetectedObject}, fields: auto, destinations: [basestation]}
"""

SMALL = """\
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 0.0.0.0:5000}}
routes: {}
"""

GATEWAY = """\
  vr_headset:
    transport: {udp: "${HEADSET:-10.0.20.219:8502}"}
    receive: 10.0.0.230:8500
    format: gateway_v2
    topics: {include: ["/rover/**", {regex: "/imu/.*"}], exclude: ["/rover/camera/**"]}
    publish_period: each
    schema_period: 1s
    discovery_period: 2s
    compression:
      zstd: ${LEVEL:-3}
    rates: {"/rover/imu": 50 Hz, "/tf": each, "/slow": 0.5}
    max_datagram: 8kB
    max_message: 1MiB
    inbound:
      - topic: /cmd_vel
        type: geometry_msgs/msg/Twist
        qos: {depth: 3}
        ttl: 300ms
        max_rate: 20 Hz
        deadman: {timeout: 500ms, send: {linear.x: 0.0, angular: {z: 1}}}
      - {topic: /stop, type: std_msgs/msg/Empty, deadman: {timeout: 1s, send: {}, repeat: 50ms}}
"""
"""A valid gateway for the key `gateways`."""


def load(
    folder: Path, text: str | bytes, environ: Mapping[str, str] | None = None
) -> tuple[RouteTable | None, list[Diagnostic]]:
    """Load the table of a text, written to `folder`."""
    path = folder / "table.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return load_table(path, environ or {})


def good(folder: Path, text: str, environ: Mapping[str, str] | None = None) -> RouteTable:
    """The table of a text without findings."""
    table, findings = load(folder, text, environ)
    assert findings == []
    assert table
    return table


def parts(folder: Path, text: str) -> tuple[RouteTable, list[Diagnostic]]:
    """The valid parts of the table of a text with findings."""
    table, findings = load(folder, text)
    assert table
    assert findings
    return table, findings


def shown(part: object) -> dict[str, str]:
    """Every setting of a part of a table, and of the parts in its lists, by key and index."""
    settings = flat(part)
    for key in [key for key in ("destinations", "source_topics", "topics", "inbound") if hasattr(part, key)]:
        name_of_key = "source" if key == "source_topics" else key
        if getattr(part, key):
            settings.pop(name_of_key, None)
        for index, member in enumerate(getattr(part, key)):
            settings |= {f"{name_of_key}.{index}.{name}": value for name, value in flat(member).items()}
    return settings


def places(findings: list[Diagnostic]) -> list[tuple[Code, int, int]]:
    """Code, line and column of each finding."""
    return [(finding.code, finding.span.line, finding.span.column) for finding in findings]


def references(schema: Any, here: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """References in a table's schema: keys from the root, with `*` for any name, and the definition."""
    if isinstance(schema, list):
        for member in schema:
            yield from references(member, here)
    elif isinstance(schema, dict):
        if name := schema.get("$ref", "").rpartition("/")[2]:
            yield here, name
            if name not in ("field_value", "nested_fields"):  # which are recursive
                yield from references(table_schema()["definitions"][name], here)
        for key, inner in schema.get("properties", {}).items():
            yield from references(inner, (*here, key))
        for key, inner in schema.items():
            if key not in ("definitions", "default", "examples", "properties"):
                below = (*here, "*") if key == "additionalProperties" and isinstance(inner, dict) else here
                yield from references(inner, below)
