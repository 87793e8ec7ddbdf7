"""Gateways: what is wrong with them, and what a program has of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from router.app.watching import watched_files
from router.compiler import Checked, check_table
from router.compiler.lookup import Definitions
from router.compiler.metrics import (
    CLIENT_DROP_REASONS,
    CLIENTS,
    GATEWAY_DROP_REASONS,
    GATEWAY_REJECT_REASONS,
    INBOUND_DROP_REASONS,
    QOS_POLICIES,
    TOPIC_STATES,
)
from router.errors import Code, Diagnostic, Severity
from router.gateway.transport.zenoh_session import session_config
from router.recording.mirror import Classifier
from tests.compiler.conftest import CheckText
from tests.tables import PROTOS

UDP = "transport: {udp: 127.0.0.9:8502}, receive: 127.0.0.1:8500"
TCP = "transport: {tcp: 127.0.0.1:8600}"
ZENOH = "transport: {zenoh: {key: rover}}"
TWIST = "topic: /cmd_vel, type: geometry_msgs/msg/Twist"
NO_ROUTES = "routes: {}"
PUBLISHES = (
    "routes: {ph_info: {source: board, topics: [{topic: %s, type: std_msgs/msg/Float32, fields: {data: ph_value}}]}}"
)
SUBSCRIBES = """routes: {ph_info: {source: {topic: %s, type: std_msgs/msg/Float32},
  fields: {ph_value: data}, destinations: [base]}}"""

BRAKES = SUBSCRIBES.replace("[base]", "[board], ttl: 1s, deadman: {timeout: 1s, send: {ph_info: {}}}")


def checked(check_text: CheckText, gateways: str, routes: str = NO_ROUTES, **parts: str) -> Checked:
    """`gateways` on one line in braces. Without the finding that there are few routes."""
    found = check_text(f"{routes}\ngateways: {{{gateways}}}\n", **parts)
    rest = [each for each in found.diagnostics if each.code is not Code.UNCOVERED_PAYLOAD_CASE]
    return replace(found, diagnostics=rest)


def codes(check_text: CheckText, gateways: str, routes: str = NO_ROUTES, **parts: str) -> list[Code]:
    return [finding.code for finding in checked(check_text, gateways, routes, **parts).diagnostics]


def blamed(check_text: CheckText, gateways: str, routes: str = NO_ROUTES, **parts: str) -> list[str]:
    """What stands in the table where each finding is."""
    found = checked(check_text, gateways, routes, **parts)
    lines = found.path.read_text(encoding="utf-8").splitlines()
    spans = [finding.span for finding in found.diagnostics]
    return [lines[span.line - 1][span.column - 1 : span.end_column - 1] for span in spans]


def test_a_table_may_have_gateways_and_no_topics(check_text: CheckText) -> None:
    program = checked(check_text, f"it: {{{UDP}}}").program
    assert program
    [gateway] = program.gateways
    assert (gateway.settings.name, gateway.inbound, program.publishers) == ("it", {}, ())


@pytest.mark.parametrize("name", ["here", "ph_info", "ph_info_from_board"])
def test_a_gateway_has_a_name_of_its_own(check_text: CheckText, name: str) -> None:
    routes = "routes: {ph_info: [{source: board, destinations: [base]}, {source: base, destinations: [tool]}]}"
    endpoints = (
        "{board: {address: 127.0.0.2:8, kind: board}, base: {address: 127.0.0.3:9000, kind: basestation},"
        " tool: {address: 127.0.0.4:9, kind: tool}}"
    )
    assert blamed(check_text, f"{name}: {{{TCP}}}", routes, endpoints=endpoints) == [name]


@pytest.mark.parametrize(
    ("settings", "wrong"),
    [
        ("topics: {include: [/imu, imu]}", "imu"),
        ('topics: {include: [{regex: "("}]}', '"("'),
        ('topics: {exclude: ["/a[b]"]}', '"/a[b]"'),
        ('rates: {"/a**": 5}', '"/a**"'),
    ],
)
def test_a_bad_pattern_is_blamed(check_text: CheckText, settings: str, wrong: str) -> None:
    found = checked(check_text, f"it: {{{TCP}, {settings}}}").diagnostics
    assert [finding.code for finding in found] == [Code.BAD_VALUE]
    assert blamed(check_text, f"it: {{{TCP}, {settings}}}") == [wrong]


@pytest.mark.parametrize(
    ("gateways", "clashes"),
    [
        (f"a: {{{UDP}}}, b: {{transport: {{udp: 127.0.0.9:8503}}, receive: 127.0.0.1:8500}}", 1),
        (f"a: {{{UDP}}}, b: {{transport: {{udp: 127.0.0.9:8503}}, receive: 0.0.0.0:8500}}", 1),
        (f"a: {{{UDP}}}, b: {{transport: {{udp: 127.0.0.9:8502}}}}", 0),
        ("a: {transport: {udp: 127.0.0.9:8502}, receive: 127.0.0.1:25000}", 1),
        ("a: {transport: {tcp: 127.0.0.1:25000}}", 0),
        (f"a: {{{TCP}}}, b: {{transport: {{websocket: 0.0.0.0:8600}}}}", 1),
        (f"a: {{{TCP}}}, b: {{transport: {{udp: 127.0.0.9:1}}, receive: 127.0.0.1:8600}}", 0),
        ("a: {transport: {websocket: 127.0.0.1:9108}}", 1),
        ("a: {transport: {udp: 127.0.0.9:1}, receive: 127.0.0.1:9108}", 0),
        (f"a: {{{ZENOH}}}, b: {{{ZENOH}}}", 1),
        (f"a: {{{ZENOH}}}, b: {{transport: {{zenoh: {{key: rover/two}}}}}}", 0),
    ],
)
def test_each_has_an_address_of_its_own(check_text: CheckText, gateways: str, clashes: int) -> None:
    routes = "http: {address: 127.0.0.1:9108}\nroutes: {}"
    assert codes(check_text, gateways, routes) == [Code.ADDRESS_CLASH] * clashes


@pytest.mark.parametrize("client", ["127.0.0.1:25000", "127.0.0.1:8500"])
def test_a_gateway_does_not_send_to_the_router(check_text: CheckText, client: str) -> None:
    gateway = f"it: {{transport: {{udp: {client!r}}}, receive: 127.0.0.1:8500}}"
    assert codes(check_text, gateway) == [Code.FORWARDING_LOOP]


def test_gateways_do_not_send_to_each_other(check_text: CheckText) -> None:
    ping = "ping: {transport: {udp: 127.0.0.1:8501}, receive: 127.0.0.1:8500}"
    pong = "pong: {transport: {udp: 127.0.0.1:8500}, receive: 127.0.0.1:8501}"
    assert codes(check_text, f"{ping}, {pong}") == [Code.FORWARDING_LOOP] * 2
    assert codes(check_text, f"{ping}, pong: {{transport: {{udp: 127.0.0.9:1}}, receive: 0.0.0.0:8501}}") == [
        Code.FORWARDING_LOOP
    ]
    assert codes(check_text, f"{ping}, pong: {{transport: {{udp: 127.0.0.9:1}}, receive: 127.0.0.1:8502}}") == []


@pytest.mark.parametrize(
    ("inbound", "found"),
    [
        (f"{{{TWIST}}}", []),
        ("{topic: /1st, type: std_msgs/msg/Empty}", [Code.BAD_TOPIC_NAME]),
        ("{topic: /a, type: std_msgs/msg/Emty}", [Code.UNKNOWN_ROS_TYPE]),
        (f"{{{TWIST}}}, {{{TWIST}}}", [Code.BAD_VALUE]),
        (f"{{{TWIST}}}, {{topic: cmd_vel, type: geometry_msgs/msg/Twist}}", [Code.BAD_VALUE]),
        (f"{{{TWIST}, qos: {{history: keep_all}}}}", [Code.QOS_CONFLICT]),
        (f"{{{TWIST}, max_rate: 2, ttl: 200ms, deadman: {{timeout: 500ms, send: {{}}}}}}", [Code.BAD_VALUE]),
        (f"{{{TWIST}, max_rate: 2.1, ttl: 200ms, deadman: {{timeout: 500ms, send: {{}}}}}}", []),
        (f"{{{TWIST}, ttl: 200ms, deadman: {{timeout: 500ms, send: {{}}, repeat: 9ms}}}}", [Code.BAD_VALUE]),
        (f"{{{TWIST}, ttl: 5s, deadman: {{timeout: 500ms, send: {{}}}}}}", [Code.DOUBTFUL_DEADMAN]),
        (f"{{{TWIST}, ttl: 1s, deadman: {{timeout: 1s, send: {{linear.w: 0}}}}}}", [Code.UNKNOWN_FIELD]),
        (f"{{{TWIST}, ttl: 1s, deadman: {{timeout: 1s, send: {{linear.x: y}}}}}}", [Code.UNKNOWN_FIELD]),
        (f"{{{TWIST}, ttl: 1s, deadman: {{timeout: 1s, send: {{linear.x: received_at}}}}}}", [Code.UNKNOWN_FIELD]),
        (f"{{{TWIST}, ttl: 1s, deadman: {{timeout: 1s, send: {{linear.x: '1 / 0'}}}}}}", [Code.OUT_OF_RANGE]),
        (f"{{{TWIST}, ttl: 1s, deadman: {{timeout: 1s, send: {{linear.x: sqrt(-1)}}}}}}", [Code.BAD_VALUE]),
        (
            "{topic: /a, type: std_msgs/msg/UInt8, ttl: 1s, deadman: {timeout: 1s, send: {data: 256}}}",
            [Code.OUT_OF_RANGE],
        ),
    ],
)
def test_what_is_let_in_is_checked(check_text: CheckText, inbound: str, found: list[Code]) -> None:
    assert codes(check_text, f"it: {{{TCP}, inbound: [{inbound}]}}") == found


def test_everything_that_is_wrong_is_found_in_one_run(check_text: CheckText) -> None:
    gateway = f"here: {{{TCP}, topics: {{include: [a]}}, max_message: 5B, inbound: [{{topic: /1st, type: x, ttl: 3}}]}}"
    assert len(codes(check_text, gateway)) == 6


@pytest.mark.parametrize(
    ("routes", "inbound", "found"),
    [
        (PUBLISHES % "/a", "{topic: /a, type: std_msgs/msg/Float32}", []),
        (PUBLISHES % "a", "{topic: /a, type: std_msgs/msg/Float64}", [Code.TOPIC_TYPE_CLASH]),
        (SUBSCRIBES % "a", "{topic: /a, type: std_msgs/msg/Float64}", [Code.TOPIC_TYPE_CLASH]),
        (PUBLISHES % "/a", "{topic: /a, type: std_msgs/msg/Float32, queue_depth: 3}", [Code.QOS_CONFLICT]),
        (SUBSCRIBES % "/a", "{topic: /a, type: std_msgs/msg/Float32, queue_depth: 3}", []),
        (
            SUBSCRIBES % "/a",
            "{topic: /a, type: std_msgs/msg/Float32, qos: {reliability: best_effort}}",
            [Code.QOS_CONFLICT],
        ),
    ],
)
def test_clients_publish_as_routes_do(check_text: CheckText, routes: str, inbound: str, found: list[Code]) -> None:
    assert codes(check_text, f"it: {{{TCP}, inbound: [{inbound}]}}", routes) == found


@pytest.mark.parametrize(("second", "found"), [("Float32", []), ("Float64", [Code.TOPIC_TYPE_CLASH])])
def test_gateways_that_let_in_one_topic_agree_on_its_type(
    check_text: CheckText, second: str, found: list[Code]
) -> None:
    a = f"a: {{{TCP}, inbound: [{{topic: /a, type: std_msgs/msg/Float32}}]}}"
    b = f"b: {{{ZENOH}, inbound: [{{topic: a, type: std_msgs/msg/{second}}}]}}"
    assert codes(check_text, f"{a}, {b}") == found


DEADMAN = "ttl: 200ms, deadman: {timeout: 500ms, send: {}}"


@pytest.mark.parametrize(
    ("routes", "first", "second", "found"),
    [
        (NO_ROUTES, "", "", 0),
        (NO_ROUTES, DEADMAN, "", 1),
        (NO_ROUTES, DEADMAN, DEADMAN, 2),
        (PUBLISHES % "/b", DEADMAN, None, 0),
        (PUBLISHES % "/a", DEADMAN, None, 1),
        (SUBSCRIBES % "/a", DEADMAN, None, 0),
        (BRAKES % "/a", DEADMAN, None, 1),
        (BRAKES % "/a", "ttl: 200ms", None, 0),
        (BRAKES % "/b", DEADMAN, None, 0),
    ],
)
def test_a_deadman_does_not_meet_the_messages_of_others(
    check_text: CheckText, routes: str, first: str, second: str | None, found: int
) -> None:
    topic = "topic: /a, type: std_msgs/msg/Float32"
    gateways = f"one: {{{TCP}, inbound: [{{{topic}, {first}}}]}}"
    if second is not None:
        gateways += f", other: {{{ZENOH}, inbound: [{{{topic}, {second}}}]}}"
    assert codes(check_text, gateways, routes) == [Code.BAD_VALUE] * found
    assert blamed(check_text, gateways, routes) == ["deadman"] * found


def test_inbound_topics_are_planned_by_absolute_names_and_published_once(check_text: CheckText) -> None:
    twist = "type: geometry_msgs/msg/Twist"
    a = f"a: {{{UDP}, inbound: [{{topic: cmd_vel, {twist}, ttl: 300ms, max_rate: 20 Hz}}, {{topic: ~/x, {twist}}}]}}"
    b = f"b: {{{TCP}, inbound: [{{topic: /ns/cmd_vel, {twist}}}]}}"
    program = checked(check_text, f"{a}, {b}", node="{name: router, namespace: /ns}").program
    assert program
    first, second = program.gateways
    assert list(first.inbound) == ["/ns/cmd_vel", "/ns/router/x"]
    plan = first.inbound["/ns/cmd_vel"]
    assert (plan.label, plan.type.name) == ("/ns/cmd_vel", "geometry_msgs/msg/Twist")
    assert plan.settings.ttl is not None
    assert (plan.settings.ttl.value, plan.settings.topic.max_rate) == (300_000_000, 20.0)
    assert list(second.inbound) == ["/ns/cmd_vel"]
    assert [topic.label for topic in program.publishers] == ["/ns/cmd_vel", "/ns/router/x"]
    assert "geometry_msgs/msg/Vector3" in program.publishers[0].definitions


@pytest.mark.parametrize(
    ("type_name", "send", "cdr"),
    [
        ("std_msgs/msg/Empty", "{}", "00010000 00"),
        ("std_msgs/msg/Float64", "{}", "00010000 0000000000000000"),
        ("std_msgs/msg/Float64", "{data: -0.5}", "00010000 000000000000e0bf"),
        ("std_msgs/msg/Float64", "{data: sqrt(6.25)}", "00010000 0000000000000440"),
        ("geometry_msgs/msg/Vector3", "{y: 1.0}", "00010000 0000000000000000 000000000000f03f 0000000000000000"),
        ("std_msgs/msg/String", "{data: \"'halt'\"}", "00010000 05000000 68616c7400"),
        ("std_msgs/msg/String", "{}", "00010000 01000000 00"),
        ("std_msgs/msg/UInt8MultiArray", "{data: [1, 2]}", "00010000 00000000 00000000 02000000 0102"),
        ("sensor_msgs/msg/NavSatStatus", "{status: NavSatStatus.STATUS_NO_FIX}", "00010000 ff00 0000"),
    ],
)
def test_what_a_deadman_publishes_is_known_before_the_start(
    check_text: CheckText, type_name: str, send: str, cdr: str
) -> None:
    inbound = f"{{topic: /a, type: {type_name}, deadman: {{timeout: 1s, send: {send}, repeat: 50ms}}}}"
    program = checked(check_text, f"it: {{{TCP}, inbound: [{inbound}]}}").program
    assert program
    deadman = program.gateways[0].inbound["/a"].deadman
    assert deadman
    assert (deadman.route, deadman.timeout, deadman.repeat) == ("it:/a", 10**9, 50_000_000)
    assert deadman.datagrams == (("/a", (bytes.fromhex(cdr),)),)
    assert program.deadmen == ()


def test_an_ignored_gateway_has_no_series_no_address_and_no_name(check_text: CheckText) -> None:
    found = checked(check_text, f"here: {{ignore: nobody looks}}, it: {{{TCP}}}")
    assert found.diagnostics == []
    assert found.program
    assert [gateway.settings.name for gateway in found.program.gateways] == ["it"]
    names = {series.labels[0] for series, _ in found.program.counters.series() if series.metric == "messages_sent"}
    assert names == {"it"}


def test_its_network_is_counted_of_a_zenoh_gateway_alone(check_text: CheckText) -> None:
    found = checked(check_text, f"far: {{transport: {{zenoh: {{key: a}}}}}}, it: {{{TCP}}}")
    assert found.program
    series = {(each.metric, *each.labels) for each, _ in found.program.counters.series()}
    ours = {each for each in series if each[0] in ("gateway_key_conflicts", "gateway_connections")}
    assert ours == {("gateway_key_conflicts", "far"), ("gateway_connections", "far", "peer")}


def test_every_series_of_a_gateway_is_there_from_the_start(check_text: CheckText) -> None:
    deadman = "deadman: {timeout: 1s, send: {}}"
    program = checked(check_text, f"it: {{{UDP}, inbound: [{{{TWIST}, {deadman}}}]}}").program
    assert program
    topic, watch = "/cmd_vel", "it:/cmd_vel"
    expected = {
        ("datagrams_received", "it"),
        ("received_bytes", "it"),
        *(("datagrams_rejected", "it", reason) for reason in GATEWAY_REJECT_REASONS),
        ("messages_received", "it", "ros"),
        ("messages_received", "it", CLIENTS),
        ("messages_published", "it", topic),
        *(("messages_dropped", "it", topic, reason) for reason in INBOUND_DROP_REASONS),
        ("messages_sent", "it", CLIENTS),
        ("messages_filtered", "it", CLIENTS),
        *(("messages_dropped", "it", CLIENTS, reason) for reason in GATEWAY_DROP_REASONS),
        ("datagrams_sent", "it", "udp"),
        ("sent_bytes", "it", "udp"),
        ("gateway_clients", "it"),
        ("gateway_client_clock_ahead", "it"),
        *(("gateway_topics", "it", state) for state in TOPIC_STATES),
        *(("client_messages_dropped", "it", reason) for reason in CLIENT_DROP_REASONS),
        ("route_silence_seconds", "it"),
        *(("qos_incompatible", "it", topic, policy) for policy in QOS_POLICIES),
        ("deadman_active", watch),
        ("deadman_trips", watch),
        ("deadman_datagrams_sent", watch, topic),
        ("deadman_send_errors", watch, topic),
    }
    series = {(each.metric, *each.labels) for each, _ in program.counters.series()}
    assert {each for each in series if each[1:] and re.match("it(:|$)", each[1])} == expected


@pytest.mark.parametrize(
    ("keys", "are_commands"), [("ttl: 1s", True), ("deadman: {timeout: 1s, send: {}}", True), ("max_rate: 1 Hz", False)]
)
def test_what_clients_publish_with_a_time_limit_or_a_deadman_are_commands(
    check_text: CheckText, keys: str, are_commands: bool
) -> None:
    program = checked(check_text, f"it: {{{UDP}, inbound: [{{{TWIST}, {keys}}}]}}").program
    assert program
    assert program.counters.are_commands("it", "/cmd_vel") is are_commands
    assert not program.counters.are_commands("it", CLIENTS)


def test_a_deadman_of_clients_may_publish_nan(check_text: CheckText) -> None:
    deadman = "{timeout: 1s, send: {linear.x: nan}}"
    assert codes(check_text, f"it: {{{UDP}, inbound: [{{{TWIST}, ttl: 1s, deadman: {deadman}}}]}}") == []


NO_GOSSIP = "config: {scouting: {gossip: {enabled: false}}}"
LOCATORS = "listen: [tcp/127.0.0.1:7447]"
TO_A_ROUTER = "mode: client, connect: [tcp/127.0.0.1:7447]"


@pytest.mark.parametrize(
    ("zenoh", "does"),
    [
        ("", "listens on all networks of this machine and discovers others by multicast and gossip"),
        ("mode: router", "listens on all networks of this machine and discovers others by multicast and gossip"),
        (f"connect: [tcp/127.0.0.1:7447], {NO_GOSSIP}", "listens on all networks of this machine"),
        (LOCATORS, "discovers others by gossip"),
        (f"mode: router, {LOCATORS}", "discovers others by gossip"),
        (f"{LOCATORS}, {NO_GOSSIP}", ""),
        (
            f"{LOCATORS}, config: {{scouting: {{multicast: {{enabled: true}}, gossip: {{enabled: false}}}}}}",
            "multicast",
        ),
        ("mode: client", "discovers others by multicast"),
        (TO_A_ROUTER, ""),
        (f"{TO_A_ROUTER}, config: {{scouting: {{multicast: {{enabled: true}}}}}}", "discovers others by multicast"),
        (f"{LOCATORS}, config: zenoh.json5", "discovers others by multicast"),
    ],
)
def test_what_zenoh_does_without_an_address_has_no_place_beside_networks(
    check_text: CheckText, tmp_path: Path, zenoh: str, does: str
) -> None:
    (tmp_path / "zenoh.json5").write_text("{scouting: {multicast: {enabled: true}, gossip: {enabled: false}}}")
    gateway = f"it: {{transport: {{zenoh: {{{', '.join(filter(None, ('key: rover', zenoh)))}}}}}}}"
    assert checked(check_text, gateway).diagnostics == []
    found = checked(check_text, gateway, "networks: [127.0.0.0/8]\nroutes: {}")
    assert [finding.code for finding in found.diagnostics] == ([Code.OUTSIDE_NETWORKS] if does else [])
    assert not does or does in found.diagnostics[0].message
    if not does:
        assert found.table
        settings = found.table.gateways["it"].zenoh
        assert settings
        config = session_config(settings)
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert settings.mode == "client" or config.get_json("scouting/gossip/enabled") == "false"


ONLY = "version: 1\ngateways: {headset: {transport: {udp: 127.0.0.9:8502}}}\n"
ENVELOPE = f"envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}\n"
LISTEN = "listen: {rover: {address: 127.0.0.1:5000}}\n"
ROUTES = "routes: {ph_info: {source: any, topics: [{topic: ph, type: comms/msg/SensorBoardPHInfo, fields: auto}]}}\n"


def check_file(folder: Path, text: str, name: str = "table.yaml", known: Definitions | None = None) -> Checked:
    path = folder / name
    path.write_text(text)
    return check_table(path, {}, known)


def errors(found: Checked) -> list[Diagnostic]:
    return [each for each in found.diagnostics if each.severity is Severity.ERROR]


def said(found: Checked) -> list[str]:
    return [str(finding) for finding in found.diagnostics]


def test_it_compiles_and_nothing_is_to_be_said_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PROTOS)  # the lock here is none of its business
    found = check_file(tmp_path, ONLY)
    assert said(found) == []
    program = found.program
    assert program is not None
    assert [plan.settings.name for plan in program.gateways] == ["headset"]
    assert (program.listeners, program.senders, dict(program.inbound), dict(program.outbound)) == ((), (), {}, {})
    assert watched_files(program.table) == [tmp_path / "table.yaml"]


def test_a_type_whose_source_is_here_but_not_built_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = Path("schemas", "ours", "msg", "Lamp.msg")
    source.parent.mkdir(parents=True)
    source.write_text("bool is_on\n")
    inbound = "receive: 127.0.0.1:8500, inbound: [{topic: /lamp, type: ours/msg/Lamp}]"
    [finding] = check_file(tmp_path, ONLY.replace("8502}", "8502}, " + inbound)).diagnostics
    assert finding.hint == "it is in schemas/ours/msg, but not built: build and source ours"


@pytest.mark.parametrize("envelope", [ENVELOPE, "extends: base.yaml\n"])
def test_an_envelope_that_nothing_uses_asks_for_no_routes(tmp_path: Path, envelope: str) -> None:
    (tmp_path / "base.yaml").write_text(ENVELOPE)
    assert said(check_file(tmp_path, envelope + ONLY)) == []


def test_with_routes_it_is_a_table_as_any_other(tmp_path: Path) -> None:
    assert [each.code for each in check_file(tmp_path, ONLY + ENVELOPE + LISTEN + ROUTES).diagnostics] == [
        Code.UNCOVERED_PAYLOAD_CASE
    ]
    lacking = {
        ONLY + ROUTES: ["envelope", "listen"],
        ONLY + ROUTES + LISTEN: ["envelope"],
        ONLY + ROUTES + ENVELOPE: ["listen"],
        ONLY + LISTEN: ["envelope", "routes"],
        ONLY + LISTEN + ENVELOPE: ["routes"],
        "version: 1\n" + ENVELOPE + LISTEN: ["routes"],
        "version: 1\n" + ROUTES: ["envelope", "listen"],
        "version: 1\n" + ENVELOPE: ["listen", "routes"],
        "version: 1\ngateways: {}\n": ["envelope", "listen", "routes"],
        "version: 1\n": ["envelope", "listen", "routes"],
    }
    for text, keys in lacking.items():
        found = check_file(tmp_path, text)
        assert [each.message for each in errors(found)] == [f"the table lacks the key '{key}'" for key in keys]
        assert all("'gateways'" in each.hint for each in errors(found))
        assert found.program is None


def test_what_is_needed_is_asked_of_the_whole_table(tmp_path: Path) -> None:
    (tmp_path / "only.yaml").write_text(ONLY)
    [finding] = check_file(tmp_path, "extends: only.yaml\n" + ENVELOPE + LISTEN + "routes: {}\n").diagnostics
    assert finding.code is Code.UNCOVERED_PAYLOAD_CASE
    found = check_file(tmp_path, "extends: only.yaml\n" + ENVELOPE + ROUTES)
    assert [each.message for each in errors(found)] == ["the table lacks the key 'listen'"]


def test_a_reload_reads_no_protos_for_it_and_those_of_the_next_table(tmp_path: Path) -> None:
    only = check_file(tmp_path, ONLY).program
    assert only is not None
    routed = check_file(tmp_path, ONLY + ENVELOPE + LISTEN + ROUTES, known=Definitions(only.envelopes.schemas)).program
    assert routed is not None
    assert len(routed.envelopes.first.cases) == 26
    again = check_file(tmp_path, ONLY, known=Definitions(routed.envelopes.schemas)).program
    assert again is not None
    assert not again.envelopes.first.cases


def test_a_datagram_from_before_the_reload_has_no_payload(tmp_path: Path) -> None:
    program = check_file(tmp_path, ONLY).program
    assert program is not None
    assert Classifier(program.envelopes, program.table).payloads("rover", b"\xca\x01\x02\x08\x01") == []
