"""Which addresses host names and learned endpoints may have, by the listeners of their endpoints."""

from __future__ import annotations

import pytest

from router.compiler.compiled_table import CompiledTable
from router.compiler.resolution import resolved, stand_in, why_unusable, with_stand_ins
from router.hosts import host_number
from tests.compiler.conftest import CheckText

FOUR, SIX = "four: {address: 0.0.0.0:1000}", "six: {address: '[::]:1001'}"


def named(
    check_text: CheckText, keys: str, listen: str = f"{FOUR}, {SIX}", other: str = "127.0.0.3:8"
) -> CompiledTable:
    checked = check_text(
        "routes: {ph_info: {source: any, destinations: [robot, other]}}",
        endpoints=f"{{robot: {{address: 'robot.local:8', kind: tool{keys}}},"
        f" other: {{address: '{other}', kind: tool}}}}",
        listen=f"{{{listen}}}",
    )
    assert checked.program is not None, checked.diagnostics
    return checked.program


@pytest.mark.parametrize(
    ("keys", "listen", "fits_ipv4", "fits_ipv6"),
    [
        ("", f"{FOUR}, {SIX}", True, True),
        ("", FOUR, True, False),
        ("", SIX, False, True),
        (", listener: four", f"{FOUR}, {SIX}", True, False),
        (", listener: six", f"{FOUR}, {SIX}", False, True),
        (", send_from: six", f"{FOUR}, {SIX}", False, True),
        (", send_from: ephemeral", f"{FOUR}, {SIX}", True, True),
    ],
)
def test_a_name_has_an_address_like_its_listeners(
    check_text: CheckText, keys: str, listen: str, fits_ipv4: bool, fits_ipv6: bool
) -> None:
    program = named(check_text, keys, listen)
    assert why_unusable(program, "robot.local", "10.0.0.7") == (
        "" if fits_ipv4 else "'robot' needs an IPv6 address, like its listener's, not 10.0.0.7"
    )
    assert why_unusable(program, "robot.local", "fd00::7") == (
        "" if fits_ipv6 else "'robot' needs an IPv4 address, like its listener's, not fd00::7"
    )
    host = with_stand_ins(program).table.endpoints["robot"].address.value.host
    assert host == ("198.18.0.1" if fits_ipv4 else "2001:2::1")


@pytest.mark.parametrize(
    ("host", "why"),
    [
        ("fe80::7", "fe80::7 is link-local"),
        ("::ffff:10.0.0.7", "is the IPv4 address 10.0.0.7"),
        ("ff02::1", "ff02::1 is not the address of a single machine"),
        ("::1", "[::1]:8 is the router's own listener 'six'"),
        ("fd00::20:2104", "the router cannot distinguish fd00::20:2104 from fd00::2:88a1"),
        ("fd00::2:88a1", ""),
    ],
)
def test_some_ipv6_addresses_are_unusable(check_text: CheckText, host: str, why: str) -> None:
    assert host_number("fd00::20:2104") == host_number("fd00::2:88a1")
    program = named(check_text, "", "six: {address: '[::]:8'}", other="[fd00::2:88a1]:9")
    found = why_unusable(program, "robot.local", host)
    assert why in found
    assert bool(found) == bool(why)


def test_a_resolved_name_is_an_ipv6_endpoint(check_text: CheckText) -> None:
    program = resolved(named(check_text, ", listener: six"), {"robot.local": "fd00::7"})
    assert str(program.table.endpoints["robot"].address.value) == "[fd00::7]:8"


@pytest.mark.parametrize(
    ("networks", "default", "host"),
    [
        ("", "::1", "::1"),
        (", networks: [10.0.0.0/8, 'fd00::8/125']", "::1", "fd00::9"),
        (", networks: ['::/64', 'fd00::/8']", "::1", "::1"),
        (", networks: ['fd00::8/128']", "::1", "fd00::8"),
        (", networks: [10.0.0.0/8, '::1/128']", "127.0.0.1", "10.0.0.1"),
    ],
)
def test_a_learned_endpoint_has_a_host_in_its_networks(
    check_text: CheckText, networks: str, default: str, host: str
) -> None:
    place = "six" if ":" in default else "four"
    checked = check_text(
        "routes: {ph_info: {source: tablet, destinations: [base]}}",
        endpoints=f"{{tablet: {{address: learned, kind: tool, listener: {place}{networks}}},"
        " base: {address: 127.0.0.3:8, kind: tool}}",
        listen=f"{{{FOUR}, {SIX}}}",
    )
    assert checked.table is not None
    assert stand_in(checked.table, checked.table.endpoints["tablet"], default) == host
