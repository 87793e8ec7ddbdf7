from __future__ import annotations

from pathlib import Path

import pytest

from router.errors import Code
from router.table.addresses import Address
from tests.table.tables import GOOD, good, load


@pytest.fixture
def base(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(GOOD)
    return tmp_path


def test_mappings_merge_key_by_key_and_everything_else_replaces(base: Path) -> None:
    text = """\
extends: base.yaml
endpoints:
  basestation: {address: 127.0.0.9:1}
  tool: {address: 127.0.0.8:1, kind: tool}
routes:
  imu_info: {destinations: [tool]}
"""
    table = good(base, text)
    assert list(table.endpoints) == ["sensor_board", "basestation", "tool"]
    basestation = table.endpoints["basestation"]
    assert basestation.address.value == Address("127.0.0.9", 1)
    assert basestation.trim_trailing_zeros
    imu = table.routes[0]
    assert [destination.endpoint.value for destination in imu.destinations] == ["tool"]
    assert len(imu.topics) == 2


def test_a_route_is_turned_off_and_on_as_a_whole(base: Path) -> None:
    (base / "off.yaml").write_text("extends: base.yaml\nroutes:\n  imu_info: {ignore: no sensor in this rover}\n")
    table = good(base, "extends: off.yaml\n")
    assert (table.routes[0].ignore is not None, table.routes[0].topics) == (True, ())
    table = good(base, "extends: off.yaml\nroutes:\n  imu_info: {source: sensor_board, destinations: [basestation]}\n")
    assert (table.routes[0].ignore, table.routes[0].topics) == (None, ())


def test_a_list_of_routes_replaces_and_is_replaced_whole(base: Path) -> None:
    text = """\
extends: base.yaml
routes:
  imu_info: [{source: sensor_board, destinations: [basestation]}, {source: {topic: imu}, fields: auto}]
  detected_object: {source: any, destinations: [basestation]}
  ph_info: [{source: any, destinations: [basestation]}]
"""
    table = good(base, text)
    names = [route.name for route in table.routes]
    assert names == [
        "imu_info_from_sensor_board", "imu_info_from_ros", "arm_target", "ph_info", "manual_drive", "detected_object",
    ]  # fmt: skip
    assert all(route.ignore is None and route.collect is None for route in table.routes)


@pytest.mark.parametrize(
    ("over", "case", "within"),
    [
        ("{within: 3s}", "drive_diag", 3),
        ("{drive_diag: x < 2}", "drive_diag", 2),
        ("{arm_diag: x < 2, within: 1s}", "arm_diag", 1),
    ],
)
def test_what_shows_that_a_deadman_is_obeyed_merges_unless_it_is_another_case(
    base: Path, over: str, case: str, within: int
) -> None:
    own = "{drive_diag: x < 1, within: 2s}"
    (base / "shown.yaml").write_text(f"extends: base.yaml\nroutes:\n  manual_drive: {{deadman: {{obeyed: {own}}}}}\n")
    table = good(base, f"extends: shown.yaml\nroutes:\n  manual_drive: {{deadman: {{obeyed: {over}}}}}\n")
    [deadman] = [route.deadman for route in table.routes if route.name == "manual_drive"]
    assert deadman is not None
    assert deadman.obeyed is not None
    assert (deadman.obeyed.case.value, deadman.obeyed.within.value) == (case, within * 10**9)


@pytest.mark.parametrize(
    ("send", "sent"),
    [
        ("{manual_brake: {brake: false}}", ["manual_brake {brake: false, by.who: 'router'}"]),
        ("{drive_motor: {speed: 0}}", ["drive_motor {speed: 0}"]),
        ("{drive_motor: {}, manual_brake: {brake: false}}", ["drive_motor", "manual_brake {brake: false}"]),
    ],
)
def test_a_deadman_merges_but_for_payloads_of_other_cases(base: Path, send: str, sent: list[str]) -> None:
    table = good(base, f"extends: base.yaml\nroutes:\n  manual_drive: {{deadman: {{send: {send}}}}}\n")
    [deadman] = [route.deadman for route in table.routes if route.deadman]
    assert deadman.timeout.value == 300_000_000
    assert [*map(str, deadman.payloads)] == sent


def test_payloads_in_another_order_replace_those_below(base: Path) -> None:
    first = "{manual_brake: {brake: true}, drive_motor: {speed: 0}}"
    (base / "both.yaml").write_text(f"extends: base.yaml\nroutes:\n  manual_drive: {{deadman: {{send: {first}}}}}\n")
    send = "{drive_motor: {}, manual_brake: {}}"
    table = good(base, f"extends: both.yaml\nroutes:\n  manual_drive: {{deadman: {{send: {send}}}}}\n")
    [deadman] = [route.deadman for route in table.routes if route.deadman]
    assert [*map(str, deadman.payloads)] == ["drive_motor", "manual_brake"]


def test_a_reason_takes_the_place_of_a_deadman(base: Path) -> None:
    table = good(base, "extends: base.yaml\nroutes:\n  manual_drive: {deadman: {none: no wheels here}}\n")
    assert not any(route.deadman for route in table.routes)


def test_a_reason_and_a_ttl_replace_each_other(base: Path) -> None:
    (base / "any.yaml").write_text("extends: base.yaml\nroutes:\n  manual_drive: {ttl: {none: it is a test}}\n")
    [at_any_age] = [route for route in good(base, "extends: any.yaml\n").routes if route.deadman]
    assert (at_any_age.ttl, at_any_age.no_ttl) == (None, "it is a test")
    [limited] = [
        route for route in good(base, "extends: any.yaml\nroutes: {manual_drive: {ttl: 1s}}\n").routes if route.deadman
    ]
    assert limited.ttl
    assert (limited.ttl.value, limited.no_ttl) == (1_000_000_000, None)


def test_chains_are_followed_from_file_to_file(base: Path) -> None:
    (base / "deep").mkdir()
    (base / "deep" / "middle.yaml").write_text("extends: ../base.yaml\nnode: {name: middle}\n")
    table = good(base, "extends: deep/middle.yaml\n")
    assert (table.node.name, len(table.files)) == ("middle", 3)


def test_variables_are_filled_in_the_path(base: Path) -> None:
    good(base, "extends: ${BASE}.yaml\n", {"BASE": "base"})


@pytest.mark.parametrize(
    ("text", "code", "part"),
    [
        ("extends: .\n", Code.BAD_EXTENDS, "folder"),
        ("extends: table.yaml\n", Code.BAD_EXTENDS, "extends itself"),
        ("extends: link.yaml\n", Code.BAD_EXTENDS, "extends itself"),
        ("extends: 5\n", Code.WRONG_TYPE, "path of another table"),
        ("extends:\n", Code.WRONG_TYPE, "path of another table"),
        ("extends: ${NOPE}\n", Code.UNDEFINED_VARIABLE, "not set"),
        (f"extends: {'x' * 300}\n", Code.BAD_EXTENDS, "too long"),
        ("extends: list.yaml\n", Code.WRONG_TYPE, "mapping with keys"),
        ("extends: torn.yaml\n", Code.BAD_YAML, "never closed"),
        ("extends: latin.yaml\n", Code.BAD_FILE, "UTF-8"),
    ],
)
def test_what_cannot_be_extended_is_one_finding(base: Path, text: str, code: Code, part: str) -> None:
    (base / "back.yaml").write_text("extends: table.yaml\n")
    (base / "list.yaml").write_text("- 1\n")
    (base / "torn.yaml").write_text("a: [\n")
    (base / "latin.yaml").write_bytes(b"# \xff\n")
    (base / "link.yaml").symlink_to("table.yaml")
    table, [finding] = load(base, text)
    assert table is None
    assert finding.code is code
    assert part in str(finding)
    assert finding.span.line == 1


def test_one_target_replaces_as_a_list_does_and_so_does_a_reply(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(
        GOOD
        + """\
  gps_info:
    source: any
    topics: {topic: a, type: std_msgs/msg/Int32, max_rate: 1 Hz, when: satellites > 3, fields: {data: satellites}}
    destinations: {endpoint: basestation, when: satellites > 3}
    reply: {case: ph_info, fields: {ph_value: 1}, when: satellites > 3}
  arm_ctrl: {source: {topic: a, type: comms/msg/A}, destinations: basestation}
"""
    )
    text = """\
extends: base.yaml
routes:
  gps_info:
    topics: {topic: b, type: std_msgs/msg/Int32}
    destinations: {endpoint: sensor_board}
    reply: {imu_info: {}}
  arm_ctrl: {source: {topic: b, type: comms/msg/A}, destinations: basestation}
"""
    routes = {route.name: route for route in good(tmp_path, text).routes}
    [topic], [destination] = routes["gps_info"].topics, routes["gps_info"].destinations
    assert (topic.topic.value, topic.max_rate, topic.when, topic.fields) == ("b", None, None, None)
    assert (destination.endpoint.value, destination.when) == ("sensor_board", None)
    reply = routes["gps_info"].reply
    assert reply is not None
    assert (reply.case.value, reply.when, reply.fields and reply.fields.entries) == ("imu_info", None, ())
    assert [topic.topic.value for topic in routes["arm_ctrl"].source_topics] == ["b"]


@pytest.mark.parametrize(
    "one", ["address: 127.0.0.2:8", "group: '224.5.23.2:8', interface: lo", "broadcast: 127.255.255.255:8"]
)
@pytest.mark.parametrize("other", ["address: 127.0.0.3:9", "group: '224.5.23.3:9'", "broadcast: 127.255.255.255:9"])
def test_address_group_and_broadcast_of_an_endpoint_replace_each_other(tmp_path: Path, one: str, other: str) -> None:
    (tmp_path / "base.yaml").write_text(GOOD.replace("endpoints:\n", f"endpoints:\n  tracker: {{{one}, kind: tool}}\n"))
    endpoint = good(tmp_path, f"extends: base.yaml\nendpoints: {{tracker: {{{other}}}}}\n").endpoints["tracker"]
    assert f"{endpoint.address.value}" in other
    assert [endpoint.unicast, endpoint.group, endpoint.broadcast].count(None) == 2
    assert endpoint.interface == ("lo" if "group" in one and "group" in other else None)


def test_an_address_replaces_the_networks_in_which_it_was_learned(tmp_path: Path) -> None:
    learned = "address: learned, networks: [10.0.0.0/8], kind: tool"
    (tmp_path / "base.yaml").write_text(GOOD.replace("endpoints:\n", f"endpoints:\n  tracker: {{{learned}}}\n"))
    for other in ("address: 127.0.0.3:9", "group: '224.5.23.3:9'", "broadcast: 127.255.255.255:9"):
        endpoint = good(tmp_path, f"extends: base.yaml\nendpoints: {{tracker: {{{other}}}}}\n").endpoints["tracker"]
        assert (endpoint.address.value.is_learned, endpoint.networks) == (False, ())
    endpoint = good(tmp_path, "extends: base.yaml\nendpoints: {tracker: {source_port: 9}}\n").endpoints["tracker"]
    assert (endpoint.address.value.is_learned, len(endpoint.networks)) == (True, 1)


def test_a_map_of_values_an_each_and_a_quality_of_service_replace(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(
        GOOD
        + """\
  arm_ctrl:
    source: {topic: a, type: comms/msg/A}
    destinations: basestation
    fields: {a: {map: mode, ONE: 1, else: 0}, b: {text: base}, c: {x: 1, y: 2}, d: {each: p, fields: {x: 1}}}
defaults: {qos: {profile: sensor_data, depth: 7}}
"""
    )
    text = """\
extends: base.yaml
routes:
  arm_ctrl:
    fields:
      a: {map: other, TWO: 2, else: 0}
      b: {map: mode, ONE: {text: over}, else: source}
      c: {y: 3}
      d: {each: q, fields: {y: 2}}
defaults: {qos: {reliability: best_effort}}
"""
    route = good(tmp_path, text).routes[-1]
    assert str(route.fields) == (
        "{a: {map: other, TWO: 2, else: 0}, b: {map: mode, ONE: 'over', else: source}, c.x: 1, c.y: 3, "
        "d: {each: q, fields: {y: 2}}}"
    )
    [topic] = route.source_topics
    assert topic.qos is not None
    assert (topic.qos.profile, topic.qos.depth) == (None, None)
