"""Senders to IPv6 hosts leave from their listener's address and port, and only the listener receives."""

from __future__ import annotations

import ctypes
import errno
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest

from router.hosts import host_number
from router.net import sockets
from router.net.addresses import bound_address, know
from router.net.kernel import IP_FREEBIND
from router.net.sockets import Inherited
from router.net.udp import Listener, open_sending
from router.table.addresses import Address
from router.table.model.endpoints import EndpointKind
from tests.carrier.test_sender import PATIENCE, Make, Sending, fill, make
from tests.namespaces import Computer, cable, computers
from tests.net.test_udp import endpoint, plan

__all__ = ["make"]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def two(stack: ExitStack) -> tuple[Computer, Computer]:
    """The rover, which has fd00::1 and fd00::3, and a station with fd00::2."""
    rover, station = stack.enter_context(computers("rover", "station"))
    cable(rover, "lan", "fd00::1/64", station, "eth0", "fd00::2/64")
    rover.ip("address", "add", "fd00::3/64", "dev", "lan")
    return rover, station


def bound(stack: ExitStack, computer: Computer, host: str, port: int = 9000, interface: str = "") -> socket.socket:
    def bind() -> socket.socket:
        opened = stack.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
        opened.bind((host, port, 0, socket.if_nametoindex(interface) if interface else 0))
        opened.settimeout(PATIENCE)
        return opened

    return computer.inside(bind)


def listen(stack: ExitStack, computer: Computer, host: str, interface: str | None = None) -> Listener:
    settings = replace(plan(host=host, port=5000), interface=interface)
    listener = stack.enter_context(closing(computer.inside(lambda: Listener(settings))))
    listener.socket.settimeout(PATIENCE)
    return listener


def send_from(
    stack: ExitStack, make: Make, computer: Computer, listener: Listener, to: Address, *others: Listener
) -> Sending:
    board = replace(endpoint("board", to), kind=EndpointKind.BOARD)
    return stack.enter_context(closing(computer.inside(lambda: make(board, listener, [listener, *others]))))


def hears_nothing(*opened: socket.socket) -> bool:
    for each in opened:
        each.setblocking(False)
        try:
            each.recv(100)
        except BlockingIOError:
            continue
        return False
    return True


@pytest.mark.parametrize(("host", "source"), [("::", None), ("fd00::1", "fd00::1"), ("fd00::3", "fd00::3")])
def test_it_leaves_from_its_listener_and_answers_reach_the_listener(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer], host: str, source: str | None
) -> None:
    rover, station = two
    board, listener = bound(stack, station, "fd00::2"), listen(stack, rover, host)
    senders = [send_from(stack, make, rover, listener, Address("fd00::2", 9000)) for _ in range(3)]
    for number, sender in enumerate(senders):
        assert (sender.is_bound, sender.leaves_from) == (True, host)
        assert sender.is_placed(listener.opened, [listener.opened])
        sender.send(b"drive %d" % number)
        data, where_from = board.recvfrom(100)
        assert data == b"drive %d" % number
        assert where_from[:2] == (source or where_from[0], 5000)
        board.sendto(b"obeyed %d" % number, where_from)
        assert listener.socket.recv(100) == b"obeyed %d" % number
    assert hears_nothing(*(sender.socket for sender in senders))


@pytest.mark.parametrize("host", ["::", "fd00::1"])
@pytest.mark.parametrize("shares", [0, 1])
def test_nobody_else_can_have_the_port(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer], host: str, shares: int
) -> None:
    rover, _ = two
    send_from(stack, make, rover, listen(stack, rover, host), Address("fd00::2", 9000))

    def steal() -> None:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, shares)
            other.bind((host, 5000))

    with pytest.raises(OSError, match="Address already in use"):
        rover.inside(steal)


def test_listeners_of_both_families_have_the_same_port(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer]
) -> None:
    rover, station = two
    rover.ip("address", "add", "10.78.1.1/24", "dev", "lan")
    station.ip("address", "add", "10.78.1.2/24", "dev", "eth0")
    new, old = (listen(stack, rover, host) for host in ("::", "0.0.0.0"))
    board = bound(stack, station, "::")
    for listener, other, to in ((new, old, "fd00::2"), (old, new, "10.78.1.2")):
        sender = send_from(stack, make, rover, listener, Address(to, 9000), other)
        assert sender.is_placed(listener.opened, [new.opened, old.opened])
        sender.send(to.encode())
        data, where_from = board.recvfrom(100)
        assert (data, where_from[1]) == (to.encode(), 5000)
        board.sendto(b"to " + data, where_from)
        assert listener.socket.recv(100) == b"to " + data
    assert hears_nothing(new.socket, old.socket)


def test_each_sender_hears_of_its_own_losses(
    stack: ExitStack, library: ctypes.CDLL, make: Make, two: tuple[Computer, Computer]
) -> None:
    """The kernel tells the listener, which passes it on, and receives on."""
    rover, station = two
    board, listener = bound(stack, station, "fd00::2"), listen(stack, rover, "fd00::1")
    lost = send_from(stack, make, rover, listener, Address("fd00::2", 9001))
    sender = send_from(stack, make, rover, listener, Address("fd00::2", 9000))
    assert lost.send(b"lost") == 4
    with pytest.raises(ConnectionRefusedError):
        listener.socket.recv(100)
    assert library.sender_note_errors(listener.socket.fileno())
    board.sendto(b"telemetry", ("fd00::1", 5000))
    assert listener.socket.recv(100) == b"telemetry"
    assert sender.send(b"drive") == 5
    with pytest.raises(ConnectionRefusedError):
        lost.send(b"lost too")


def test_a_brake_that_nobody_takes_is_told_at_once(stack: ExitStack, make: Make) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as absent:
        absent.bind(("::1", 0))
        port = absent.getsockname()[1]
    listener = stack.enter_context(closing(Listener(plan(host="::1"))))
    for source in ((listener, [listener]), ()):
        sender = stack.enter_context(closing(make(endpoint("board", Address("::1", port)), *source)))
        with pytest.raises(ConnectionRefusedError):
            sender.send_checked(b"brake")


def test_a_flood_of_errors_leaves_no_room_taken(stack: ExitStack, library: ctypes.CDLL, make: Make) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as absent:
        absent.bind(("::1", 0))
        to = Address("::1", absent.getsockname()[1])
    listener = stack.enter_context(closing(Listener(plan(host="::1"))))
    lost = stack.enter_context(closing(make(endpoint("absent", to), listener, [listener])))
    for _ in range(100):
        lost.send(b"lost")
    assert library.sender_note_errors(listener.socket.fileno())
    assert not library.sender_note_errors(listener.socket.fileno())


def test_of_commands_to_a_board_that_is_gone_few_are_kept_and_every_brake_is_sent(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer]
) -> None:
    """A board that answers has room of its own meanwhile."""
    rover, station = two
    listener, board = listen(stack, rover, "::"), bound(stack, station, "::")
    rover.run("sysctl", "-qw", "net.ipv6.neigh.lan.mcast_solicit=60")  # it keeps asking, however slow this test is
    gone = send_from(stack, make, rover, listener, Address("fd00::4", 9000))
    kept = fill(gone)
    assert 16 <= kept <= 24
    for _ in range(20):
        assert gone.send_checked(b"brake") == 5
        with pytest.raises(BlockingIOError):
            gone.send(b"command too many")
    assert send_from(stack, make, rover, listener, Address("fd00::2", 9000)).send(b"drive") == 5
    assert board.recv(100) == b"drive"
    station.ip("address", "add", "fd00::4/64", "dev", "eth0")
    arrived = [board.recv(100) for _ in range(kept + 20)]
    assert arrived == [b"command %d" % number for number in range(kept)] + 20 * [b"brake"]


def test_after_the_end_of_input_brakes_leave_as_before(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer]
) -> None:
    rover, station = two
    board = bound(stack, station, "fd00::2")
    for host in ("::", "fd00::3"):
        with closing(listen(stack, rover, host)) as listener:
            sender = send_from(stack, make, rover, listener, Address("fd00::2", 9000))
            sender.send(b"drive")
            where_from = board.recvfrom(100)[1]
            listener.end_input()
            listener.socket.setblocking(True)
            board.sendto(b"too late", where_from)
            assert listener.socket.recvfrom(100) == (b"", None)
            assert sender.send_checked(b"brake") == 5
            assert board.recvfrom(100) == (b"brake", where_from)
            sender.close()


def test_it_leaves_from_the_address_of_an_inherited_listener_once_that_is_there(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd binds it, with FreeBind=yes."""
    rover, station = two
    held = stack.enter_context(rover.inside(lambda: socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)))
    held.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    held.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)
    held.bind(("fd00::9", 5000))
    ours = Inherited([held.dup()])
    monkeypatch.setattr(sockets, "inherited", lambda: ours)
    board, listener = bound(stack, station, "fd00::2"), listen(stack, rover, "fd00::9")
    assert (listener.is_inherited, rover.inside(listener.lacks_network)) == (True, True)
    sender = send_from(stack, make, rover, listener, Address("fd00::2", 9000))
    sender.send(b"brake")
    data, (host, port, *_) = board.recvfrom(100)
    assert (data, host in ("fd00::1", "fd00::3"), port) == (b"brake", True, 5000)
    rover.inside(sender.follow_interface)
    assert sender.leaves_from == "::"
    rover.ip("address", "add", "fd00::9/64", "dev", "lan")
    rover.inside(sender.follow_interface)
    sender.send(b"drive")
    data, where_from = board.recvfrom(100)
    assert (data, where_from[:2], sender.leaves_from) == (b"drive", ("fd00::9", 5000), "fd00::9")
    board.sendto(b"obeyed", where_from)
    assert listener.socket.recv(100) == b"obeyed"


def test_it_gets_over_the_loss_of_its_address_and_of_the_network(
    stack: ExitStack, make: Make, two: tuple[Computer, Computer]
) -> None:
    rover, station = two
    board, listener = bound(stack, station, "fd00::2"), listen(stack, rover, "fd00::3")
    sender = send_from(stack, make, rover, listener, Address("fd00::2", 9000))
    rover.ip("address", "del", "fd00::3/64", "dev", "lan")
    assert sender.send_checked(b"brake") == 5
    assert board.recv(100) == b"brake"
    rover.ip("link", "set", "lan", "down")
    with pytest.raises(OSError, match=r"unreachable|assign") as refused:
        sender.send(b"lost")
    assert refused.value.errno in (errno.ENETUNREACH, errno.EADDRNOTAVAIL)
    rover.ip("link", "set", "lan", "up")
    for host in ("fd00::1", "fd00::3"):
        rover.ip("address", "add", f"{host}/64", "dev", "lan")
    sender.send(b"drive")
    data, where_from = board.recvfrom(100)
    assert (data, where_from[:2]) == (b"drive", ("fd00::3", 5000))


def link_local(computer: Computer, interface: str) -> str:
    [found] = [
        line.split()[3]
        for line in computer.ip("-6", "-o", "address", "show", "dev", interface, "scope", "link").splitlines()
    ]
    return found.partition("/")[0]


def test_link_local_hosts_are_reached_at_an_interface_that_returns(
    stack: ExitStack, library: ctypes.CDLL, make: Make, two: tuple[Computer, Computer]
) -> None:
    rover, station = two
    own, other = f"{link_local(rover, 'lan')}%lan", link_local(station, "eth0")
    listener, anywhere = listen(stack, rover, own), listen(stack, rover, "::", interface="lo")
    board = bound(stack, station, "::")
    to = Address(f"{other}%lan", 9000)
    sender = send_from(stack, make, rover, listener, to, anywhere)
    elsewhere = send_from(stack, make, rover, anywhere, to, listener)
    assert sender.leaves_from == own.partition("%")[0]
    assert rover.inside(lambda: bound_address(listener.socket)) == (own, 5000)
    for each in (sender, elsewhere):
        each.send(b"drive")
        data, where_from = board.recvfrom(100)
        assert (data, where_from[:2]) == (b"drive", (own.partition("%")[0], 5000))
    board.sendto(b"obeyed", where_from)
    assert listener.socket.recv(100) == b"obeyed"
    assert not listener.has_lost_interface()
    rover.ip("link", "del", "lan")
    assert rover.inside(listener.lacks_network)
    assert listener.has_lost_interface()
    with pytest.raises(OSError, match=r"device|unreachable"):
        elsewhere.send(b"lost")
    assert rover.inside(lambda: know(library, to.host)) == host_number(to.host)
    cable(rover, "lan", "fd00::1/64", station, "eth0", "fd00::2/64")
    station.ip("address", "add", f"{other}/64", "dev", "eth0")
    rover.inside(lambda: know(library, to.host))
    elsewhere.send(b"drive")
    assert board.recv(100) == b"drive"


def test_a_group_gets_it_from_the_listeners_port_through_the_groups_interface(
    stack: ExitStack, library: ctypes.CDLL, two: tuple[Computer, Computer]
) -> None:
    rover, station = two
    cable(rover, "other", "fd01::1/64", station, "eth1", "fd01::2/64")
    listener, board = listen(stack, rover, "::"), bound(stack, station, "::")
    group = Address("ff15::4", 9000)
    membership = socket.inet_pton(socket.AF_INET6, group.host) + bytes(
        station.inside(lambda: socket.if_nametoindex("eth0")).to_bytes(4, "little")
    )
    board.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, membership)

    def make_sender() -> Sending:
        opened = open_sending(endpoint("headsets", group), listener, [listener.opened])
        return Sending(library, group, opened, listener.opened, ("lan", 1, False))

    sender = stack.enter_context(closing(rover.inside(make_sender)))
    sender.send(b"pose")
    data, where_from = board.recvfrom(100)
    assert (data, where_from[1]) == (b"pose", 5000)
    rover.ip("link", "del", "lan")
    rover.inside(sender.follow_interface)
    with pytest.raises(OSError, match="Bad file descriptor"):
        sender.send(b"lost")


def test_a_sender_to_a_learned_address_reaches_both_families(
    stack: ExitStack, library: ctypes.CDLL, make: Make
) -> None:
    sender = stack.enter_context(closing(make(endpoint("driver", Address("learned", 0)))))
    for family, host in ((socket.AF_INET6, "::1"), (socket.AF_INET, "127.0.0.1")):
        with socket.socket(family, socket.SOCK_DGRAM) as driver:
            driver.bind((host, 0))
            driver.settimeout(PATIENCE)
            library.sender_aim(sender.address, know(library, host), driver.getsockname()[1])
            sender.send(b"hello")
            assert driver.recv(100) == b"hello"
