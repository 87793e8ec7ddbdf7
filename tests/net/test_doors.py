"""Who may connect: networks, the router's own computer, and pages of the same host."""

from __future__ import annotations

import socket
from collections import Counter
from ipaddress import IPv4Network, IPv6Network

import pytest
from structlog.testing import capture_logs

from router.errors import SourceSpan, StartError
from router.net.addresses import bound_address
from router.net.doors import Door, is_foreign, is_own_computer, listen
from router.table.addresses import Address

SPAN = SourceSpan("routes/rover.yaml", 12, 20, 34)


@pytest.mark.parametrize(
    ("peer", "own", "is_own"),
    [
        ("127.0.0.1", "127.0.0.1", True),
        ("127.0.7.1", "127.0.0.1", True),
        ("192.168.0.5", "192.168.0.5", True),
        ("192.168.0.6", "192.168.0.5", False),
        ("::1", "::1", True),
        ("fd00::5", "fd00::5", True),
        ("fd00::6", "fd00::5", False),
    ],
)
def test_own_computer_is_told_by_both_addresses(peer: str, own: str, is_own: bool) -> None:
    assert is_own_computer(peer, own) == is_own


def test_door_admits_its_networks_and_the_own_computer_and_counts_the_others() -> None:
    refused = Counter[str]()
    door = Door("http", [IPv4Network("192.168.0.0/24"), IPv4Network("10.0.0.7/32")], refused)
    assert refused == {"http": 0}
    for peer in ("192.168.0.1", "10.0.0.7", "127.0.0.1", "203.0.113.1"):
        assert door.admits(peer, "203.0.113.1")
    with capture_logs() as logs:
        assert [door.admits(peer, "192.168.0.5") for peer in ("192.168.1.1", "10.0.0.8", "10.0.0.8")] == [False] * 3
        assert [each["client"] for each in logs] == ["192.168.1.1", "10.0.0.8"]
        door.close()
    assert refused == {"http": 3}
    assert (logs[-1]["client"], logs[-1]["more"]) == ("10.0.0.8", 1)


def test_door_knows_networks_of_both_families() -> None:
    refused = Counter[str]()
    door = Door("http", [IPv4Network("192.168.0.0/24"), IPv6Network("fd00::/64")], refused)
    for peer in ("192.168.0.1", "fd00::7", "::1"):
        assert door.admits(peer, "fd01::1")
    for peer in ("192.168.1.1", "fd01::7", "fe80::1", "::ffff:192.168.0.1"):
        assert not door.admits(peer, "fd01::1")
    assert refused == {"http": 4}


@pytest.mark.parametrize("host", ["::1", "::"])
def test_an_ipv6_server_takes_no_ipv4(host: str) -> None:
    with listen(Address(host, 0), SPAN, "HTTP", "http.address") as server:
        port = bound_address(server)[1]
        with socket.create_connection(("::1", port), timeout=10):
            pass
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), timeout=10)
        with pytest.raises(StartError, match=rf"cannot serve HTTP at \[{host}\]:{port}: .* has the port"):
            listen(Address(host, port), SPAN, "HTTP", "http.address")


def test_strangers_without_end_are_counted_and_take_a_bounded_number_of_lines() -> None:
    refused = Counter[str]()
    door = Door("http", [IPv4Network("192.168.0.0/24")], refused)
    with capture_logs() as logs:
        for number in range(5000):
            door.admits(f"10.0.{number // 250}.{number % 250}", "192.168.0.5")
        door.close()
    assert refused == {"http": 5000}
    assert len(logs) <= 1003


def test_door_without_networks_admits_everybody() -> None:
    assert Door("http", (), Counter()).admits("203.0.113.7", "192.168.0.5")


@pytest.mark.parametrize(
    ("host", "origins", "foreign"),
    [
        ("192.168.0.5:8765", [], False),
        ("192.168.0.5:8765", ["http://192.168.0.5:8765"], False),
        ("192.168.0.5", ["https://192.168.0.5"], False),
        ("[fe80::1]:8765", ["http://[fe80::1]:8765"], False),
        ("[::1]", ["http://[::1]"], False),
        ("[fd00::1]:8765", ["http://[fd00::2]:8765"], True),
        ("Rover:8765", ["http://rover:8765"], False),
        ("rover.local", ["https://rover.local"], False),
        ("192.168.0.5:8765", ["http://192.168.0.5:8080"], True),
        ("192.168.0.5:8765", ["http://192.168.0.5:8765", "http://example.org"], True),
        ("192.168.0.5:8765", ["null"], True),
        ("rover.example.org", [], True),
        ("rover.example.org", ["http://rover.example.org"], True),
        ("192.168.0.5.example.org", [], True),
        ("rover.local.example.org", [], True),
        ("", [], True),
    ],
)
def test_pages_of_other_hosts_and_names_that_anybody_can_register_are_foreign(
    host: str, origins: list[str], foreign: bool
) -> None:
    assert is_foreign([host], origins) == foreign


def test_no_host_and_two_are_foreign() -> None:
    assert is_foreign([], [])
    assert is_foreign(["rover", "rover"], [])
