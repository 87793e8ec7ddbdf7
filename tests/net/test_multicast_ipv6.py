"""IPv6 groups that a listening socket joins, in namespaces with a cable between them."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from router.net import multicast
from router.net.multicast import route_index
from router.net.ready import readable
from router.net.sockets import ListeningSocket
from tests.namespaces import Computer, cable, computers
from tests.net.test_multicast import PATIENCE_S, PORT, index, rejoin, stack

__all__ = ["stack"]

GROUP, OTHER = "ff15::4", "ff15::5"


@pytest.fixture
def two() -> Iterator[tuple[Computer, Computer]]:
    """A computer that listens and one that sends, connected by eth0 of both."""
    with computers("listening", "sending") as (listening, sending):
        connect(listening, sending)
        yield listening, sending


def connect(listening: Computer, sending: Computer) -> None:
    cable(listening, "eth0", "fd00::1/64", sending, "eth0", "fd00::2/64")


def listen(stack: ExitStack, computer: Computer, *groups: str, interface: str | None = None) -> ListeningSocket:
    opened = computer.inside(lambda: ListeningSocket(("::", PORT), interface, 65536, groups))
    opened.socket.settimeout(PATIENCE_S)
    return stack.enter_context(closing(opened))


def receives(opened: ListeningSocket, sending: Computer, group: str) -> bool:
    """Return whether a datagram to the group arrives; one to the computer itself comes before it, and after it."""

    def send(host: str) -> None:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
            sender.sendto(host.encode(), (host, PORT))

    for host in ("fd00::1", group, "fd00::1"):
        sending.inside(lambda host=host: send(host))  # type: ignore[misc]
        if host != group:
            readable([opened.socket], PATIENCE_S)
    heard = [opened.socket.recv(100).decode() for _ in range(2)]
    if has_arrived := heard[1] == group:
        heard.append(opened.socket.recv(100).decode())
    assert heard == ["fd00::1", *[group] * has_arrived, "fd00::1"]
    return has_arrived


@pytest.mark.parametrize("interface", ["eth0", None])
def test_only_the_socket_s_own_groups_are_received(
    stack: ExitStack, two: tuple[Computer, Computer], interface: str | None
) -> None:
    listening, sending = two
    other = stack.enter_context(listening.inside(lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)))
    membership = socket.inet_pton(socket.AF_INET6, OTHER) + index(listening).to_bytes(4, "little")
    other.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, membership)
    opened = listen(stack, listening, GROUP, interface=interface)
    assert not opened.missing_groups
    assert receives(opened, sending, GROUP)
    assert not receives(opened, sending, OTHER)
    assert rejoin(opened, listening, OTHER) == {}  # a reload of another table
    assert not receives(opened, sending, GROUP)
    assert receives(opened, sending, OTHER)


def test_the_route_to_a_group_selects_the_interface(stack: ExitStack, two: tuple[Computer, Computer]) -> None:
    listening, sending = two
    cable(listening, "eth1", "fd01::1/64", sending, "eth1", "fd01::2/64")
    listening.ip("-6", "route", "add", "ff15::4/128", "dev", "eth1", "table", "local")
    opened = listen(stack, listening, GROUP)
    assert [listening.inside(lambda host=host: route_index(host)) for host in (GROUP, "fd00::2")] == [  # type: ignore[misc]
        index(listening, "eth1"),
        index(listening),
    ]
    assert not receives(opened, sending, GROUP)
    listening.ip("-6", "route", "del", "ff15::4/128", "dev", "eth1", "table", "local")
    assert rejoin(opened, listening, GROUP) == {}
    assert receives(opened, sending, GROUP)


@pytest.mark.parametrize(("interface", "why"), [("eth0", multicast.NO_INTERFACE), (None, multicast.NO_ROUTE)])
def test_a_group_is_joined_again_on_an_interface_that_returns(
    stack: ExitStack, two: tuple[Computer, Computer], interface: str | None, why: str
) -> None:
    listening, sending = two
    opened = listen(stack, listening, GROUP)
    groups = multicast.Groups(opened.socket, interface)

    def follow() -> dict[str, str]:
        listening.inside(lambda: groups.follow([GROUP]))
        return groups.missing

    rejoin(opened, listening)
    assert follow() == {}
    listening.ip("link", "del", "eth0")
    assert listening.inside(lambda: route_index(GROUP)) is None
    assert follow() == {GROUP: why}
    connect(listening, sending)
    assert not receives(opened, sending, GROUP)
    assert follow() == {}
    assert receives(opened, sending, GROUP)


def test_the_port_is_shared_with_programs_that_share_it(stack: ExitStack, two: tuple[Computer, Computer]) -> None:
    listening, sending = two
    first = listen(stack, listening, GROUP, interface="eth0")
    second = listen(stack, listening, GROUP, interface="eth0")
    for each in (first, second):
        each.socket.settimeout(PATIENCE_S)

    def send() -> None:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"warm up", ("fd00::1", PORT))
            readable([first.socket, second.socket], PATIENCE_S)
            sender.sendto(b"to all", (GROUP, PORT))

    sending.inside(send)
    heard = [each.socket.recv(100) for each in (first, second)]
    heard.append((first if heard[0] == b"warm up" else second).socket.recv(100))
    assert sorted(heard) == [b"to all", b"to all", b"warm up"]
    with pytest.raises(OSError, match="already in use") as refused:
        listen(stack, listening)
    assert refused.value.errno == errno.EADDRINUSE
