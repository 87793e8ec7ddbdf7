"""Gateways as the table has them: typed, with defaults by transport, and refused where they mean nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from router.errors import Code
from router.table.keys import flat
from router.table.model.gateways import Gateway, Transport
from tests.table.tables import GATEWAY, SMALL, good, parts, places, shown

HEAD = f"{SMALL}gateways:\n"


def gateway(folder: Path, settings: str) -> Gateway:
    return good(folder, f"{HEAD}  it: {{{settings}}}\n").gateways["it"]


def test_a_gateway_is_typed(tmp_path: Path) -> None:
    found = good(tmp_path, HEAD + GATEWAY).gateways["vr_headset"]
    assert found.span.line == 6
    assert shown(found) == {
        "name": "vr_headset", "transport": "udp", "address": "10.0.20.219:8502", "receive": "10.0.0.230:8500",
        "format": "gateway_v2", "topics.include": "/rover/**, {regex: /imu/.*}", "topics.exclude": "/rover/camera/**",
        "publish_period": "each", "schema_period": "1 s", "discovery_period": "2 s", "compression.zstd": "3",
        "rates": "/rover/imu: 50 Hz, /tf: each, /slow: 0.5 Hz", "max_datagram": "8 kB", "max_message": "1 MiB",
        "max_topics": "500", "max_clients": "1024", "max_clients_per_host": "16",
        "inbound.0.topic.topic": "/cmd_vel", "inbound.0.topic.type": "geometry_msgs/msg/Twist",
        "inbound.0.topic.qos.depth": "3", "inbound.0.ttl": "300 ms", "inbound.0.max_lead": "2 s",
        "inbound.0.topic.max_rate": "20 Hz",
        "inbound.0.topic.on_limit": "first", "inbound.0.deadman.timeout": "500 ms",
            "inbound.0.deadman.repeat": "100 ms",
        "inbound.0.deadman.at_start": "send", "inbound.0.deadman.send": "{linear.x: 0.0, angular.z: 1}",
        "inbound.1.topic.topic": "/stop", "inbound.1.topic.type": "std_msgs/msg/Empty",
            "inbound.1.topic.on_limit": "first",
        "inbound.1.max_lead": "2 s", "inbound.1.deadman.timeout": "1 s",
        "inbound.1.deadman.repeat": "50 ms", "inbound.1.deadman.at_start": "send",
        "inbound.1.deadman.send": "{}",
    }  # fmt: skip
    assert found.max_outbound == 1 << 20


@pytest.mark.parametrize(
    ("transport", "kind", "format_"),
    [
        ("udp: 127.0.0.1:8502", "udp", "gateway_v1"),
        ("tcp: 0.0.0.0:8600", "tcp", "gateway_v1"),
        ("websocket: 0.0.0.0:8765", "websocket", "json"),
        ("zenoh: {key: rovers/one}", "zenoh", "gateway_v1"),
    ],
)
def test_what_is_left_out_has_a_default(tmp_path: Path, transport: str, kind: str, format_: str) -> None:
    found = gateway(tmp_path, f"transport: {{{transport}}}")
    where = (
        {"zenoh.key": "rovers/one", "zenoh.mode": "peer"}
        if kind == "zenoh"
        else {"address": transport[len(kind) + 2 :]}
    )
    assert flat(found) == {
        "name": "it", "transport": kind, **where, "format": format_, "publish_period": "500 ms",
        "schema_period": "5 s", "discovery_period": "5 s", "compression.zstd": "0", "max_datagram": "1400 B",
        "max_topics": "500", "max_clients": "1024", "max_clients_per_host": "16",
    }  # fmt: skip
    assert (found.max_outbound, found.max_inbound) == (16 << 20, 64 << 10)


def test_zenoh_has_no_address_but_a_network(tmp_path: Path) -> None:
    found = gateway(tmp_path, "transport: {zenoh: {key: a/b, mode: client, connect: [tcp/10.0.0.1:7447]}}")
    assert found.address is None
    assert flat(found.zenoh) == {"key": "a/b", "mode": "client", "connect": "tcp/10.0.0.1:7447"}


def test_a_mapping_for_zenoh_has_the_places_of_its_keys_and_items(tmp_path: Path) -> None:
    settings = "transport: {zenoh: {key: a, config: {qos: {publication: [{key_exprs: [b]}]}, id: '12'}}}"
    config = (found := gateway(tmp_path, settings)).zenoh and found.zenoh.config
    assert config
    assert json.loads(config.text) == {"qos": {"publication": [{"key_exprs": ["b"]}]}, "id": "12"}
    assert config.path is None
    written = f"  it: {{{settings}}}"
    columns = {path: place.column for path, place in config.spans.items()}
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


@pytest.mark.parametrize(("name", "why"), [("none", "no such file"), (".", "not a regular file"), ("latin", "UTF-8")])
def test_a_file_for_zenoh_that_cannot_be_read_is_blamed_on_the_line_that_names_it(
    tmp_path: Path, name: str, why: str
) -> None:
    (tmp_path / "latin").write_bytes("{id: 'ü'}".encode("latin-1"))
    _, [finding] = parts(tmp_path, f"{HEAD}  it: {{transport: {{zenoh: {{key: a, config: {name}}}}}}}\n")
    assert (finding.code, finding.span.line) == (Code.BAD_FILE, 6)
    assert why in finding.message


UDP = "transport: {udp: 127.0.0.1:8502}"
TCP = "transport: {tcp: 127.0.0.1:8600}"
WEB = "transport: {websocket: 127.0.0.1:8765}"
ZENOH = "transport: {zenoh: {key: a}}"


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        (f"{UDP}, receive: 239.0.0.1:80", Code.BAD_ADDRESS),
        (f"{WEB}, receive: 127.0.0.1:8500", Code.UNKNOWN_KEY),
        (f"{ZENOH}, receive: 127.0.0.1:8500", Code.UNKNOWN_KEY),
        (f"{UDP}, max_clients_per_host: 3", Code.UNKNOWN_KEY),
        (f"{ZENOH}, max_clients_per_host: 3", Code.UNKNOWN_KEY),
        (f"{TCP}, max_clients_per_host: 0", Code.BAD_VALUE),
        (f"{UDP}, format: gateway_v2, max_datagram: 1400", Code.WRONG_TYPE),
        (f"{UDP}, publish_period: never", Code.BAD_VALUE),
        (f"{UDP}, rates: {{/a: 1001}}", Code.BAD_VALUE),
        (f"{UDP}, topics: {{include: []}}", Code.BAD_VALUE),
        (f"{UDP}, topics: {{include: [{{glob: /a}}]}}", Code.UNKNOWN_KEY),
        ('ignore: ""', Code.BAD_VALUE),
        ("ignore: 5", Code.WRONG_TYPE),
        ("transport: {zenoh: {key: a/**}}", Code.BAD_VALUE),
    ],
)
def test_what_means_nothing_is_one_finding(tmp_path: Path, settings: str, code: Code) -> None:
    """Beside what stands in the pages of tests/bad_tables."""
    table, findings = parts(tmp_path, f"{HEAD}  it: {{{settings}}}\n")
    assert [finding.code for finding in findings] == [code], list(map(str, findings))
    assert "gateways/it" in table.broken


def test_the_valid_part_of_a_gateway_is_there_for_further_checks(tmp_path: Path) -> None:
    settings = f"{TCP}, max_message: 1B, inbound: [{{topic: /a, type: x/msg/Y, ttl: 5}}, {{topic: /b}}]"
    table, findings = parts(tmp_path, f"{HEAD}  it: {{{settings}}}\n")
    assert sorted(finding.code.value for finding in findings) == ["bad-value", "missing-key", "wrong-type"]
    inbound, _ = table.gateways["it"].inbound
    assert (inbound.topic.topic.value, inbound.ttl) == ("/a", None)


def test_a_misspelt_transport_is_read_as_the_one_that_was_meant(tmp_path: Path) -> None:
    table, [finding] = parts(tmp_path, HEAD + "  it: {transport: {websoket: 127.0.0.1:8765}}\n")
    assert finding.code is Code.UNKNOWN_KEY
    assert table.gateways["it"].transport.value is Transport.WEBSOCKET


def test_a_gateway_without_a_valid_transport_is_left_out(tmp_path: Path) -> None:
    table, _ = parts(tmp_path, f"{HEAD}  it: {{transport: {{udp: 1.2.3.4}}}}\n  other: {{{TCP}}}\n")
    assert list(table.gateways) == ["other"]


@pytest.mark.parametrize("name", ["any", "ros", "1st", "a:b"])
def test_names_are_those_of_endpoints(tmp_path: Path, name: str) -> None:
    _, findings = parts(tmp_path, f"{HEAD}  {name}: {{{UDP}}}\n")
    assert places(findings) == [(Code.BAD_VALUE, 6, 3)]


def test_a_table_that_extends_another_replaces_the_transport_and_merges_the_rest(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + f"  it: {{{UDP}, publish_period: 1s, rates: {{/a: 1 Hz}}}}\n")
    over = f"extends: base.yaml\ngateways: {{it: {{{TCP}, rates: {{/b: 2 Hz}}}}}}\n"
    found = good(tmp_path, over).gateways["it"]
    assert (found.transport.value, found.publish_period) == (Transport.TCP, 10**9)
    assert [rate.pattern.text for rate in found.rates] == ["/a", "/b"]


def test_a_table_that_extends_another_merges_the_settings_of_one_transport(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + "  it: {transport: {zenoh: {key: a, mode: router}}}\n")
    table = good(tmp_path, "extends: base.yaml\ngateways: {it: {transport: {zenoh: {key: b}}}}\n")
    assert flat(table.gateways["it"].zenoh) == {"key": "b", "mode": "router"}


def test_an_ignored_gateway_is_none(tmp_path: Path) -> None:
    table = good(tmp_path, f"{HEAD}  it: {{ignore: no page on this rover}}\n  other: {{{TCP}}}\n")
    assert list(table.gateways) == ["other"]
    [ignored] = table.ignored_gateways.values()
    assert (ignored.name, ignored.reason, ignored.span.line) == ("it", "no page on this rover", 6)


def test_a_table_that_extends_another_turns_a_gateway_off_and_on_as_a_whole(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(HEAD + f"  it: {{{UDP}, publish_period: 1s}}\n")
    (tmp_path / "off.yaml").write_text("extends: base.yaml\ngateways: {it: {ignore: nobody looks}}\n")
    table = good(tmp_path, "extends: off.yaml\n")
    assert (list(table.gateways), list(table.ignored_gateways)) == ([], ["it"])
    table = good(tmp_path, f"extends: off.yaml\ngateways: {{it: {{{TCP}}}}}\n")
    assert (list(table.gateways), list(table.ignored_gateways)) == (["it"], [])
    assert table.gateways["it"].publish_period == 500_000_000
    table = good(tmp_path, "extends: off.yaml\ngateways: {it: {ignore: for another reason}}\n")
    assert table.ignored_gateways["it"].reason == "for another reason"
