"""Who is who on the network: addresses that clash, destinations that lead back, how senders are recognised."""

from __future__ import annotations

import pytest

from router.compiler.network import destination, networks_of, reaches, recognisers, sent_from
from router.errors import Code
from router.hosts import bracketed, host_number
from router.net.sockets import open_udp
from router.table.addresses import Address
from tests.compiler.conftest import CheckText
from tests.ports import free_port
from tests.readable import readable

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
        ("{a: {address: 0.0.0.0:1000}, b: {address: '[::]:1000'}}", False),
        ("{a: {address: 0.0.0.0:1000}, b: {address: '[::1]:1000'}}", False),
        ("{a: {address: '[::]:1000'}, b: {address: '[::1]:1000'}}", True),
        ("{a: {address: '[::]:1000'}, b: {address: '[0::0]:1000'}}", True),
        ("{a: {address: '[fe80::1%x]:1000'}, b: {address: '[fe80::1%y]:1000'}}", False),
        ("{a: {address: '[::]:1000', interface: x}, b: {address: '[::]:1000', interface: y}}", False),
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
        ("[::1]:1000", "[0::1]:1000", True),
        ("[::]:1000", "[::1]:1000", True),
        ("[::]:1000", "127.0.0.3:1000", False),
        ("0.0.0.0:1000", "[::1]:1000", False),
        ("[::]:1000", "[fd00::1]:1000", False),
        ("[fd00::1]:1000", "[fd00::1]:1001", False),
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
    by_host, by_address = recognisers(checked.table, None)
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
    assert recognisers(checked.table, "a") == ({"127.0.0.2": "lan", "127.0.0.3": "tool"}, {})
    assert recognisers(checked.table, "b") == ({"127.0.0.3": "tool"}, {("127.0.0.2", 81): "radio"})


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


BOTH = "{four: {address: 0.0.0.0:1000}, six: {address: '[::]:1001'}}"
"""A listener of each family."""


def messages(check_text: CheckText, endpoints: str, listen: str = BOTH) -> list[str]:
    routes = "routes: {ph_info: {source: one, destinations: [two]}}"
    two = "two: {address: 127.0.0.3:8, kind: tool}"
    found = check_text(routes, endpoints=f"{{{endpoints}, {two}}}", listen=listen)
    return [each.message for each in found.diagnostics if each.code is not Code.UNCOVERED_PAYLOAD_CASE]


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("address: '[fd00::2]:8', listener: six", ""),
        ("address: '[fd00::2]:8'", ""),
        ("address: '[fd00::2]:8', listener: four", "'one' has an IPv6 address, but its 'listener' an IPv4 one"),
        ("address: '[fd00::2]:8', send_from: four", "'one' has an IPv6 address, but its 'send_from' an IPv4 one"),
        ("address: '[fd00::2]:8', send_from: ephemeral", ""),
        ("address: 127.0.0.2:8, listener: six", "'one' has an IPv4 address, but its 'listener' an IPv6 one"),
        ("address: 'robot.local:8', listener: six", ""),
        (
            "address: 'robot.local:8', listener: six, send_from: four",
            "'one' has an IPv6 address, but its 'send_from' an IPv4 one",
        ),
        ("address: learned, listener: six", ""),
        ("address: learned", ""),
        ("address: learned, listener: six, send_from: ephemeral", ""),
        ("address: learned, listener: six, send_from: four", "an IPv6 address, but its 'send_from' an IPv4 one"),
        ("address: learned, listener: four, send_from: ephemeral", ""),
        ("address: learned, listener: six, networks: [10.0.0.0/8]", "the address of 'one' is never learned"),
        ("address: learned, listener: six, networks: ['fd00::/8', 10.0.0.0/8]", ""),
    ],
)
def test_an_endpoint_and_its_listeners_have_one_kind_of_address(check_text: CheckText, endpoint: str, why: str) -> None:
    found = messages(check_text, f"one: {{{endpoint}, kind: tool}}")
    told = [each for each in found if "listener '" not in each]  # one of the two listeners may receive nothing
    assert [why in each for each in told] == [True] * bool(why)


@pytest.mark.parametrize(
    ("listen", "endpoint", "why"),
    [
        (
            "{a: {address: 0.0.0.0:1}}",
            "address: '[fd00::2]:8'",
            "nothing from 'one' is received: no listener is at an IPv6",
        ),
        (
            "{a: {address: '[::]:1'}}",
            "address: 127.0.0.2:8",
            "nothing from 'one' is received: no listener is at an IPv4",
        ),
        ("{a: {address: '[::]:1'}}", "address: '[fd00::2]:8'", ""),
        ("{a: {address: '[::]:1'}}", "address: 'robot.local:8'", ""),
        ("{a: {address: '[::]:1'}}", "address: learned", ""),
        ("{a: {address: '[::]:1'}, b: {address: '[::]:2'}}", "address: learned", ""),
        ("{a: {accept: '[::]:1', framing: varint}}", "address: 'fd00::2', listener: a", ""),
        (
            "{a: {accept: '[::]:1', framing: varint}}",
            "address: 127.0.0.2, listener: a",
            "'one' has an IPv4 address, but its 'listener' an IPv6 one",
        ),
        (
            "{a: {address: '0.0.0.0:1', groups: [ff02::4:1]}}",
            "address: 127.0.0.2:8",
            "listener 'a' at 0.0.0.0:1 receives IPv4 only",
        ),
        ("{a: {address: '[::]:1', groups: [ff02::4:1]}}", "address: '[fd00::2]:8'", ""),
        ("{a: {address: '[::1]:1', groups: [ff02::4:1]}}", "address: '[fd00::2]:8'", "delivers nothing to a group"),
    ],
)
def test_a_source_is_heard_by_a_listener_of_its_kind(
    check_text: CheckText, listen: str, endpoint: str, why: str
) -> None:
    found = [each for each in messages(check_text, f"one: {{{endpoint}, kind: tool}}", listen) if "rejects" not in each]
    assert [why in each for each in found] == [True] * bool(why)


def test_endpoints_with_one_name_have_one_kind_of_address(check_text: CheckText) -> None:
    keys = "address: 'robot.local:8', kind: tool, source_port"
    one, other = f"one: {{{keys}: 81, listener: four}}", f"other: {{{keys}: 82, listener: six}}"
    found = messages(check_text, f"{one}, {other}")
    assert "'one' and 'other' need the IPv4 and the IPv6 address of robot.local" in found
    assert messages(check_text, f"{one}, {other.replace('six', 'four')}", "{four: {address: 0.0.0.0:1000}}") == []


def test_a_listener_of_another_kind_than_all_sources_rejects_everything(check_text: CheckText) -> None:
    [found] = messages(check_text, "one: {address: '[fd00::2]:8', kind: tool}")
    assert found == "listener 'four' accepts none of the sending endpoints, so it rejects everything"


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("send_from: six", []),
        ("listener: six", []),
        ("send_from: ephemeral", []),
        ("send_from: four", ["'all' has an IPv6 address, but its 'send_from' an IPv4 one"]),
    ],
)
def test_an_ipv6_group_is_sent_to_from_a_listener_of_its_kind(
    check_text: CheckText, source: str, why: list[str]
) -> None:
    endpoints = "one: {address: '[fd00::2]:8', kind: tool}, all: {group: '[ff02::4:1]:9', kind: tool, %s}"
    found = messages(check_text, endpoints % source)
    assert [each for each in found if "listener 'four'" not in each] == why


@pytest.mark.parametrize(
    ("first", "second", "has_clash"),
    [
        ("[fd00::2:88a1]:8", "[fd00::20:2104]:8", True),
        ("[fe80::1%x]:8", "[fe80::1%y]:8", True),
        ("[fd00::2:88a1]:8", "[fd00:0::2:88a1]:9", False),
        ("[fd00::2:88a1]:8", "[fd00::20:2105]:8", False),
    ],
)
def test_no_two_addresses_have_one_number(check_text: CheckText, first: str, second: str, has_clash: bool) -> None:
    assert host_number("fd00::2:88a1") == host_number("fd00::20:2104")
    endpoints = f"one: {{address: '{first}', kind: tool}}, two: {{address: '{second}', kind: tool}}"
    routes = "routes: {ph_info: {source: any, destinations: [one, two]}}"
    assert codes(check_text, endpoints, routes) == [Code.ADDRESS_CLASH] * has_clash


@pytest.mark.parametrize(
    ("listen", "one", "two", "all_"),
    [
        (BOTH, "four", "six", "six"),
        (
            "{four: {address: 0.0.0.0:1000}, six: {address: '[::]:1001'}, other: {address: '[::1]:1002'}}",
            "four",
            None,
            None,
        ),
        ("{six: {address: '[::]:1001'}}", None, "six", "six"),
        ("{four: {address: 0.0.0.0:1000}}", "four", None, None),
        ("{a: {address: '[::]:1', interface: x}, b: {address: '[::]:1', interface: y}}", None, "a", "a"),
    ],
)
def test_datagrams_leave_from_the_only_listener_of_their_kind(
    check_text: CheckText, listen: str, one: str | None, two: str | None, all_: str | None
) -> None:
    checked = check_text(
        "routes: {ph_info: {source: any, destinations: [one, two, all]}}",
        endpoints="{one: {address: 127.0.0.2:8, kind: tool}, two: {address: '[fd00::2]:8', kind: tool},"
        " all: {group: '[ff02::4:1]:9', kind: tool}}",
        listen=listen,
    )
    assert checked.table is not None
    endpoints = checked.table.endpoints
    assert [sent_from(checked.table, endpoints[name]) for name in ("one", "two", "all")] == [one, two, all_]


def test_a_listener_recognises_its_kind_of_address_only(check_text: CheckText) -> None:
    checked = check_text(
        "routes: {ph_info: {source: any, destinations: [one, two]}}",
        endpoints="{one: {address: 127.0.0.2:8, kind: tool}, two: {address: '[fd00::2]:8', kind: tool},"
        " three: {address: '[fe80::2%x]:8', kind: tool, source_port: 81}}",
        listen=BOTH,
    )
    assert checked.table is not None
    assert recognisers(checked.table, "four") == ({"127.0.0.2": "one"}, {})
    assert recognisers(checked.table, "six") == ({"fd00::2": "two"}, {("fe80::2%x", 81): "three"})


def test_an_address_is_learned_in_the_networks_of_its_kind(check_text: CheckText) -> None:
    checked = check_text(
        "routes: {ph_info: {source: one, destinations: [two]}}",
        endpoints="{one: {address: learned, kind: tool, listener: six, networks: [10.0.0.0/8, 'fd00::/8']},"
        " two: {address: 127.0.0.3:8, kind: tool}}",
        listen=BOTH,
    )
    assert checked.table is not None
    one, six = checked.table.endpoints["one"], checked.table.listeners["six"]
    assert [*map(str, networks_of(checked.table, one, six))] == ["fd00::/8"]


@pytest.mark.parametrize(
    ("first", "second", "has_clash"),
    [
        ("[fd00::/8]", "[10.0.0.0/8]", False),
        ("[fd00::/8]", "['fd00:1::/32']", True),
        ("[fd00::/8]", "['::1/128']", False),
    ],
)
def test_learned_endpoints_do_not_share_a_network(
    check_text: CheckText, first: str, second: str, has_clash: bool
) -> None:
    one, two = (f"{{address: learned, kind: tool, networks: {networks}}}" for networks in (first, second))
    listen = "{here: {address: '[::]:1000'}}"
    found = codes(
        check_text,
        f"one: {one}, two: {two}, three: {{address: 127.0.0.3:8, kind: tool}}",
        "routes: {ph_info: {source: [one, two], destinations: [three]}}",
        listen=listen,
    )
    assert found == [Code.ADDRESS_CLASH] * has_clash


def test_a_group_that_a_listener_has_joined_does_not_return(check_text: CheckText) -> None:
    checked = check_text(
        "routes: {ph_info: {source: any, destinations: [all]}}",
        endpoints="{all: {group: '[ff02:0::4:1]:1001', kind: tool}}",
        listen="{six: {address: '[::]:1001', groups: ['FF02::4:1']}}",
    )
    assert checked.table is not None
    assert destination(checked.table, checked.table.endpoints["all"]) == (("ff02::4:1", 1001), False, (None, 1, False))


HOSTS = "127.0.0.1", "127.0.0.2", "0.0.0.0", "::1", "::"


@pytest.mark.parametrize("own", HOSTS)
@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "127.0.0.3", "::1"])
def test_the_kernel_delivers_where_an_address_reaches(own: str, host: str) -> None:
    port = free_port()
    with open_udp(own) as receiver, open_udp(host) as sender:
        receiver.bind((own, port))
        sender.sendto(b"", (host, port))
        arrived = readable(receiver.fileno())  # loopback: at once
        assert bool(arrived) == reaches(Address(host, port), Address(own, port))


@pytest.mark.parametrize("one", HOSTS)
@pytest.mark.parametrize("other", HOSTS)
def test_the_kernel_binds_what_does_not_clash(check_text: CheckText, one: str, other: str) -> None:
    port = free_port()
    with open_udp(one) as first, open_udp(other) as second:
        first.bind((one, port))
        try:
            second.bind((other, port))
        except OSError:
            is_bound = False
        else:
            is_bound = True
    places = f"{{a: {{address: '{bracketed(one)}:{port}'}}, b: {{address: '{bracketed(other)}:{port}'}}}}"
    found = codes(
        check_text,
        "one: {address: 127.0.0.9:8, kind: tool}, two: {address: 127.0.0.8:8, kind: tool}",
        "routes: {ph_info: {source: any, destinations: [one, two]}}",
        listen=places,
    )
    assert (found == []) == is_bound
