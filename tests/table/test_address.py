from __future__ import annotations

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.assets import asset
from router.table.addresses import Address, BadAddressError, parse_address
from router.table.schema import SCHEMA

PATTERN = json.loads(asset(SCHEMA).read_text(encoding="utf-8"))["definitions"]["address"]["pattern"]

octets = st.one_of(st.integers(0, 400).map(str), st.sampled_from(["01", "", "0", "255", "256", "x"]))
ports = st.one_of(st.integers(0, 70000).map(str), st.sampled_from(["", "08", "65535", "65536", "8 ", "x"]))


def test_an_address_is_four_octets_and_a_port() -> None:
    assert parse_address("192.168.0.30:8") == Address("192.168.0.30", 8)


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
