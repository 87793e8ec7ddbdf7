"""Who is who on the network: addresses that clash, destinations that lead back, how senders are recognised."""

from __future__ import annotations

import pytest

from router.compiler.network import recognisers
from router.errors import Code
from tests.compiler.conftest import CheckText

FORWARD = "routes: {ph_info: {source: one, destinations: [two]}}"


def codes(check_text: CheckText, endpoints: str, routes: str = FORWARD, **parts: str) -> list[Code]:
    found = check_text(routes, endpoints=f"{{{endpoints}}}", **parts).diagnostics
    return [finding.code for finding in found if finding.code in (Code.ADDRESS_CLASH, Code.FORWARDING_LOOP)]


@pytest.mark.parametrize(
    ("host", "first_port", "second_port", "has_clash"),
    [
        ("127.0.0.3", None, None, False),
        ("127.0.0.2", None, None, True),
        ("127.0.0.2", None, 9, True),
        ("127.0.0.2", 8, 9, False),
        ("127.0.0.2", 8, 8, True),
    ],
)
def test_endpoints_that_send_are_told_apart(
    check_text: CheckText, host: str, first_port: int | None, second_port: int | None, has_clash: bool
) -> None:
    first, second = (f", source_port: {port}" if port else "" for port in (first_port, second_port))
    endpoints = f"one: {{address: 127.0.0.2:8, kind: board{first}}}, two: {{address: '{host}:9', kind: tool{second}}}"
    assert codes(check_text, endpoints) == [Code.ADDRESS_CLASH] * has_clash


def test_endpoints_that_never_send_may_share_an_address(check_text: CheckText) -> None:
    endpoints = "one: {address: 127.0.0.2:8, kind: tool}, two: {address: 127.0.0.2:9, kind: tool}"
    assert codes(check_text, endpoints, "routes: {ph_info: {source: any, destinations: [one, two]}}") == []


@pytest.mark.parametrize(
    ("listen", "has_clash"),
    [
        ("{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.1:1001}}", False),
        ("{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.4:1000}}", False),
        ("{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.1:1000}}", True),
        ("{a: {address: 0.0.0.0:1000}, b: {address: 127.0.0.1:1000}}", True),
        ("{a: {address: 0.0.0.0:1000, interface: x}, b: {address: 0.0.0.0:1000, interface: y}}", False),
        ("{a: {address: 0.0.0.0:1000, interface: x}, b: {address: 127.0.0.1:1000, interface: x}}", True),
        ("{a: {address: 0.0.0.0:1000, interface: x}, b: {address: 0.0.0.0:1000}}", True),
        ("{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.1:1000, interface: x}}", True),
    ],
)
def test_listeners_do_not_share_a_socket(check_text: CheckText, listen: str, has_clash: bool) -> None:
    endpoints = "one: {address: 127.0.0.2:8, kind: board}, two: {address: 127.0.0.3:8, kind: tool}"
    assert codes(check_text, endpoints, listen=listen) == [Code.ADDRESS_CLASH] * has_clash


@pytest.mark.parametrize(
    ("listen", "address", "has_loop"),
    [
        ("127.0.0.1:1000", "127.0.0.1:1000", True),
        ("127.0.0.1:1000", "127.0.0.1:1001", False),
        ("127.0.0.1:1000", "127.0.0.3:1000", False),
        ("0.0.0.0:1000", "127.0.0.3:1000", True),
        ("0.0.0.0:1000", "192.168.0.3:1000", False),
    ],
)
def test_destination_is_no_listener_of_the_router(
    check_text: CheckText, listen: str, address: str, has_loop: bool
) -> None:
    endpoints = f"one: {{address: 127.0.0.2:8, kind: board}}, two: {{address: '{address}', kind: tool}}"
    found = codes(check_text, endpoints, listen=f"{{here: {{address: '{listen}'}}}}")
    assert found == [Code.FORWARDING_LOOP] * has_loop


def test_nobody_gets_back_what_he_sent(check_text: CheckText) -> None:
    endpoints = "one: {address: 127.0.0.2:8, kind: board}, two: {address: 127.0.0.3:8, kind: tool}"
    assert codes(check_text, endpoints, "routes: {ph_info: {source: [one, two], destinations: [two]}}") == [
        Code.FORWARDING_LOOP
    ]


def test_senders_are_recognised_by_host_or_by_host_and_port(check_text: CheckText) -> None:
    checked = check_text(
        "routes: {ph_info: {source: any, destinations: [alone]}}",
        endpoints="{alone: {address: 127.0.0.2:8, kind: board},"
        " first: {address: 127.0.0.3:8, kind: tool, source_port: 81},"
        " second: {address: 127.0.0.3:9, kind: tool, source_port: 82},"
        " twin_a: {address: 127.0.0.4:8, kind: tool}, twin_b: {address: 127.0.0.4:9, kind: tool}}",
    )
    assert checked.table is not None
    by_host, by_address = recognisers(checked.table.endpoints, None)
    assert by_host == {"127.0.0.2": "alone"}
    assert by_address == {("127.0.0.3", 81): "first", ("127.0.0.3", 82): "second"}


@pytest.mark.parametrize(
    ("first", "second", "has_clash"),
    [("a", "b", False), ("a", "a", True), ("a", None, True), (None, "b", True)],
)
def test_endpoints_with_one_address_are_told_apart_by_their_listeners(
    check_text: CheckText, first: str | None, second: str | None, has_clash: bool
) -> None:
    listeners = (f", listener: {name}" if name else "" for name in (first, second))
    one, two = (f"{{address: 127.0.0.2:8, kind: tool{listener}}}" for listener in listeners)
    routes = "routes: {ph_info: {source: one, destinations: [three]}}"
    three = "three: {address: 127.0.0.3:8, kind: tool}"
    listen = "{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.1:1001}}"
    found = codes(check_text, f"one: {one}, two: {two}, {three}", routes, listen=listen)
    assert found == [Code.ADDRESS_CLASH] * has_clash


def test_senders_are_recognised_by_their_listener(check_text: CheckText) -> None:
    checked = check_text(
        "routes: {ph_info: {source: [lan, radio], destinations: [tool]}}",
        endpoints="{lan: {address: 127.0.0.2:8, kind: board, listener: a},"
        " radio: {address: 127.0.0.2:8, kind: board, source_port: 81, listener: b},"
        " tool: {address: 127.0.0.3:8, kind: tool}}",
        listen="{a: {address: 127.0.0.1:1000}, b: {address: 127.0.0.1:1001}}",
    )
    assert checked.table is not None
    endpoints = checked.table.endpoints
    assert recognisers(endpoints, "a") == ({"127.0.0.2": "lan", "127.0.0.3": "tool"}, {})
    assert recognisers(endpoints, "b") == ({"127.0.0.3": "tool"}, {("127.0.0.2", 81): "radio"})


@pytest.mark.parametrize(
    ("station", "source", "unused"),
    [
        ("", "board", []),
        (", listener: radio", "[board, station]", []),
        ("", "[board, station]", []),
        (", listener: lan", "[board, station]", ["radio"]),
        (", listener: lan", "any", []),
    ],
)
def test_a_listener_that_rejects_everything_is_told(
    check_text: CheckText, station: str, source: str, unused: list[str]
) -> None:
    board = ", listener: lan" if station else ""
    found = check_text(
        f"routes: {{ph_info: {{source: {source}, destinations: [tool]}}}}",
        endpoints=f"{{board: {{address: 127.0.0.2:8, kind: board{board}}},"
        f" station: {{address: 127.0.0.4:8, kind: basestation{station}}}, tool: {{address: 127.0.0.3:8, kind: tool}}}}",
        listen="{lan: {address: 127.0.0.1:1000}, radio: {address: 127.0.0.1:1001}}",
    ).diagnostics
    told = [finding.message for finding in found if finding.code is Code.UNUSED_LISTENER]
    assert [f"listener '{name}'" in message for name, message in zip(unused, told, strict=True)] == [True] * len(unused)
