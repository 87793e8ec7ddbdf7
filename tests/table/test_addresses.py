"""Addresses of a table: read strictly, and all within its `networks`."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.errors import Code
from router.table.addresses import ADDRESSES, BadAddressError, parse_address, parse_endpoint
from router.table.schema import table_schema
from tests.table.tables import load, references

DEFINITIONS = "address", "endpoint_address", "group"
ENDPOINT = table_schema()["definitions"]["endpoint_address"]["pattern"]
PATTERN = table_schema()["definitions"]["address"]["pattern"]

octets = st.one_of(st.integers(0, 400).map(str), st.sampled_from(["01", "", "0", "255", "256", "x"]))
ports = st.one_of(st.integers(0, 70000).map(str), st.sampled_from(["", "08", "65535", "65536", "8 ", "x"]))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("192.168.0.30", "has no port"),
        ("", "has no port"),
        (":8", "has no IP address"),
        ("300.1.1.1:8", "'300' in"),
        ("192.168.0.030:8", "'030' in"),
        ("192.168.0:8", "has 3 numbers"),
        ("1.2.3.4:0", "port '0'"),
        ("1.2.3.4:65536", "port '65536'"),
        ("1.2.3.4:08", "port '08'"),
        ("1.2.3.4:8\n", "port"),
        ("1.2.3.4:", "port ''"),
        ("[::1]:8", "not an IPv4 address"),
        ("rover.local:8", "'rover.local' is not an IPv4 address"),
        ("1.2.3.٤:8", "not an IPv4 address"),
    ],
)
def test_what_is_no_address_says_why(text: str, part: str) -> None:
    with pytest.raises(BadAddressError, match=re.escape(part)):
        parse_address(text)


@given(st.builds("{}.{}.{}.{}:{}".format, octets, octets, octets, octets, ports) | st.text("0123456789.:", max_size=21))
def test_the_schema_and_the_parser_agree(text: str) -> None:
    try:
        parse_address(text)
    except BadAddressError:
        assert not re.fullmatch(PATTERN, text)
    else:
        assert re.fullmatch(PATTERN, text)


@given(
    st.builds("{}.{}.{}.{}:{}".format, octets, octets, octets, octets, ports)
    | st.text("0123456789aZ-_.:", max_size=21)
    | st.sampled_from(["robot-3.local:8", "a:8", "a.:8", "-a:8", "a..b:8", "1.2.3.4a:8", "a.3d:8", "9a.b:8"])
)
def test_so_they_do_about_host_names(text: str) -> None:
    try:
        address = parse_endpoint(text)
    except BadAddressError:
        assert not re.fullmatch(ENDPOINT, text) or not 0 < int(text.partition(".")[0]) < 224
    else:
        assert re.fullmatch(ENDPOINT, text)
        assert address.is_name == (not re.fullmatch(PATTERN, text))
        assert str(address) == text.lower()


LOCAL = """\
version: 1
envelope: {protos: ../protos, message: PBEnvelope, oneof: payload}
networks: [127.0.0.0/8]
http: {address: 127.0.0.1:9108}
foxglove: {address: 127.0.0.1:8766}
listen: {rover: {address: 127.0.0.1:5000}}
endpoints: {board: {address: 127.0.0.30:8, kind: board}}
routes: {}
gateways:
  vr: {transport: {udp: 127.0.0.3:8502}, receive: 127.0.0.1:8500}
  logger: {transport: {tcp: 127.0.0.1:8600}}
  page: {transport: {websocket: 127.0.0.1:8765}}
  far: {transport: {zenoh: {key: a, connect: ["tcp/127.0.0.1:7447?prio=1"], listen: [tcp/127.0.0.1:7448]}}}
"""


def outside(folder: Path, text: str) -> list[str]:
    _, findings = load(folder, text)
    assert {found.code for found in findings} <= {Code.OUTSIDE_NETWORKS}
    return [f"{found.message}; {found.hint}" for found in findings]


@pytest.mark.parametrize(
    ("address", "moved"),
    [
        ("127.0.0.1:9108", "10.0.0.1:9108"),
        ("127.0.0.1:8766", "10.0.0.1:8766"),
        ("127.0.0.1:5000", "0.0.0.0:5000"),
        ("127.0.0.30:8", "192.168.0.30:8"),
        ("127.0.0.3:8502", "10.0.0.3:8502"),
        ("127.0.0.1:8500", "0.0.0.0:8500"),
        ("127.0.0.1:8600", "0.0.0.0:8600"),
        ("127.0.0.1:8765", "128.0.0.1:8765"),
        ("tcp/127.0.0.1:7447", "tcp/10.0.0.1:7447"),
        ("tcp/127.0.0.1:7448", "tcp/0.0.0.0:7448"),
        ("tcp/127.0.0.1:7447", "tcp/localhost:7447"),
        ("tcp/127.0.0.1:7447", "tcp/[::1]:7447"),
        ("tcp/127.0.0.1:7447", "unixsock-stream//tmp/zenoh"),
        ("tcp/127.0.0.1:7448", "udp/224.0.0.1:7448"),
    ],
)
def test_every_address_has_to_lie_in_them(tmp_path: Path, address: str, moved: str) -> None:
    [found] = outside(tmp_path, LOCAL.replace(address, moved))
    assert moved.removeprefix("tcp/").removeprefix("udp/") in found
    assert "the networks of" in found
    assert "table.yaml:3 (127.0.0.0/8)" in found
    assert "write an address inside them, such as" in found
    assert outside(tmp_path, LOCAL.replace(address, moved).replace("networks: [127.0.0.0/8]\n", "")) == []


def test_a_group_has_to_lie_in_them(tmp_path: Path) -> None:
    text = LOCAL.replace("127.0.0.1:5000}", "127.0.0.1:5000, groups: [224.5.23.2]}")
    [found] = outside(tmp_path, text)
    assert found.startswith("'groups' of listen.rover is 224.5.23.2, outside the networks of")
    assert "add 224.5.23.2/32 to `networks`" in found
    assert outside(tmp_path, text.replace("/8]", "/8, 224.5.23.0/24]")) == []


def test_no_address_of_the_schema_is_left_out() -> None:
    found = {path for path, definition in references(table_schema()) if definition in DEFINITIONS}
    assert found == {pattern[: 3 if "groups" in pattern else None] for pattern in ADDRESSES if "zenoh" not in pattern}


def test_the_networks_of_an_extended_table_hold_until_others_replace_them(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(LOCAL)
    text = "extends: base.yaml\nendpoints: {camera: {address: 192.168.0.60:8, kind: tool}}\n"
    [found] = outside(tmp_path, text)
    assert "write an address inside them" in found
    assert outside(tmp_path, f"{text}networks: [127.0.0.0/8, 192.168.0.0/24]\n") == []
    assert len(outside(tmp_path, f"{text}networks: [192.168.0.0/24]\n")) == 10


def test_an_address_from_a_variable_counts_as_it_is_filled_in(tmp_path: Path) -> None:
    text = LOCAL.replace("127.0.0.30:8", '"${BOARD:-192.168.0.30:8}"')
    assert len(outside(tmp_path, text)) == 1
    _, findings = load(tmp_path, text, {"BOARD": "127.0.0.30:8"})
    assert findings == []


def test_no_name_is_looked_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*_: object, **__: object) -> None:
        raise AssertionError("a name was looked up")

    for name in ("getaddrinfo", "gethostbyname", "gethostbyname_ex", "gethostbyaddr", "getnameinfo"):
        monkeypatch.setattr(socket, name, asked)
    assert len(outside(tmp_path, LOCAL.replace("tcp/127.0.0.1:7447", "tcp/localhost:7447"))) == 1
    _, [found] = load(tmp_path, LOCAL.replace("127.0.0.30:8", "localhost:8"))
    assert found.code is Code.OUTSIDE_NETWORKS
