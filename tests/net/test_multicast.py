"""Groups that a listening socket joins, in namespaces with a cable between them."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from router.net import multicast
from router.net.sockets import ListeningSocket
from tests.namespaces import Computer, cable, computers

GROUP, OTHER = "224.5.23.2", "224.5.23.3"
PORT = 10006
PATIENCE_S = 5


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def two() -> Iterator[tuple[Computer, Computer]]:
    """A computer that listens and one that sends, connected by eth0 of both."""
    with computers("listening", "sending") as (listening, sending):
        cable(listening, "eth0", "10.78.1.1/24", sending, "eth0", "10.78.1.2/24")
        sending.ip("route", "add", "224.0.0.0/4", "dev", "eth0")
        yield listening, sending


def listen(stack: ExitStack, computer: Computer, *groups: str, interface: str | None = None) -> ListeningSocket:
    opened = computer.inside(lambda: ListeningSocket(("0.0.0.0", PORT), interface, 65536, groups))
    opened.socket.settimeout(PATIENCE_S)
    return stack.enter_context(closing(opened))


def send(*hosts: str) -> None:
    """Send each host its own name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for host in hosts:
            sender.sendto(host.encode(), (host, PORT))


def receives(opened: ListeningSocket, sending: Computer, group: str) -> bool:
    """Return whether a datagram to the group arrives; one to the computer itself follows it."""
    sending.inside(lambda: send(group, "10.78.1.1"))
    if has_arrived := opened.socket.recv(100) == group.encode():
        assert opened.socket.recv(100) == b"10.78.1.1"
    return has_arrived


def index(computer: Computer, interface: str = "eth0") -> int:
    return computer.inside(lambda: socket.if_nametoindex(interface))


def rejoin(opened: ListeningSocket, computer: Computer, *groups: str) -> dict[str, str]:
    computer.inside(lambda: opened.follow_groups(groups))
    return {**opened.missing_groups}


@pytest.mark.parametrize("interface", ["eth0", None])
def test_only_the_socket_s_own_groups_are_received(
    stack: ExitStack, two: tuple[Computer, Computer], interface: str | None
) -> None:
    listening, sending = two
    listening.ip("route", "add", "224.0.0.0/4", "dev", "eth0")
    other = stack.enter_context(listening.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    membership = socket.inet_aton(OTHER) + bytes(4) + struct.pack("@i", index(listening))
    other.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    opened = listen(stack, listening, GROUP, interface=interface)
    assert not opened.missing_groups
    assert receives(opened, sending, GROUP)
    assert not receives(opened, sending, OTHER)
    assert rejoin(opened, listening, OTHER) == {}  # a reload of another table
    assert not receives(opened, sending, GROUP)
    assert receives(opened, sending, OTHER)


def test_the_route_to_a_group_selects_the_interface(stack: ExitStack, two: tuple[Computer, Computer]) -> None:
    listening, sending = two
    opened = listen(stack, listening, GROUP)
    assert opened.missing_groups == {GROUP: multicast.NO_ROUTE}
    assert listening.inside(lambda: multicast.route_index(GROUP)) is None
    assert not receives(opened, sending, GROUP)
    listening.ip("route", "add", "default", "via", "10.78.1.2")
    assert listening.inside(lambda: multicast.route_index(GROUP)) == index(listening)
    assert rejoin(opened, listening, GROUP) == {}
    assert receives(opened, sending, GROUP)
    listening.ip("route", "del", "default")
    assert rejoin(opened, listening, GROUP) == {}
    assert receives(opened, sending, GROUP)
    listening.ip("route", "add", "224.0.0.0/4", "dev", "lo")
    assert rejoin(opened, listening, GROUP) == {}
    assert not receives(opened, sending, GROUP)


def test_a_group_is_joined_again_on_an_interface_that_returns(stack: ExitStack, two: tuple[Computer, Computer]) -> None:
    listening, sending = two
    listening.ip("route", "add", "224.0.0.0/4", "dev", "eth0")
    opened = listen(stack, listening, GROUP)
    listening.ip("link", "del", "eth0")
    assert rejoin(opened, listening, GROUP) == {GROUP: multicast.NO_ROUTE}
    cable(listening, "eth0", "10.78.1.1/24", sending, "eth0", "10.78.1.2/24")
    for computer in two:
        computer.ip("route", "add", "224.0.0.0/4", "dev", "eth0")
    assert not receives(opened, sending, GROUP)
    assert rejoin(opened, listening, GROUP) == {}
    assert receives(opened, sending, GROUP)


def test_the_port_is_shared_with_programs_that_share_it(stack: ExitStack, two: tuple[Computer, Computer]) -> None:
    listening, sending = two
    first = listen(stack, listening, GROUP, interface="eth0")
    second = listen(stack, listening, GROUP, interface="eth0")
    sending.inside(lambda: send(GROUP))
    assert [each.socket.recv(100) for each in (first, second)] == [GROUP.encode()] * 2
    with pytest.raises(OSError, match="already in use") as refused:
        listen(stack, listening)
    assert refused.value.errno == errno.EADDRINUSE
    rejoin(first, listening)
    rejoin(second, listening)
    with first.shared():
        pass
    assert [each.socket.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR) for each in (first, second)] == [0, 0]
