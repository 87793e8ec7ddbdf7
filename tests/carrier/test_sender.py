"""Senders account for every datagram, get over changes of the network, and have their answers reach a listener."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest
from structlog.testing import capture_logs

from router.carrier.sender import NativeSender
from router.net import sockets
from router.net.kernel import IP_FREEBIND
from router.net.sockets import Inherited
from router.net.udp import Listener, open_sending
from router.table.addresses import Address
from router.table.model.endpoints import Endpoint, EndpointKind
from tests.namespaces import cable, computers, narrow_path
from tests.net.test_udp import endpoint, plan

PATIENCE = 10.0
Make = Callable[..., "Sending"]
"""Called with an endpoint, the listener that it sends from, and all listeners."""


class Sending(NativeSender):
    """What sends, as the carrier's threads do."""

    def send(self, data: bytes) -> int:
        return self._sent(self._library.sender_send(self.address, data, len(data)), data)

    def send_checked(self, data: bytes) -> int:
        return self._sent(self._library.sender_send_checked(self.address, data, len(data)), data)

    def _sent(self, error: int, data: bytes) -> int:
        if error:
            raise OSError(error, os.strerror(error))
        return len(data)


@pytest.fixture(scope="session")
def make(library: ctypes.CDLL) -> Make:
    def make(to: Endpoint, source: Listener | None = None, listeners: Sequence[Listener] = ()) -> Sending:
        opened = open_sending(to, source, [each.opened for each in listeners])
        return Sending(library, to.address.value, opened, source.opened if source else None)

    return make


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def board(stack: ExitStack) -> socket.socket:
    board = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    board.bind(("127.0.0.1", 0))
    board.settimeout(10)
    return board


@pytest.fixture
def listener(stack: ExitStack) -> Listener:
    return stack.enter_context(closing(Listener(plan())))


@pytest.fixture
def sender(stack: ExitStack, make: Make, board: socket.socket, listener: Listener) -> Sending:
    """It sends to the board, from the listener's port."""
    return stack.enter_context(closing(make(endpoint("board", Address(*board.getsockname())), listener, [listener])))


def send_to(stack: ExitStack, make: Make, address: Address) -> Sending:
    return stack.enter_context(closing(make(endpoint("board", address))))


def test_news_of_an_old_loss_does_not_cost_a_healthy_datagram(stack: ExitStack, make: Make) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        address = Address(*absent.getsockname())
    sender = send_to(stack, make, address)
    sender.send(b"lost")  # nobody listens, and the kernel is told so
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(address)
        late.settimeout(5)
        with pytest.raises(ConnectionRefusedError):
            sender.send(b"arrives")
        assert sender.send(b"arrives too") == 11
        assert [late.recv(100), late.recv(100)] == [b"arrives", b"arrives too"]


def test_who_looks_hears_of_his_own_loss_and_the_next_datagram_of_none(stack: ExitStack, make: Make) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        address = Address(*closed.getsockname())
    sender = send_to(stack, make, address)
    with pytest.raises(ConnectionRefusedError):
        sender.send_checked(b"brake")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(address)
        opened.settimeout(10)
        assert sender.send(b"drive") == 5
        assert sender.send_checked(b"brake") == 5
        assert [opened.recv(100) for _ in range(2)] == [b"drive", b"brake"]


def test_losses_are_counted_one_for_one(stack: ExitStack, make: Make) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        sender = send_to(stack, make, Address(*absent.getsockname()))
    outcomes = []
    for _ in range(10):
        try:
            outcomes.append(sender.send(b"lost"))
        except ConnectionRefusedError:
            outcomes.append(0)
    assert outcomes == [4] + 9 * [0]  # the loss of the tenth would be told by an eleventh


def test_a_datagram_too_long_to_send_is_an_error_of_its_own(stack: ExitStack, make: Make, board: socket.socket) -> None:
    with pytest.raises(OSError, match="too long"):
        send_to(stack, make, Address(*board.getsockname())).send(bytes(70000))


@pytest.mark.parametrize("beside", [False, True])
def test_a_datagram_larger_than_the_paths_mtu_arrives_though_icmp_is_filtered(
    stack: ExitStack, make: Make, beside: bool
) -> None:
    rover, station = stack.enter_context(narrow_path())
    board = stack.enter_context(station.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(("10.78.2.2", 9000))
    board.settimeout(PATIENCE)
    listener = stack.enter_context(closing(rover.inside(lambda: Listener(plan(host="0.0.0.0", port=5000)))))
    source = (listener, [listener]) if beside else ()
    to = endpoint("board", Address("10.78.2.2", 9000))
    sender = stack.enter_context(closing(rover.inside(lambda: make(to, *source))))
    for size in (100, 1400, 4000):
        sender.send(bytes(size))
        assert len(board.recv(65536)) == size


def test_it_sends_from_its_listeners_port_and_answers_reach_the_listener(
    sender: Sending, board: socket.socket, listener: Listener
) -> None:
    sender.send(b"drive")
    data, where_from = board.recvfrom(100)
    assert (data, where_from) == (b"drive", listener.address)
    board.sendto(b"obeyed", where_from)
    assert listener.socket.recvfrom(100) == (b"obeyed", board.getsockname())


def test_many_senders_share_a_port_with_a_listener_on_all_networks(
    stack: ExitStack, make: Make, board: socket.socket
) -> None:
    listener = stack.enter_context(closing(Listener(plan(host="0.0.0.0"))))
    for number in range(5):
        to = endpoint(f"board_{number}", Address(*board.getsockname()))
        stack.enter_context(closing(make(to, listener, [listener]))).send(b"%d" % number)
        data, where_from = board.recvfrom(100)
        assert (data, where_from) == (b"%d" % number, ("127.0.0.1", listener.address.port))
        board.sendto(b"to %d" % number, where_from)
        assert listener.socket.recv(100) == b"to %d" % number


def test_it_shares_the_port_of_an_inherited_listener_also_while_the_address_is_not_there(
    stack: ExitStack, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd binds it, with FreeBind=yes."""
    rover, station = stack.enter_context(computers("rover", "station"))
    cable(rover, "lan", "10.78.1.1/24", station, "lan", "10.78.1.2/24")
    held = stack.enter_context(rover.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.setsockopt(socket.IPPROTO_IP, IP_FREEBIND, 1)
    held.bind(("10.78.1.3", 5000))
    ours = Inherited([held.dup()])
    monkeypatch.setattr(sockets, "inherited", lambda: ours)
    listener = stack.enter_context(closing(rover.inside(lambda: Listener(plan(host="10.78.1.3", port=5000)))))
    assert (listener.is_inherited, listener.is_waiting) == (True, False)
    assert rover.inside(listener.lacks_network)
    board = stack.enter_context(station.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(("10.78.1.2", 9000))
    board.settimeout(10)
    to = endpoint("board", Address("10.78.1.2", 9000))
    sender = stack.enter_context(closing(rover.inside(lambda: make(to, listener, [listener]))))
    sender.send(b"brake")
    assert board.recvfrom(100) == (b"brake", ("10.78.1.1", 5000))
    rover.ip("address", "add", "10.78.1.3/24", "dev", "lan")
    sender.send(b"drive")
    data, where_from = board.recvfrom(100)
    assert (data, where_from) == (b"drive", ("10.78.1.3", 5000))
    board.sendto(b"obeyed", where_from)
    listener.socket.settimeout(10)
    assert listener.socket.recv(100) == b"obeyed"


@pytest.mark.parametrize("shares", [0, 1])
def test_nobody_else_can_have_the_port(listener: Listener, sender: Sending, shares: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, shares)
        with pytest.raises(OSError, match="Address already in use"):
            other.bind(listener.address)


def test_a_sender_queues_nothing_that_its_listener_does_not_receive(stack: ExitStack, make: Make) -> None:
    """The listener of an interface does not receive what comes in by another one; the sender is bound to none."""
    rover, station = stack.enter_context(computers("rover", "station"))
    cable(rover, "lan", "10.78.1.1/24", station, "lan", "10.78.1.2/24")
    board = stack.enter_context(rover.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(("127.0.0.1", 0))
    board.settimeout(10)
    settings = replace(plan(host="0.0.0.0", port=5000), interface="lan")
    listener = stack.enter_context(closing(rover.inside(lambda: Listener(settings))))
    to = endpoint("board", Address(*board.getsockname()))
    sender = stack.enter_context(closing(rover.inside(lambda: make(to, listener, [listener]))))
    sender.send(b"drive")
    _, where_from = board.recvfrom(100)
    board.sendto(b"by another interface", where_from)
    for opened in (sender.socket, listener.socket):
        with pytest.raises(BlockingIOError):
            opened.recv(100, socket.MSG_DONTWAIT)


def test_an_endpoint_without_a_listener_has_a_port_of_its_own_and_hears_no_answer(
    stack: ExitStack, make: Make, board: socket.socket
) -> None:
    sender = stack.enter_context(closing(make(endpoint("board", Address(*board.getsockname())))))
    ports = set()
    for _ in range(2):
        sender.send(b"drive")
        _, where_from = board.recvfrom(100)
        ports.add(where_from[1])
        board.sendto(b"answer", where_from)
    assert len(ports) == 1
    with pytest.raises(BlockingIOError):
        sender.socket.recv(100)


def test_each_sender_hears_of_its_own_losses(
    stack: ExitStack, library: ctypes.CDLL, make: Make, board: socket.socket, listener: Listener, sender: Sending
) -> None:
    """The kernel tells the listener, which passes it on, and receives on."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        address = Address(*absent.getsockname())
    lost = stack.enter_context(closing(make(endpoint("absent", address), listener, [listener])))
    assert lost.send(b"lost") == 4
    board.sendto(b"telemetry", listener.address)
    with pytest.raises(ConnectionRefusedError):
        listener.socket.recv(100)
    assert library.sender_note_errors(listener.socket.fileno())
    assert listener.socket.recv(100) == b"telemetry"
    assert sender.send(b"drive") == 5
    with pytest.raises(ConnectionRefusedError):
        lost.send(b"lost too")
    assert lost.send(b"the listener was not asked again") == 32


def test_errors_that_come_by_another_interface_than_the_listeners_cost_no_datagram(
    stack: ExitStack, make: Make
) -> None:
    rover, lan, radio = stack.enter_context(computers("rover", "lan", "radio"))
    cable(rover, "lan", "10.78.1.1/24", lan, "eth0", "10.78.1.2/24")
    cable(rover, "radio", "10.78.2.1/24", radio, "eth0", "10.78.2.2/24")
    settings = replace(plan(host="0.0.0.0", port=5000), interface="radio")
    listener = stack.enter_context(closing(rover.inside(lambda: Listener(settings))))
    address = Address("10.78.1.2", 9000)
    sender = stack.enter_context(closing(rover.inside(lambda: make(endpoint("board", address), listener, [listener]))))
    assert sender.send(b"lost") == 4
    refused = select.poll()
    refused.register(sender.socket, select.POLLERR)
    assert refused.poll(PATIENCE * 1000)
    with stack.enter_context(lan.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))) as board:
        board.bind(address)
        board.settimeout(10)
        with pytest.raises(ConnectionRefusedError):
            sender.send(b"drive")
        assert board.recv(100) == b"drive"
        assert sender.send_checked(b"brake") == 5
        assert board.recv(100) == b"brake"


def test_a_flood_of_errors_leaves_no_room_taken(
    stack: ExitStack, library: ctypes.CDLL, make: Make, listener: Listener
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as absent:
        absent.bind(("127.0.0.1", 0))
        address = Address(*absent.getsockname())
    lost = stack.enter_context(closing(make(endpoint("absent", address), listener, [listener])))
    for _ in range(100):
        lost.send(b"lost")
    assert library.sender_note_errors(listener.socket.fileno())
    assert not library.sender_note_errors(listener.socket.fileno())


def test_a_sender_moves_to_another_port_and_back(
    stack: ExitStack, sender: Sending, board: socket.socket, listener: Listener
) -> None:
    other = stack.enter_context(closing(Listener(plan("other"))))
    to = endpoint("board", Address(*board.getsockname()))
    for source in (other, None, listener):
        opened = open_sending(to, source, [listener.opened, other.opened])
        sender.move(source.opened if source else None, opened).close()
        sender.send(b"drive")
        _, where_from = board.recvfrom(100)
        assert where_from[1] == (source.address if source else sender.socket.getsockname())[1]
        assert (where_from == listener.address) == (source is listener)


def test_without_ipv6_it_sends_from_another_port_and_says_so(
    stack: ExitStack, make: Make, board: socket.socket, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Old(socket.socket):
        def __init__(self, family: int = socket.AF_INET, *others: int, **more: int) -> None:
            if family == socket.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
            super().__init__(family, *others, **more)

    monkeypatch.setattr(socket, "socket", Old)
    with capture_logs() as logged:
        sender = stack.enter_context(
            closing(make(endpoint("board", Address(*board.getsockname())), listener, [listener]))
        )
    sender.send(b"drive")
    assert board.recvfrom(100) == (b"drive", ("127.0.0.1", sender.socket.getsockname()[1]))
    assert [(each["log_level"], each["listener"]) for each in logged] == [("warning", "rover")]


def fill(sender: Sending) -> int:
    """Send until the buffer is full. Return how many datagrams it has taken."""
    for number in range(1000):
        try:
            sender.send(b"command %d" % number)
        except BlockingIOError:
            return number
    pytest.fail("the buffer has room for everything")


def test_of_commands_to_a_board_that_is_gone_few_are_kept_and_every_brake_is_sent(stack: ExitStack, make: Make) -> None:
    """The kernel keeps what it cannot send before it knows the receiver's hardware address."""
    rover, lan = stack.enter_context(computers("rover", "lan"))
    cable(rover, "lan0", "10.78.1.1/24", lan, "eth0", "10.78.1.2/24")
    board = stack.enter_context(lan.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(("10.78.1.2", 9000))
    board.settimeout(PATIENCE)
    rover.run("sysctl", "-qw", "net.ipv4.neigh.lan0.mcast_solicit=60")  # it keeps asking, however slow this test is
    lan.ip("link", "set", "eth0", "down")
    settings = replace(endpoint("board", Address("10.78.1.2", 9000)), kind=EndpointKind.BOARD)
    sender = stack.enter_context(closing(rover.inside(lambda: make(settings))))
    kept = fill(sender)
    assert 16 <= kept <= 24
    for _ in range(20):
        assert sender.send_checked(b"brake") == 5
        with pytest.raises(BlockingIOError):
            sender.send(b"command too many")
    lan.ip("link", "set", "eth0", "up")
    arrived = [board.recv(100) for _ in range(kept + 20)]
    assert arrived == [b"command %d" % number for number in range(kept)] + 20 * [b"brake"]
    assert sender.send(b"command") == 7


def test_a_burst_of_commands_to_a_board_passes(stack: ExitStack, make: Make, board: socket.socket) -> None:
    settings = replace(endpoint("board", Address(*board.getsockname())), kind=EndpointKind.BOARD)
    sender = stack.enter_context(closing(make(settings)))
    commands = [b"command %d" % number for number in range(64)]
    for command in commands:
        sender.send(command)
    assert [board.recv(100) for _ in commands] == commands


def test_it_gets_over_the_loss_of_its_address_and_of_the_network(stack: ExitStack, make: Make) -> None:
    rover, station = stack.enter_context(computers("rover", "station"))
    cable(rover, "lan", "10.78.1.1/24", station, "lan", "10.78.1.2/24")
    address = Address("10.78.1.2", 9000)
    board = stack.enter_context(station.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(address)
    board.settimeout(10)
    listener = stack.enter_context(closing(rover.inside(lambda: Listener(plan(host="10.78.1.1", port=5000)))))
    sender = stack.enter_context(closing(rover.inside(lambda: make(endpoint("board", address), listener, [listener]))))

    def source_of(data: bytes) -> tuple[str, int]:
        sender.send(data)
        received, where_from = board.recvfrom(100)
        assert received == data
        return Address(*where_from)

    assert source_of(b"first") == ("10.78.1.1", 5000)
    rover.ip("address", "del", "10.78.1.1/24", "dev", "lan")
    with pytest.raises(OSError, match="unreachable"):
        sender.send(b"lost")
    rover.ip("address", "add", "10.78.1.3/24", "dev", "lan")
    assert source_of(b"from another address") == ("10.78.1.3", 5000)
    rover.ip("address", "add", "10.78.1.1/24", "dev", "lan")
    assert source_of(b"from its own again") == ("10.78.1.1", 5000)


def test_nothing_is_sent_after_the_end(make: Make, board: socket.socket) -> None:
    sender = make(endpoint("board", Address(*board.getsockname())))
    send = sender.send
    sender.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM):  # which usually gets the closed one's descriptor
        for _ in range(2):
            with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
                send(b"to whom?")
    board.setblocking(False)
    with pytest.raises(BlockingIOError):
        board.recv(100)
