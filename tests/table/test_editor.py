"""The schema as an editor sees it: the real yaml-language-server, reached through the table's modeline."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.table import tables
from tests.table.language_server import REPOSITORY, LanguageServer, started
from tests.tables import ROUTES

pytestmark = pytest.mark.slow

NUMBERS = itertools.count()
MODELINE = "# yaml-language-server: $schema=../schemas/route-table.schema.json\n"
GOOD = MODELINE + tables.GOOD
GATEWAYS = f"""\
{MODELINE}{tables.SMALL}gateways:
{tables.GATEWAY}\
  logger:
    transport: {{tcp: 0.0.0.0:8600}}
    format: json_lines
    max_clients: 3
  dashboard:
    transport: {{websocket: 0.0.0.0:8765}}
  far:
    transport: {{zenoh: {{key: rovers/one, mode: client, connect: [tcp/10.0.0.1:7447]}}}}
    format: json
"""
PART = """\
# yaml-language-server: $schema=../schemas/route-table.schema.json
version: 1
extends: rover.yaml
networks: [127.0.0.0/8, "${NETWORK:-10.0.0.0/8}"]
envelope: {message: OtherEnvelope}
http: {}
record: {retention: 1GiB}
endpoints:
  sensor_board: {address: 127.0.0.30:25008}
  camera: {kind: tool}
listen: {rover: {receive_buffer: 8MiB}}
routes:
  imu_info: {ttl: 1s}
  manual_drive: {deadman: {timeout: 300ms}}
  detected_object: {collect: {timeout: 2s}}
  ph_info: {ignore: nobody needs it}
  manual_brake:
    - {source: {topic: brake, type: std_msgs/msg/Bool}, fields: auto}
    - {source: [sensor_board], deadman: {timeout: 200ms, send: {manual_brake: {}}, to: [driving_board]}}
gateways:
  page: {publish_period: each}
  fast: {max_datagram: 9000B}
  logger: {transport: {websocket: 127.0.0.1:8600}, compression: {zstd: 1}}
  far: {transport: {zenoh: {connect: [tcp/127.0.0.1:7447]}}}
  vr:
    transport: {udp: 127.0.0.1:8502}
    inbound:
      - {topic: /cmd_vel, type: geometry_msgs/msg/Twist, deadman: {timeout: 300ms, send: {}}}
"""
SHORT = """\
# yaml-language-server: $schema=../schemas/route-table.schema.json
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
defaults: {package: comms, queue_depth: 10, qos: sensor_data, ttl: 1s, deadman: {timeout: 500ms, repeat: 100ms}}
listen: {rover: {address: 0.0.0.0:5000}}
endpoints: {basestation: {address: 192.168.0.10:9000, kind: basestation}}
routes:
  arm_pos: {source: basestation, destinations: basestation, topic: arm_pos}
  gps_info:
    source: basestation
    topics:
      - gps_data
      - topic: gps/fix
        type: sensor_msgs/msg/NavSatFix
        qos: sensor_data
        fields:
          header: {stamp: received_at, frame_id: {text: gps_link}}
          status.status: {map: fix_quality, GPS_FIX: 0, 7: 1, else: -1}
          name: {map: fix_quality, GPS_FIX: {text: fixed}, else: {text: none}}
  drive_motor:
    source: [{topic: drive_motor}, {topic: drive_motor_2, queue_depth: 3}]
    destinations: basestation
    deadman: {send: {manual_brake: {brake: true}}, to: basestation, disarmed_by: arm_pos}
"""
COMPLETE_PARTS = {
    "version": "version: 1\n",
    "envelope": "envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}\n",
    "listen": "listen: {rover: {address: 0.0.0.0:5000}}\n",
    "routes": "routes: {}\n",
    "http": "http: {address: 127.0.0.1:9108}\n",
    "record": "record: {directory: ../recordings}\n",
    "foxglove": "foxglove: {address: 127.0.0.1:8766}\n",
    "endpoints": "endpoints: {}\n",
    "gateways": "gateways: {}\n",
}
COMPLETE = "".join([MODELINE, *COMPLETE_PARTS.values()])


@pytest.fixture(scope="module")
def editor() -> Iterator[LanguageServer]:
    yield from started()


def new_table() -> Path:
    """A place beside the real tables, where the modeline leads to the schema."""
    return REPOSITORY / "routes" / f"unsaved-{next(NUMBERS)}.yaml"


def place(text: str, part: str) -> tuple[int, int]:
    """Line and column, from 0, of the first occurrence of a part of a text."""
    before = text[: text.index(part)]
    return before.count("\n"), len(before) - (before.rfind("\n") + 1)


def test_good_tables_are_underlined_nowhere(editor: LanguageServer) -> None:
    for text in (GOOD, GATEWAYS, PART, PART.replace("version: 1\n", "")):
        assert editor.open(new_table(), text) == []
    for table in sorted(ROUTES.glob("*.yaml")):
        assert editor.open(table, table.read_text(encoding="utf-8")) == [], table.name


def test_short_forms_are_as_good(editor: LanguageServer) -> None:
    assert editor.open(new_table(), SHORT) == []
    found = editor.open(new_table(), SHORT.replace("qos: sensor_data, ttl", "qos: sensors, ttl"))
    assert found


def test_gateways_alone_need_nothing_beside_them_and_routes_do(editor: LanguageServer) -> None:
    lines = GATEWAYS.splitlines(keepends=True)
    alone = [line for line in lines if not line.startswith(("envelope", "listen", "routes"))]
    assert len(alone) == len(lines) - 3
    assert editor.open(new_table(), "".join(alone)) == []
    found = editor.open(new_table(), "".join(line for line in lines if not line.startswith("envelope")))
    assert [item["message"] for item in found] == ['Missing property "envelope".']


@pytest.mark.parametrize(
    ("part", "missing"),
    [
        *(("", key) for key in ("version", "envelope", "listen", "routes")),
        ("envelope: {protos: ../protos, message: PBEnvelope}", "oneof"),
        ("http: {}", "address"),
        ("record: {retention: 1GiB}", "directory"),
        ("foxglove: {}", "address"),
        ("listen: {rover: {framing: exact}}", "address"),
        ("endpoints: {sensor_board: {address: 127.0.0.1:8}}", "kind"),
        ("routes: {imu_info: {destinations: [basestation]}}", "source"),
        ("routes: {imu_info: {source: any, deadman: {timeout: 1s, to: [arm]}}}", "send"),
        ("routes: {imu_info: {source: any, collect: {by: x, count: y, timeout: 1s}}}", "order"),
        ("gateways: {far: {format: json}}", "transport"),
        ("gateways: {far: {transport: {zenoh: {mode: client}}}}", "key"),
        (
            "gateways: {vr: {transport: {udp: 10.0.0.1:1}, inbound: [{topic: /a, type: std_msgs/msg/Bool}]}}",
            "receive",
        ),
    ],
)
def test_what_is_missing_is_told_unless_the_table_extends_another(
    editor: LanguageServer, part: str, missing: str
) -> None:
    text = COMPLETE.replace(COMPLETE_PARTS[part.partition(":")[0] or missing], "") + part + "\n"
    found = [item["message"] for item in editor.open(new_table(), text)]
    assert found == [f'Missing property "{missing}".']
    assert editor.open(new_table(), "extends: rover.yaml\n" + text) == []


@pytest.mark.parametrize(
    ("table", "right", "wrong", "blamed", "message"),
    [
        (GOOD, "kind: board", "kid: board", "kid", "Property kid is not allowed."),
        (GOOD, "192.168.0.30:8", "192.168.0.30:", "192.168.0.30:", "must be an IP address or a host name"),
        (GOOD, "queue_depth: 10", "queue_depth: ten", ": ten", 'Incorrect type. Expected "integer"'),
        (GOOD, "exact", "exat", "exat", 'Valid values: "zero_trimmed", "exact"'),
        (GOOD, "500ms", "500 millis", "500 millis", "must be a duration above zero with its unit"),
        (GOOD, "    source: sensor_board\n", "", "imu_info", 'Missing property "source"'),
        (GOOD, "ignore: nobody", "source: any, ignore: nobody", "source: any", "is not allowed with 'ignore'"),
        (GOOD, "max_rate: 20 Hz, ", "", "on_limit: latest", "needs 'max_rate'"),
        (GOOD, "{none: nothing moves because of it}", "500ms", "deadman: 500ms", "{none: why} if there is none"),
        (GOOD, "collect: {", "for_each: x\n      collect: {", "for_each: x", "belongs in a topic here"),
        (GOOD, "for_each: detections", "collect: {}", "collect: {}", "it is not allowed if the source is a topic"),
        (GOOD, "source: [basestation, sensor_board]\n      ", "", "- collect", 'Missing property "source"'),
        (GATEWAYS, "tcp: 0.0.0.0:8600", "tpc: 0.0.0.0:8600", "tpc", "must be one of udp, tcp"),
        (GATEWAYS, "json_lines", "gateway_v2", "format: gateway_v2\n    max", "must be 'gateway_v1' or 'json_lines'"),
        (GATEWAYS, "8765}", "8765}\n    receive: 10.0.0.230:1", "receive: 10.0.0.230:1", "of a udp gateway"),
        (GATEWAYS, "8765}", "8765}\n    compression: {zstd: 2}", "compression: {zstd: 2}", "here is JSON documents"),
        (GATEWAYS, "    receive: 10.0.0.230:8500\n", "", "vr_headset", 'Missing property "receive"'),
        (GATEWAYS, "50 Hz", "50 Hertz", "rates", "such as '50 Hz', or 'each'"),
        (GATEWAYS, "zstd: ${LEVEL:-3}", "zstd: 30", "zstd", "maximum of 22"),
        (PART, "receive_buffer:", "receive_bufer:", "receive_bufer", "Property receive_bufer is not allowed."),
        (PART, "[127.0.0.0/8", "[localhost", "networks", "must be a network"),
        # Lists are not merged, so what stands in one has to be complete.
        (PART, ", send: {manual_brake: {}}", "", "deadman: {timeout: 200ms", 'Missing property "send"'),
        (PART, "topic: brake, ", "", "type: std_msgs/msg/Bool", 'Missing property "topic"'),
        (PART, "source: [sensor_board]", "ttl: 1s", "- {ttl", 'Missing property "source"'),
    ],
)  # fmt: skip
def test_a_mistake_is_underlined_where_it_is(
    editor: LanguageServer, table: str, right: str, wrong: str, blamed: str, message: str
) -> None:
    text = table.replace(right, wrong)
    found = editor.open(new_table(), text)
    assert [item for item in found if message in item["message"]], found
    assert {item["range"]["start"]["line"] for item in found} == {place(text, blamed)[0]}


@pytest.mark.parametrize(
    ("text", "hovered"),
    [
        (GOOD, {
            "version": ("Version", "version of the route-table language"),
            "protos": ("Proto folder", "relative to this file"),
            "framing": ("Framing", "remove trailing zero bytes"),
            "source: s": ("Source", "An endpoint's name, 'any'"),
            "when": ("When", "boolean expression"),
            "deadline": ("Deadline", "longest time between two messages"),
            "auto: true": ("Auto", "Fields of the same name"),
            "timeout: 300 ms": ("Timeout", "without a fresh command"),
            "detected_object": ("Payload case", "a list of routes"),
            "for_each": ("For each", "'item', 'index' and 'count'"),
            "timeout: 1s": ("Timeout", "the other messages of a frame"),
        }),
        (GATEWAYS, {
            "gateways": ("Gateways", "neither ROS nor protobuf"),
            "udp": ("UDP", "the one client"),
            "include": ("Include", "every topic that is not hidden"),
            "timeout": ("Timeout", "before the deadman publishes"),
            "key: rovers": ("Key", "different for each rover"),
        }),
        (PART, {"receive_buffer": ("Receive buffer", "net.core.rmem")}),
    ],
)  # fmt: skip
def test_hovering_over_a_key_tells_what_it_is_for(
    editor: LanguageServer, text: str, hovered: dict[str, tuple[str, str]]
) -> None:
    table = new_table()
    editor.open(table, text)
    for word, (title, part) in hovered.items():
        line, character = place(text, word)
        shown = editor.hover(table, line, character + 1).replace("\\", "")
        assert title in shown, word
        assert part in shown, word


ENDPOINT = {"address", "source_port", "trim_trailing_zeros"}


@pytest.mark.parametrize(
    ("text", "offered"),
    [
        (GOOD.replace("routes:", "  arm_board:\n    kind: board\n    @\nroutes:"), ENDPOINT),
        (PART.replace("listen:", "  arm_board:\n    kind: board\n    @\nlisten:"), ENDPOINT),
        (GOOD + "  gps_info:\n    @\n", {"source", "destinations", "topics", "ignore"}),
        (GOOD + "    - source: {topic: it}\n      @\n", {"ttl", "topics", "priority"}),
        (
            GOOD + "  manual_arm:\n    source: basestation\n    deadman:\n      @\n",
            {"timeout", "send", "to", "repeat", "disarmed_by"},
        ),
        (
            GOOD.replace("{profile: sensor_data, depth: 5, deadline: 500ms}", "\n          reliability: @"),
            {"reliable", "best_effort", "best_available", "system_default"},
        ),
        (GATEWAYS + "    @\n", {"topics", "publish_period", "rates", "inbound"}),
        (GATEWAYS.replace("format: json_lines", "format: @"), {"gateway_v1", "json_lines"}),
    ],
)
def test_completion_offers_what_may_stand_there(editor: LanguageServer, text: str, offered: set[str]) -> None:
    line, character = place(text, "@")
    table = new_table()
    editor.open(table, text.replace("@", ""))
    assert offered <= editor.completions(table, line, character)
