"""Listeners on real sockets of the loopback interface."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from router.errors import Located, SourceSpan, StartError
from router.net import sockets, udp
from router.net.kernel import SO_TIMESTAMPNS
from router.net.sockets import Inherited
from router.net.udp import Listener, absence, usual_source, why_not_sent, why_unreachable
from router.table.addresses import Address, BadAddressError
from router.table.model import endpoints
from router.table.model.endpoints import EndpointKind, Framing
from tests.namespaces import cable, computers

SPAN = SourceSpan("routes/rover.yaml", 12, 20, 34)
LIMIT = 1000


def plan(
    name: str = "rover", host: str = "127.0.0.1", port: int = 0, receive_buffer: int = 65536
) -> endpoints.Listener:
    return endpoints.Listener(name, SPAN, Located(Address(host, port), SPAN), Framing.EXACT, receive_buffer)


def endpoint(name: str, address: Address) -> endpoints.Endpoint:
    return endpoints.Endpoint(name, SPAN, Located(address, SPAN), kind=EndpointKind.TOOL)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def peer(stack: ExitStack) -> socket.socket:
    """A board: bound, and patient for 5 s."""
    board = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    board.bind(("127.0.0.1", 0))
    board.settimeout(5)
    return board


def listen(stack: ExitStack, name: str = "rover") -> Listener:
    return stack.enter_context(closing(Listener(plan(name, receive_buffer=1 << 20))))


def test_nothing_new_gets_in_after_the_end_of_input(stack: ExitStack, peer: socket.socket) -> None:
    listener = listen(stack)
    peer.sendto(b"before", listener.address)
    listener.end_input()
    peer.sendto(b"after", listener.address)
    received = listener.socket.recvfrom(LIMIT)
    assert (received, listener.socket.recvfrom(LIMIT)) == ((b"before", peer.getsockname()), (b"", None))


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "127.255.255.255", "::", "::1"],
    ids=["all interfaces", "a broadcast address", "all of IPv6", "IPv6"],
)
def test_a_listener_on_more_than_one_address_ends_too(stack: ExitStack, host: str) -> None:
    listener = stack.enter_context(closing(Listener(plan(host=host))))
    listener.end_input()
    assert listener.socket.recvfrom(LIMIT) == (b"", None)


class _Stranded(socket.socket):
    """A socket whose address has gone from its interface: the kernel then lets it connect to nothing."""

    def connect(self, address: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")


def test_a_listener_whose_address_has_gone_ends_too(stack: ExitStack) -> None:
    listener = listen(stack)
    opened = listener.opened
    opened.socket = stack.enter_context(_Stranded(fileno=opened.socket.detach()))
    listener.end_input()
    assert opened.socket.recvfrom(LIMIT) == (b"", None)


def test_datagrams_that_the_kernel_drops_are_known(stack: ExitStack, peer: socket.socket) -> None:
    listener = stack.enter_context(closing(Listener(plan(receive_buffer=4096))))
    assert listener.kernel_drops() == 0
    for _ in range(500):
        peer.sendto(b"x" * 100, listener.address)
    listener.socket.setblocking(False)
    received = _drain(listener.socket)
    assert listener.kernel_drops() == 500 - received > 0
    listener.close()
    assert listener.kernel_drops() == 500 - received


class _ClosedMeanwhile(socket.socket):
    """A socket that a reload closes while another thread looks at it."""

    def getsockopt(self, *arguments: Any) -> Any:
        self.close()
        return super().getsockopt(*arguments)


def test_a_socket_that_is_closed_while_it_is_looked_at_has_lost_nothing(stack: ExitStack) -> None:
    listener = stack.enter_context(closing(Listener(replace(plan(), interface="lo"))))
    assert not listener.has_lost_interface()
    listener.opened.socket = _ClosedMeanwhile(fileno=os.dup(listener.socket.fileno()))
    assert not listener.has_lost_interface()
    with listener.socket:
        listener.socket = _ClosedMeanwhile(fileno=os.dup(listener.socket.fileno()))
    assert listener.kernel_drops() == 0


def _drain(nonblocking: socket.socket) -> int:
    count = 0
    try:
        while nonblocking.recv(LIMIT):
            count += 1
    except BlockingIOError:
        return count
    raise AssertionError("a datagram was empty")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_port_in_use_is_refused_with_who_has_it(stack: ExitStack, host: str) -> None:
    taken = stack.enter_context(closing(Listener(plan(host=host)))).address
    with pytest.raises(StartError) as refused:
        Listener(plan(host=host, port=taken.port))
    assert str(refused.value) == (
        f"routes/rover.yaml:12:20: listener 'rover' cannot use {taken}: "
        f"the router itself (pid {os.getpid()}) has the port; restart it, or choose another port"
    )


def test_the_port_of_a_listener_that_accepts_nothing_new_is_the_routers(stack: ExitStack) -> None:
    """After a reload, a thread that is stuck may keep it open."""
    ended = listen(stack)
    ended.end_input()
    with pytest.raises(StartError, match=rf"the router itself \(pid {os.getpid()}\) has the port"):
        Listener(plan(port=ended.address.port))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (plan(host="192.0.2.77", port=5000), "no network interface of this computer has that address"),
        (plan(host="2001:db8::77", port=5000), "no network interface of this computer has that address"),
        (plan(host="fe80::77%nowhere0", port=5000), "there is no such network interface"),
        (replace(plan(), interface="nowhere0"), "there is no such network interface"),
    ],
)
def test_an_address_or_interface_that_is_not_there_is_waited_for(
    stack: ExitStack, settings: endpoints.Listener, why: str
) -> None:
    listener = stack.enter_context(closing(Listener(settings)))
    assert (listener.is_waiting, listener.lacks_network(), listener.is_replaceable()) == (True, True, False)
    assert listener.bound_to == settings.bound_to
    assert (absence(settings.address.value, settings.interface) or pytest.fail("it is there"))[0] == why
    listener.end_input()


def test_a_receive_buffer_is_as_large_as_asked_or_warned_about(stack: ExitStack) -> None:
    asked = 8 * int(Path("/proc/sys/net/core/rmem_max").read_text())
    with capture_logs() as logged:
        listener = stack.enter_context(closing(Listener(plan(receive_buffer=asked))))
    granted = listener.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    assert (granted < asked) == any(f"net.core.rmem_max={asked}" in entry.get("remedy", "") for entry in logged)


def test_a_broadcast_destination_is_no_machine() -> None:
    with pytest.raises(BadAddressError, match=r"127.255.255.255 is not the address of a single machine"):
        why_unreachable(Address("127.255.255.255", 9))


@pytest.mark.parametrize(
    ("host", "code", "why"),
    [
        ("fd00::2", errno.ENETUNREACH, "no route leads to fd00::2, or it does not answer: `ip route get fd00::2`"),
        ("fe80::2%eth0", errno.EACCES, "prohibits sending to fe80::2%eth0: `ip route get fe80::2 oif eth0`"),
        ("fe80::2%eth0", errno.EINVAL, "the network interface eth0 is missing: `ip link`"),
        ("fd00::2", errno.EADDRNOTAVAIL, "has no address from which it can send to fd00::2: `ip address`"),
        ("fd00::2", errno.ECONNREFUSED, "nobody listens at [fd00::2]:9"),
    ],
)
def test_why_nothing_was_sent_to_an_ipv6_host(host: str, code: int, why: str) -> None:
    assert why_not_sent(OSError(code, "?"), Address(host, 9)).endswith(why)


def test_routes_to_ipv6_hosts_are_known(stack: ExitStack) -> None:
    rover, station = stack.enter_context(computers("rover", "station"))

    def answers(host: str) -> tuple[object, object]:
        to = Address(host, 9)
        return rover.inside(lambda: (usual_source(to), why_unreachable(to)))

    no_route = "no route leads there", "check the cable, and that `ip address` shows an interface in its network"
    assert answers("::1") == ("::1", None)
    assert answers("fd00::2") == (None, no_route)
    assert answers("fe80::2%lan") == (
        None,
        ("there is no such network interface", "run `ip link` to list the interfaces"),
    )
    cable(rover, "lan", "fd00::1/64", station, "eth0", "fd00::2/64")
    assert answers("fd00::2") == ("fd00::1", None)
    assert answers("fe80::2%lan")[1] is None
    rover.ip("route", "add", "prohibit", "fd01::/64")
    assert answers("fd01::2")[1] == (
        "the kernel refuses it: permission denied",
        "run `ip route get fd01::2` to see which route refuses it",
    )


# sockets of a service manager


@pytest.fixture
def held(stack: ExitStack) -> socket.socket:
    """The service manager's."""
    held = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    held.bind(("127.0.0.1", 0))
    return held


def plan_of(held: socket.socket) -> endpoints.Listener:
    return plan(port=held.getsockname()[1])


@pytest.fixture
def listener(held: socket.socket, stack: ExitStack, monkeypatch: pytest.MonkeyPatch) -> Listener:
    ours = Inherited([held.dup()])
    monkeypatch.setattr(sockets, "inherited", lambda: ours)
    return stack.enter_context(closing(Listener(plan_of(held))))


def test_its_buffer_is_never_made_smaller(held: socket.socket, listener: Listener) -> None:
    before = held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    assert before > 2 * 65536
    assert listener.socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before
    listener.follow(replace(plan_of(held), receive_buffer=32768))  # as a reload asks for
    assert held.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == before


def test_an_ipv6_socket_that_also_has_the_ipv4_port_is_told(monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
    """Without BindIPv6Only=ipv6-only, systemd binds it so."""
    for is_only in (0, 1):
        held = stack.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
        held.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, is_only)
        held.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        held.bind(("::", 0))
        ours = Inherited([held.dup()])
        monkeypatch.setattr(sockets, "inherited", lambda ours=ours: ours)
        with capture_logs() as logged:
            stack.enter_context(closing(Listener(plan(host="::", port=held.getsockname()[1]))))
        assert ["BindIPv6Only=ipv6-only" in each["remedy"] for each in logged] == [True] * (not is_only)
        assert udp.unclaimed() == []


def test_what_nobody_takes_is_told(held: socket.socket, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
    others = [
        stack.enter_context(socket.socket(socket.AF_INET, kind)) for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM)
    ]
    others[0].setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
    for each in others:
        each.bind(("127.0.0.1", 0))
    ours = Inherited([held.dup(), *(each.dup() for each in others)])
    monkeypatch.setattr(sockets, "inherited", lambda: ours)
    stack.enter_context(closing(Listener(plan_of(held))))
    beside, stream = udp.unclaimed()
    assert beside == f"{Address(*others[0].getsockname())} on lo"
    assert stream.endswith("which is not a UDP socket")
