"""Gateways as the table has them: typed, with defaults by transport, and refused where they mean nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from router.errors import Code, Diagnostic
from router.table.addresses import Address
from router.table.model import EACH, Gateway, GatewayFormat, RouteTable, Transport, ZenohSettings
from tests.table.tables import GATEWAY, load, places

HEAD = """\
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
listen: {rover: {address: 0.0.0.0:5000}}
routes: {}
gateways:
"""


def table_with(folder: Path, gateways: str) -> tuple[RouteTable, list[Diagnostic]]:
    table, findings = load(folder, HEAD + gateways)
    assert table
    return table, findings


def gateway(folder: Path, settings: str) -> Gateway:
    table, findings = table_with(folder, f"  it: {{{settings}}}\n")
    assert findings == []
    return table.gateways["it"]


def test_a_gateway_is_typed(tmp_path: Path) -> None:
    table, findings = table_with(tmp_path, GATEWAY)
    assert findings == []
    found = table.gateways["vr_headset"]
    assert (found.name, found.span.line, found.transport.value) == ("vr_headset", 6, Transport.UDP)
    assert found.address
    assert found.receive
    assert (found.address.value, found.receive.value) == (Address("10.0.20.219", 8502), Address("10.0.0.230", 8500))
    assert found.format is GatewayFormat.GATEWAY_V2
    assert [(pattern.text, pattern.is_regex) for pattern in found.include] == [("/rover/**", False), ("/imu/.*", True)]
    assert [pattern.text for pattern in found.exclude] == ["/rover/camera/**"]
    assert (found.publish_period, found.schema_period, found.discovery_period) == (EACH, 10**9, 2 * 10**9)
    assert (found.compression, found.max_datagram, found.max_outbound) == (3, 8000, 1 << 20)
    rates = [(rate.pattern.text, rate.period) for rate in found.rates]
    assert rates == [("/rover/imu", 20_000_000), ("/tf", EACH), ("/slow", 2 * 10**9)]


def test_what_clients_may_publish_is_typed(tmp_path: Path) -> None:
    first, second = table_with(tmp_path, GATEWAY)[0].gateways["vr_headset"].inbound
    assert (first.topic.topic.value, first.topic.type.value) == ("/cmd_vel", "geometry_msgs/msg/Twist")
    assert first.ttl
    assert first.deadman
    assert (first.ttl.value, first.topic.max_rate) == (300_000_000, 20.0)
    assert (first.deadman.timeout.value, first.deadman.repeat.value) == (500_000_000, 100_000_000)
    assert [entry.path for entry in first.deadman.fields.entries] == [("linear", "x"), ("angular", "z")]
    assert second.deadman
    assert (second.deadman.repeat.value, second.deadman.fields.entries) == (50_000_000, ())
    assert (second.ttl, second.topic.max_rate) == (None, None)


@pytest.mark.parametrize(
    ("transport", "given"),
    [
        ("udp: 127.0.0.1:8502", GatewayFormat.GATEWAY_V1),
        ("tcp: 0.0.0.0:8600", GatewayFormat.GATEWAY_V1),
        ("websocket: 0.0.0.0:8765", GatewayFormat.JSON),
        ("zenoh: {key: rovers/one}", GatewayFormat.GATEWAY_V1),
    ],
)
def test_what_is_left_out_has_a_default(tmp_path: Path, transport: str, given: GatewayFormat) -> None:
    found = gateway(tmp_path, f"transport: {{{transport}}}")
    assert (found.format, found.include, found.exclude, found.rates, found.inbound) == (given, (), (), (), ())
    assert (found.publish_period, found.schema_period, found.discovery_period) == (500_000_000, 5 * 10**9, 5 * 10**9)
    assert (found.compression, found.max_datagram, found.max_outbound, found.max_inbound) == (
        0,
        1400,
        16 << 20,
        64 << 10,
    )
    assert (found.max_clients, found.max_clients_per_host) == (1024, 16)
    assert found.receive is None


def test_zenoh_has_no_address_but_a_network(tmp_path: Path) -> None:
    found = gateway(tmp_path, "transport: {zenoh: {key: a/b, mode: client, connect: [tcp/10.0.0.1:7447]}}")
    assert found.address is None
    assert found.zenoh
    assert found.zenoh.key.value == "a/b"
    assert found.zenoh == ZenohSettings(found.zenoh.key, "client", ("tcp/10.0.0.1:7447",), ())


def test_a_mapping_for_zenoh_has_the_places_of_its_keys_and_items(tmp_path: Path) -> None:
    settings = "transport: {zenoh: {key: a, config: {qos: {publication: [{key_exprs: [b]}]}, id: '12'}}}"
    config = (found := gateway(tmp_path, settings)).zenoh and found.zenoh.config
    assert config
    assert json.loads(config.text) == {"qos": {"publication": [{"key_exprs": ["b"]}]}, "id": "12"}
    assert config.path is None
    written = f"  it: {{{settings}}}"
    columns = {path: place.column for path, place in config.places.items()}
    assert columns == {
        ("qos",): written.index("qos") + 1,
        ("qos", "publication"): written.index("publication") + 1,
        ("qos", "publication", 0): written.index("{key_exprs") + 1,
        ("qos", "publication", 0, "key_exprs"): written.index("key_exprs") + 1,
        ("qos", "publication", 0, "key_exprs", 0): written.index("b]") + 1,
        ("id",): written.index("id:") + 1,
    }


def test_a_file_for_zenoh_is_beside_the_table_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "zenoh.json5").write_text("{id: 'secret'}")
    found = gateway(tmp_path, "transport: {zenoh: {key: a, config: below/zenoh.json5}}").zenoh
    assert found
    assert found.config
    assert (found.config.path, found.config.text) == (tmp_path / "below" / "zenoh.json5", "{id: 'secret'}")
    assert "secret" not in repr(found)


@pytest.mark.parametrize(("name", "why"), [("none", "no such file"), (".", "no ordinary file"), ("latin", "UTF-8")])
def test_a_file_for_zenoh_that_cannot_be_read_is_blamed_on_the_line_that_names_it(
    tmp_path: Path, name: str, why: str
) -> None:
    (tmp_path / "latin").write_bytes("{id: 'ü'}".encode("latin-1"))
    [finding] = table_with(tmp_path, f"  it: {{transport: {{zenoh: {{key: a, config: {name}}}}}}}\n")[1]
    assert (finding.code, finding.span.line) == (Code.BAD_FILE, 6)
    assert why in finding.message


UDP = "transport: {udp: 127.0.0.1:8502}"
TCP = "transport: {tcp: 127.0.0.1:8600}"
WEB = "transport: {websocket: 127.0.0.1:8765}"
ZENOH = "transport: {zenoh: {key: a}}"


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ("receive: 127.0.0.1:8500", Code.MISSING_KEY),
        ("transport: {}", Code.BAD_VALUE),
        ("transport: 127.0.0.1:8500", Code.WRONG_TYPE),
        ("transport: {udp: 127.0.0.1:8502, tcp: 127.0.0.1:8600}", Code.BAD_VALUE),
        ("transport: {sctp: 127.0.0.1:8502}", Code.UNKNOWN_KEY),
        ("transport: {udp: 127.0.0.1}", Code.BAD_ADDRESS),
        ("transport: {udp: 239.0.0.1:8502}", Code.BAD_ADDRESS),
        ("transport: {udp: 0.0.0.0:8502}", Code.BAD_ADDRESS),
        ("transport: {tcp: 239.0.0.1:8502}", Code.BAD_ADDRESS),
        (f"{UDP}, receive: nowhere", Code.BAD_ADDRESS),
        (f"{UDP}, receive: 239.0.0.1:80", Code.BAD_ADDRESS),
        (f"{UDP}, format: xml", Code.BAD_VALUE),
        (f"{UDP}, format: json", Code.BAD_VALUE),
        (f"{TCP}, format: gateway_v2", Code.BAD_VALUE),
        (f"{WEB}, format: json_lines", Code.BAD_VALUE),
        (f"{ZENOH}, format: json_lines", Code.BAD_VALUE),
        (f"{TCP}, receive: 127.0.0.1:8500", Code.UNKNOWN_KEY),
        (f"{WEB}, receive: 127.0.0.1:8500", Code.UNKNOWN_KEY),
        (f"{ZENOH}, receive: 127.0.0.1:8500", Code.UNKNOWN_KEY),
        (f"{UDP}, max_clients: 3", Code.UNKNOWN_KEY),
        (f"{ZENOH}, max_clients: 3", Code.UNKNOWN_KEY),
        (f"{TCP}, max_clients: 0", Code.BAD_VALUE),
        (f"{UDP}, max_clients_per_host: 3", Code.UNKNOWN_KEY),
        (f"{ZENOH}, max_clients_per_host: 3", Code.UNKNOWN_KEY),
        (f"{TCP}, max_clients_per_host: 0", Code.BAD_VALUE),
        (f"{UDP}, max_datagram: 1400B", Code.UNKNOWN_KEY),
        (f"{UDP}, format: gateway_v2, max_datagram: 575B", Code.BAD_VALUE),
        (f"{UDP}, format: gateway_v2, max_datagram: 1400", Code.WRONG_TYPE),
        (f"{UDP}, max_message: 257MiB", Code.BAD_VALUE),
        (f"{UDP}, compression: {{zstd: 23}}", Code.BAD_VALUE),
        (f"{UDP}, compression: 3", Code.WRONG_TYPE),
        (f"{WEB}, compression: {{zstd: 3}}", Code.UNKNOWN_KEY),
        (f"{TCP}, format: json_lines, compression: {{zstd: 3}}", Code.UNKNOWN_KEY),
        (f"{UDP}, publish_period: never", Code.BAD_VALUE),
        (f"{UDP}, publish_period: 999us", Code.BAD_VALUE),
        (f"{UDP}, discovery_period: 9ms", Code.BAD_VALUE),
        (f"{UDP}, schema_period: each", Code.BAD_VALUE),
        (f"{UDP}, rates: {{/a: 1001}}", Code.BAD_VALUE),
        (f"{UDP}, rates: {{/a: 1001 Hz}}", Code.BAD_VALUE),
        (f"{UDP}, rates: {{/a: never}}", Code.BAD_VALUE),
        (f"{UDP}, rates: [/a]", Code.WRONG_TYPE),
        (f"{UDP}, topics: [/a]", Code.WRONG_TYPE),
        (f"{UDP}, topics: {{include: []}}", Code.BAD_VALUE),
        (f"{UDP}, topics: {{include: [{{glob: /a}}]}}", Code.UNKNOWN_KEY),
        (f"{UDP}, inbound: [{{topic: /a, type: std_msgs/msg/Empty}}]", Code.MISSING_KEY),
        ("publish_period: 1s", Code.MISSING_KEY),
        ("ignore: no page, publish_period: 1s", Code.UNKNOWN_KEY),
        ('ignore: ""', Code.BAD_VALUE),
        ("ignore: 5", Code.WRONG_TYPE),
        (f"{TCP}, inbound: [{{topic: /a}}]", Code.MISSING_KEY),
        (f"{TCP}, inbound: [{{topic: /a, type: std_msgs/msg/Empty, deadman: {{timeout: 1s}}}}]", Code.MISSING_KEY),
        (f"{TCP}, inbound: [{{topic: /a, type: std_msgs/msg/Empty, fields: auto}}]", Code.UNKNOWN_KEY),
        ("transport: {zenoh: {}}", Code.MISSING_KEY),
        ("transport: {zenoh: {key: /a}}", Code.BAD_VALUE),
        ("transport: {zenoh: {key: a/**}}", Code.BAD_VALUE),
        ("transport: {zenoh: {key: a, connect: [10.0.0.1:7447]}}", Code.BAD_VALUE),
    ],
)
def test_what_means_nothing_is_one_finding(tmp_path: Path, settings: str, code: Code) -> None:
    table, findings = table_with(tmp_path, f"  it: {{{settings}}}\n")
    assert [finding.code for finding in findings] == [code], list(map(str, findings))
    assert "gateways/it" in table.broken


def test_the_sound_part_of_a_gateway_is_there_for_further_checks(tmp_path: Path) -> None:
    settings = f"{TCP}, max_message: 1B, inbound: [{{topic: /a, type: x/msg/Y, ttl: 5}}, {{topic: /b}}]"
    table, findings = table_with(tmp_path, f"  it: {{{settings}}}\n")
    assert sorted(finding.code.value for finding in findings) == ["bad-value", "missing-key", "wrong-type"]
    [inbound] = table.gateways["it"].inbound
    assert (inbound.topic.topic.value, inbound.ttl) == ("/a", None)


def test_a_misspelt_transport_is_read_as_the_one_that_was_meant(tmp_path: Path) -> None:
    table, findings = table_with(tmp_path, "  it: {transport: {websoket: 127.0.0.1:8765}}\n")
    assert [finding.code for finding in findings] == [Code.UNKNOWN_KEY]
    assert table.gateways["it"].transport.value is Transport.WEBSOCKET


def test_a_gateway_without_a_sound_transport_is_left_out(tmp_path: Path) -> None:
    table, _ = table_with(tmp_path, f"  it: {{transport: {{udp: 1.2.3.4}}}}\n  other: {{{TCP}}}\n")
    assert list(table.gateways) == ["other"]


@pytest.mark.parametrize("name", ["any", "ros", "1st", "a:b"])
def test_names_are_those_of_endpoints(tmp_path: Path, name: str) -> None:
    _, findings = table_with(tmp_path, f"  {name}: {{{UDP}}}\n")
    assert places(findings) == [(Code.BAD_VALUE, 6, 3)]


def test_a_table_that_extends_another_replaces_the_transport_and_merges_the_rest(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + f"  it: {{{UDP}, publish_period: 1s, rates: {{/a: 1 Hz}}}}\n")
    over = f"extends: base.yaml\ngateways: {{it: {{{TCP}, rates: {{/b: 2 Hz}}}}}}\n"
    table, findings = load(tmp_path, over)
    assert findings == []
    assert table
    found = table.gateways["it"]
    assert (found.transport.value, found.publish_period) == (Transport.TCP, 10**9)
    assert [rate.pattern.text for rate in found.rates] == ["/a", "/b"]


def test_a_table_that_extends_another_merges_the_settings_of_one_transport(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + "  it: {transport: {zenoh: {key: a, mode: router}}}\n")
    table, _ = load(tmp_path, "extends: base.yaml\ngateways: {it: {transport: {zenoh: {key: b}}}}\n")
    assert table
    zenoh = table.gateways["it"].zenoh
    assert zenoh
    assert (zenoh.key.value, zenoh.mode) == ("b", "router")


def test_an_ignored_gateway_is_none(tmp_path: Path) -> None:
    table, findings = table_with(tmp_path, f"  it: {{ignore: no page on this rover}}\n  other: {{{TCP}}}\n")
    assert findings == []
    assert list(table.gateways) == ["other"]
    [ignored] = table.ignored_gateways.values()
    assert (ignored.name, ignored.reason, ignored.span.line) == ("it", "no page on this rover", 6)


def test_a_table_that_extends_another_turns_a_gateway_off_and_on_as_a_whole(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + f"  it: {{{UDP}, publish_period: 1s}}\n")
    (tmp_path / "off.yaml").write_text("extends: base.yaml\ngateways: {it: {ignore: nobody looks}}\n")
    table, findings = load(tmp_path, "extends: off.yaml\n")
    assert table
    assert (findings, list(table.gateways), list(table.ignored_gateways)) == ([], [], ["it"])
    table, findings = load(tmp_path, f"extends: off.yaml\ngateways: {{it: {{{TCP}}}}}\n")
    assert table
    assert (findings, list(table.gateways), list(table.ignored_gateways)) == ([], ["it"], [])
    assert table.gateways["it"].publish_period == 500_000_000
    table, findings = load(tmp_path, "extends: off.yaml\ngateways: {it: {ignore: for another reason}}\n")
    assert table
    assert (findings, table.ignored_gateways["it"].reason) == ([], "for another reason")
