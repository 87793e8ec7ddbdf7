"""IP addresses have the same numbers in Python and in native code, and no sender can pass for another one."""

from __future__ import annotations

import ctypes
import socket
from functools import cache
from ipaddress import IPv6Address
from itertools import count
from pathlib import Path
from shutil import copy

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from router.hosts import FIRST_IPV6, LAST_IPV6, host_number, packed
from router.library import library, load
from router.net.addresses import host_text, know
from tests.carrier.building import RACES, run_program

UNKNOWN = FIRST_IPV6 - 1


def sender_number(library: ctypes.CDLL, host: str, interface: int = 0) -> int:
    """The number that native code has for the sender of a datagram: a struct sockaddr_in6."""
    address = socket.AF_INET6.to_bytes(2, "little") + bytes(2 + 4) + packed(host) + interface.to_bytes(4, "little")
    return int(library.host_number_ipv6(address))


@given(st.ip_addresses(v=6).map(str).map(IPv6Address))
def test_addresses_have_their_numbers_and_numbers_their_addresses(address: IPv6Address) -> None:
    assume(address.ipv4_mapped is None)
    number = know(library(), str(address))
    assert number == host_number(str(address)) == sender_number(library(), str(address))
    assert FIRST_IPV6 <= number <= LAST_IPV6
    assert IPv6Address(host_text(number)) == address


@given(st.ip_addresses(v=4))
def test_ipv4_addresses_are_their_numbers_also_when_an_ipv6_socket_receives_them(
    address: object,
) -> None:
    number = know(library(), str(address))
    assert number == sender_number(library(), f"::ffff:{address}")
    if not UNKNOWN <= number <= LAST_IPV6:  # reserved: no host has it
        assert host_text(number) == str(address)


@pytest.fixture
def own_library(built: Path, tmp_path: Path) -> ctypes.CDLL:
    """A library that knows no address."""
    return load(copy(built, tmp_path))


@cache
def alike() -> tuple[str, str]:
    """Two addresses with one number."""
    known: dict[int, str] = {}
    for each in count():
        host = str(IPv6Address(0x20010DB8 << 96 | each * 0x9E3779B97F4A7C15 % 2**64))  # spread, to be found soon
        if (other := known.setdefault(host_number(host), host)) != host:
            return other, host
    raise AssertionError


def test_a_sender_whose_number_is_that_of_a_known_address_is_a_stranger(own_library: ctypes.CDLL) -> None:
    board, attacker = alike()
    assert sender_number(own_library, attacker) == host_number(board), "it comes first"
    assert own_library.host_add(packed(board), 0)
    assert sender_number(own_library, board) == host_number(board)
    assert sender_number(own_library, attacker) == UNKNOWN
    assert not own_library.host_add(packed(attacker), 0)


def test_a_link_local_address_is_known_at_its_interface_only(own_library: ctypes.CDLL) -> None:
    assert own_library.host_add(packed("fe80::7%eth0"), 3)
    assert sender_number(own_library, "fe80::7", interface=3) == host_number("fe80::7%eth0")
    assert sender_number(own_library, "fe80::7", interface=4) == UNKNOWN
    assert own_library.host_add(packed("fe80::7%eth0"), 4), "the interface has come back"
    assert sender_number(own_library, "fe80::7", interface=4) == host_number("fe80::7%eth0")
    assert sender_number(own_library, "fe80::7", interface=3) == UNKNOWN


def test_a_flood_of_senders_takes_no_number_from_a_table_or_a_later_sender(own_library: ctypes.CDLL) -> None:
    learned, later = "2001:db8::7", "2001:db8::8"
    assert sender_number(own_library, learned) == host_number(learned)
    assert own_library.host_keep(host_number(learned))
    senders = [f"2001:db8:1::{each:x}" for each in range(10_000)]
    numbers = [sender_number(own_library, host) for host in senders]
    assert len({*numbers} - {UNKNOWN}) > 9_900
    assert sender_number(own_library, later) == host_number(later)
    assert (text(own_library, host_number(learned)), text(own_library, host_number(senders[0]))) == (learned, "::")
    assert not own_library.host_keep(numbers[0]), "it is forgotten"
    assert own_library.host_add(packed("fd00::1"), 0)
    assert sender_number(own_library, "fd00::1") == host_number("fd00::1")
    assert text(own_library, UNKNOWN) == "::"


def test_a_sender_whose_number_is_that_of_a_kept_address_is_a_stranger(own_library: ctypes.CDLL) -> None:
    learned, attacker = alike()
    assert own_library.host_keep(sender_number(own_library, learned))
    assert sender_number(own_library, attacker) == UNKNOWN
    assert sender_number(own_library, learned) == host_number(learned)


def test_a_link_local_sender_may_come_back_at_another_interface(own_library: ctypes.CDLL) -> None:
    """It is another one: hosts behind two interfaces may have the same address."""
    numbers = [sender_number(own_library, "fe80::7", interface) for interface in (3, 4)]
    assert len({*numbers, UNKNOWN}) == 3
    assert own_library.host_keep(numbers[1])
    assert [sender_number(own_library, "fe80::7", interface) for interface in (3, 4)] == numbers
    assert own_library.host_add(packed("fe80::7%eth0"), 3)
    numbers = [sender_number(own_library, "fe80::7", interface) for interface in (3, 4)]
    assert numbers == [host_number("fe80::7%eth0"), UNKNOWN]


def text(library: ctypes.CDLL, number: int) -> str:
    buffer = ctypes.create_string_buffer(64)
    library.host_text(number, buffer)
    return buffer.value.decode()


@pytest.mark.parametrize("sanitizers", ["", pytest.param(RACES, marks=pytest.mark.slow)])
def test_threads_add_number_and_look_up_at_once(tmp_path: Path, sanitizers: str) -> None:
    run_program("hosts", tmp_path, 100_000, sanitizers=sanitizers)
