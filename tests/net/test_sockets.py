"""Sockets of a service manager are taken by what they are bound to; senders have the port of a listener."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from router.net import sockets
from router.net.addresses import bound_address, family
from router.net.sockets import Inherited, ListeningSocket, leaves_from, open_sending
from tests.namespaces import cable, computers


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def bound(stack: ExitStack, kind: socket.SocketKind = socket.SOCK_DGRAM, interface: bytes = b"") -> socket.socket:
    made = stack.enter_context(socket.socket(socket.AF_INET, kind))
    made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface)
    made.bind(("127.0.0.1", 0))
    return made


def test_a_socket_is_taken_for_its_interface_only(stack: ExitStack) -> None:
    held = bound(stack, interface=b"lo")
    ours = Inherited([held.dup()])
    assert ours.take(held.getsockname(), None) is None
    assert ours.take(held.getsockname(), "eth0") is None
    assert [each.getsockname() for each in ours.unclaimed()] == [held.getsockname()]
    stack.enter_context(ours.take(held.getsockname(), "lo") or pytest.fail("it is there"))
    assert ours.unclaimed() == []


def test_a_socket_is_taken_for_its_address_only_and_again(stack: ExitStack) -> None:
    held, stream = bound(stack), bound(stack, socket.SOCK_STREAM)
    ours = Inherited([held.dup(), stream.dup()])
    for _ in range(2):
        stack.enter_context(ours.take(held.getsockname(), None) or pytest.fail("it is there"))
    assert ours.take(("127.0.0.1", 1), None) is None
    assert ours.take(held.getsockname(), "lo") is None
    assert ours.take(stream.getsockname(), None) is None
    assert [each.type for each in ours.unclaimed()] == [socket.SOCK_STREAM]


def test_ipv6_sockets_are_taken_by_address_too(stack: ExitStack) -> None:
    held = stack.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
    held.bind(("::", 0))
    port = held.getsockname()[1]
    ours = Inherited([held.dup()])
    assert ours.take(("0.0.0.0", port), None) is None
    assert ours.take(("::1", port), None) is None
    assert ours.take(("::", port), "lo") is None
    stack.enter_context(ours.take(("::", port), None) or pytest.fail("it is there"))


def test_a_link_local_socket_is_taken_for_its_interface_only(stack: ExitStack) -> None:
    [rover, station] = stack.enter_context(computers("rover", "station"))
    cable(rover, "lan", "fe80::1/64", station, "eth0", "fe80::2/64")
    cable(rover, "radio", "fe80::1/64", station, "eth1", "fe80::2/64")

    def take() -> list[tuple[str, int]]:
        held = stack.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
        held.bind(("fe80::1", 5000, 0, socket.if_nametoindex("lan")))
        ours = Inherited([held.dup()])
        for host in ("fe80::1", "fe80::1%radio", "fe80::2%lan"):
            assert ours.take((host, 5000), None) is None
        taken = stack.enter_context(ours.take(("fe80::1%lan", 5000), None) or pytest.fail("it is there"))
        return [bound_address(each) for each in (held, taken)]

    assert rover.inside(take) == [("fe80::1%lan", 5000)] * 2


def test_what_is_meant_for_another_process_is_left_alone() -> None:
    environment = {"LISTEN_PID": "1", "LISTEN_FDS": "3", "LISTEN_FDNAMES": "a:b:c"}
    assert sockets._inherited_descriptors(environment) == []
    assert environment == {}


def test_a_listener_waits_for_the_interface_of_a_link_local_address(stack: ExitStack) -> None:
    opened = stack.enter_context(closing(ListeningSocket(("fe80::1%nowhere0", 5000), None, 65536)))
    assert (opened.is_waiting, opened.address) == (True, ("fe80::1%nowhere0", 5000))
    assert not opened.has_lost_interface()
    opened.end_input()


def test_an_ipv6_listener_takes_no_ipv4(stack: ExitStack) -> None:
    old = stack.enter_context(closing(ListeningSocket(("0.0.0.0", 0), None, 65536)))
    new = stack.enter_context(closing(ListeningSocket(("::", old.address[1]), None, 65536)))
    assert (new.address, new.is_waiting) == (("::", old.address[1]), False)
    for each, host in ((new, "::1"), (old, "127.0.0.1")):
        each.socket.settimeout(10)
        with socket.socket(family(host), socket.SOCK_DGRAM) as sender:
            sender.sendto(host.encode(), (host, old.address[1]))
        assert each.socket.recv(100) == host.encode()


def test_a_socket_to_send_from_has_the_port_of_its_listener_unless_that_one_waits(stack: ExitStack) -> None:
    listening = ListeningSocket(("127.0.0.1", 0), None, 65536)
    waiting = ListeningSocket(("192.0.2.77", 5000), None, 65536)
    beside, alone = (stack.enter_context(open_sending(each, [listening, waiting])) for each in (listening, waiting))
    stack.callback(listening.socket.close)
    stack.callback(waiting.socket.close)
    assert (waiting.is_waiting, waiting.address) == (True, ("192.0.2.77", 5000))
    assert (leaves_from(beside), beside.getsockname()[1]) == listening.address
    assert (leaves_from(alone), alone.getsockname()[1]) == ("0.0.0.0", 0)
