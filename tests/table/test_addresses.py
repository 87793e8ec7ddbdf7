"""Addresses of a table: read strictly, and all within its `networks`."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from router.errors import Code
from router.table.addresses import (
    ADDRESSES,
    Address,
    BadAddressError,
    SerialPlace,
    TcpPlace,
    parse_address,
    parse_broadcast,
    parse_endpoint,
    parse_group,
    parse_joined,
    parse_local,
    parse_remote,
)
from router.table.schema import table_schema
from tests.table.tables import load, references

DEFINITIONS = "address", "endpoint_address", "group"
ENDPOINT = table_schema()["definitions"]["endpoint_address"]["pattern"]
PATTERN = table_schema()["definitions"]["address"]["pattern"]
JOINED = table_schema()["definitions"]["group"]["pattern"]

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
        ("fd00::1:8", "nor an IPv6 address in brackets"),
        ("::1", "nor an IPv6 address in brackets"),
        ("[fd00::1]", "has no port"),
        ("[fd00::1]8", "has no port"),
        ("[fd00::1", "has no port"),
        ("[]:8", "'' is not an IPv6 address"),
        ("[fd00:1]:8", "'fd00:1' is not an IPv6 address"),
        ("[::ffff:10.0.0.1]:8", "is the IPv4 address 10.0.0.1"),
        ("[fe80::1]:8", "fe80::1 is link-local"),
        ("[fe80::1%]:8", "'fe80::1%' is not an IPv6 address"),
        ("[fe80::1%a b]:8", "'a b' in fe80::1%a b is not the name of a network interface"),
        ("[fd00::1%eth0]:8", "not link-local"),
        ("[fd00::1]:0", "port '0'"),
        ("rover.local:8", "'rover.local' is not an IP address"),
        ("1.2.3.٤:8", "not an IP address"),
    ],
)
def test_what_is_no_address_says_why(text: str, part: str) -> None:
    with pytest.raises(BadAddressError, match=re.escape(part)):
        parse_address(text)


@pytest.mark.parametrize(
    ("parse", "text", "host"),
    [
        (parse_address, "[FD00:0:0::0030]:8", "fd00::30"),
        (parse_address, "[::ffff:0:1.2.3.4]:8", "::ffff:0:102:304"),
        (parse_address, "[fe80::0:1%wlan0.5]:8", "fe80::1%wlan0.5"),
        (parse_local, "[::]:8", "::"),
        (parse_local, "[::1]:8", "::1"),
        (parse_remote, "[fe80::1%eth0]:8", "fe80::1%eth0"),
        (parse_endpoint, "[fd00::30]:8", "fd00::30"),
        (parse_endpoint, "fd00::0030", "fd00::30"),
        (parse_endpoint, "fe80::30%eth0", "fe80::30%eth0"),
        (parse_group, "[FF02::4:0001]:8", "ff02::4:1"),
    ],
)
def test_each_ipv6_address_has_one_form(parse: Callable[[str], Address], text: str, host: str) -> None:
    address = parse(text)
    assert address.host == host
    assert address.is_ipv6
    assert address.is_known
    assert parse(str(address).removeprefix("tcp ")) == address


@pytest.mark.parametrize(
    ("parse", "text", "part"),
    [
        (parse_remote, "[::]:8", ":: is not the address of a single machine"),
        (parse_remote, "[ff02::1]:8", "ff02::1 is not the address of a single machine"),
        (parse_local, "[ff02::1]:8", "ff02::1 cannot be an address of this machine"),
        (parse_group, "[fd00::1]:8", "fd00::1 is not a multicast group"),
        (parse_joined, "ff02::1::2", "'ff02::1::2' is not an IPv6 address"),
        (parse_joined, "ff02::1%eth0", "not link-local"),
        (parse_broadcast, "[ff02::1]:8", "IPv6 has none"),
        (parse_endpoint, "fe80::1", "fe80::1 is link-local"),
        (parse_endpoint, "ff02::1", "ff02::1 is not the address of a single machine"),
    ],
)
def test_an_ipv6_address_has_to_fit_its_key(parse: Callable[[str], object], text: str, part: str) -> None:
    with pytest.raises(BadAddressError, match=re.escape(part)):
        parse(text)


def test_a_device_is_no_ipv6_address() -> None:
    place = SerialPlace("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", 0)
    assert not place.is_ipv6
    assert not place.is_known


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
    | st.text("0123456789aZ-_.:", max_size=21).filter(lambda text: text.count(":") <= 1)
    | st.sampled_from(["robot-3.local:8", "1.2.3.4", "a:8", "a.:8", "-a:8", "a..b:8", "1.2.3.4a:8", "a.3d:8", "9a.b:8"])
)
def test_so_they_do_about_host_names(text: str) -> None:
    try:
        address = parse_endpoint(text)
    except BadAddressError:
        assert not re.fullmatch(ENDPOINT, text) or not 0 < int(text.partition(".")[0]) < 224
    else:
        assert re.fullmatch(ENDPOINT, text)
        is_client = isinstance(address, TcpPlace)
        assert address.is_name == (not is_client and not re.fullmatch(PATTERN, text))
        assert str(address) == ("tcp " * is_client) + text.lower()


@given(
    st.ip_addresses(v=6).map(str)
    | st.ip_addresses(v=6).map(lambda address: address.exploded)
    | st.ip_addresses(v=6, network="fe80::/10").map("{}%eth0".format)
    | st.from_regex(r"[fF0-9:]{0,20}((25[0-5]|[0-9])\.){0,3}[0-9]{0,2}(%[a-z]{1,3})?", fullmatch=True)
)
@example("::")
@example("1:2:3:4:5:6:7::")
@example("::2:3:4:5:6:7:8")
@example("64:ff9b::1.2.3.4")
def test_the_schema_accepts_each_ipv6_address_of_the_parser(text: str) -> None:
    for parse, written, pattern in (
        (parse_address, f"[{text}]:8", PATTERN),
        (parse_endpoint, f"[{text}]:8", ENDPOINT),
        (parse_endpoint, text, ENDPOINT),
        (parse_joined, text, JOINED),
    ):
        if is_accepted(parse, written):
            assert re.fullmatch(pattern, written)


def is_accepted(parse: Callable[[str], object], text: str) -> bool:
    try:
        parse(text)
    except ValueError:
        return False
    return True


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
        ("127.0.0.1:5000", '"[::]:5000"'),
        ("127.0.0.30:8", '"[fd00::30]:8"'),
        ("127.0.0.1:9108", '"[::1]:9108"'),
        ("127.0.0.3:8502", '"[fe80::1%eth0]:8502"'),
    ],
)
def test_every_address_has_to_lie_in_them(tmp_path: Path, address: str, moved: str) -> None:
    [found] = outside(tmp_path, LOCAL.replace(address, moved))
    assert moved.strip('"').removeprefix("tcp/").removeprefix("udp/") in found
    assert "the networks of" in found
    assert "table.yaml:3 (127.0.0.0/8)" in found
    assert "write an address inside them, such as" in found
    assert outside(tmp_path, LOCAL.replace(address, moved).replace("networks: [127.0.0.0/8]\n", "")) == []


@pytest.mark.parametrize(
    ("address", "moved", "example"),
    [
        ("127.0.0.1:5000", "[::]:5000", '"[fd00::1]:5000"'),
        ("127.0.0.1:5000", "[fe80::5:7%eth0]:5000", '"[fd00::5:7]:5000"'),
        ("127.0.0.30:8", "10.0.0.30:8", "127.0.0.30:8"),
        ("tcp/127.0.0.1:7447", "tcp/[2001:db8::3]:7447", '"tcp/[fd00::3]:7447?prio=1"'),
    ],
)
def test_an_address_of_the_same_kind_is_proposed(tmp_path: Path, address: str, moved: str, example: str) -> None:
    text = LOCAL.replace("[127.0.0.0/8]", "[127.0.0.0/8, fd00::/64]").replace(address, moved)
    text = text.replace(f"address: {moved}", f"address: '{moved}'")
    [found] = outside(tmp_path, text)
    assert found.endswith(f"such as {example}")
    inside = example.strip('"').partition("?")[0]
    assert outside(tmp_path, text.replace(moved, inside)) == []


@pytest.mark.parametrize(
    ("network", "place", "fits"),
    [
        ("0.0.0.0/0", "0.0.0.0:5000", True),
        ("0.0.0.0/8", "0.0.0.0:5000", False),
        ("0.0.0.0/0", "[::]:5000", False),
        ("::/0", "[::]:5000", True),
        ("::/64", "[::]:5000", False),
        ("::/0", "0.0.0.0:5000", False),
    ],
)
def test_all_addresses_are_in_a_network_of_all_addresses_only(
    tmp_path: Path, network: str, place: str, fits: bool
) -> None:
    text = LOCAL.replace("[127.0.0.0/8]", f"[127.0.0.0/8, '{network}']").replace("127.0.0.1:5000", f"'{place}'")
    assert (outside(tmp_path, text) == []) == fits


def test_a_proposed_link_local_address_names_an_interface(tmp_path: Path) -> None:
    text = LOCAL.replace("[127.0.0.0/8]", "[127.0.0.0/8, fe80::/64]").replace("127.0.0.30:8", '"[fd00::30]:8"')
    [found] = outside(tmp_path, text)
    assert found.endswith('such as "[fe80::30%eth0]:8"')


def test_an_ipv6_client_and_group_have_to_lie_in_them(tmp_path: Path) -> None:
    text = LOCAL.replace("127.0.0.1:5000}", '"[::1]:5000", groups: ["ff02::4:1"]}').replace("127.0.0.30:8", "fd00::30")
    text = text.replace("[127.0.0.0/8]", '[127.0.0.0/8, "::1/128"]').replace(
        "listen: {", "listen: {boards: {accept: '127.0.0.1:4', framing: varint}, "
    )
    group, client = outside(tmp_path, text.replace("kind: board", "kind: board, listener: boards"))
    assert "add ff02::4:1/128 to `networks`" in group
    assert client.startswith("'address' of endpoints.board is fd00::30, outside")
    assert client.endswith("such as ::1")


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
