"""The carrier's senders account for every datagram as those of Python do, and get over changes of the network."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.carrier.sender import NativeSender
from router.net.udp import Sender
from router.table import model
from router.table.addresses import Address
from tests.namespaces import cable, computers
from tests.net.test_udp import endpoint

LONG_AGO, IN_THE_FUTURE = -(1 << 62), 1 << 62


Make = Callable[[model.Endpoint], NativeSender]


@pytest.fixture(scope="session")
def native(library: ctypes.CDLL) -> Make:
    return partial(NativeSender, library)


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
def sender(stack: ExitStack, native: Make, board: socket.socket) -> NativeSender:
    """It sends to the board."""
    return stack.enter_context(closing(native(endpoint("board", Address(*board.getsockname())))))


class Link:
    """A sender, and a board that comes and goes."""

    def __init__(self, stack: ExitStack, make: Callable[[model.Endpoint], Sender]) -> None:
        self._boards = stack
        board = self._bound(("127.0.0.1", 0))
        self._address: tuple[str, int] = board.getsockname()
        self._sender = stack.enter_context(closing(make(endpoint("board", Address(*self._address)))))
        self._board: socket.socket | None = board

    def _bound(self, address: tuple[str, int]) -> socket.socket:
        board = self._boards.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        board.bind(address)
        board.setblocking(False)
        return board

    def step(self, what: str) -> object:
        """Do something; return what can be seen of it."""
        if what == "toggle":
            if self._board is not None:
                self._board.close()
                self._board = None
            else:
                self._board = self._bound(self._address)
            return None
        data = bytes(70000) if what == "send too much" else what.encode()
        send = self._sender.send_checked if what == "send checked" else self._sender.send
        try:
            outcome: object = send(data)
        except OSError as error:
            outcome = error.errno
        return outcome, self._received()

    def _received(self) -> list[bytes]:
        received = []
        with suppress(BlockingIOError):
            while self._board is not None:
                received.append(self._board.recv(100))
        return received


@given(steps=st.lists(st.sampled_from(["send", "send", "send checked", "send too much", "toggle"]), max_size=30))
def test_it_sends_and_fails_as_python_does(native: Make, steps: list[str]) -> None:
    with ExitStack() as stack:
        links = [Link(stack, make) for make in (Sender, native)]
        for step in steps:
            python, carrier = [link.step(step) for link in links]
            assert carrier == python


def test_a_full_buffer_is_an_error_and_nobody_waits(stack: ExitStack, sender: NativeSender) -> None:
    blocking, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    stack.enter_context(blocking)
    stack.enter_context(other)
    os.dup2(blocking.fileno(), sender.socket.fileno())
    sent = 0
    with suppress(BlockingIOError):
        while True:
            sent += sender.send(b"x")
    other.setblocking(False)
    assert [other.recv(10) for _ in range(sent)] == sent * [b"x"]
    assert sender.send(b"again") == 5


def disconnect(sender: Sender) -> None:
    """Have it in the state of one that found no network when it was opened."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unconnected:
        os.dup2(unconnected.fileno(), sender.socket.fileno())


def test_it_connects_again_to_the_same_descriptor(sender: NativeSender, board: socket.socket) -> None:
    number = sender.socket.fileno()
    disconnect(sender)
    assert sender.send(b"drive") == 5
    assert board.recv(100) == b"drive"
    assert sender.socket.fileno() == number
    assert not os.get_inheritable(number)
    assert not os.get_blocking(number)


def test_it_connects_again_only_now_and_then(sender: NativeSender, board: socket.socket, seams: ctypes.CDLL) -> None:
    disconnect(sender)
    seams.seam_set_reconnected(sender.address, IN_THE_FUTURE)
    for _ in range(3):
        with pytest.raises(OSError, match=os.strerror(errno.EDESTADDRREQ)):
            sender.send(b"lost")
    seams.seam_set_reconnected(sender.address, LONG_AGO)
    assert sender.send(b"drive") == 5
    assert board.recv(100) == b"drive"


def test_it_gets_over_the_loss_of_its_address_and_of_the_network(
    stack: ExitStack, native: Make, seams: ctypes.CDLL
) -> None:
    rover, station = stack.enter_context(computers("rover", "station"))
    address = Address("10.78.1.2", 9000)
    unconnected = rover.inside(lambda: native(endpoint("board", address)))  # no network leads there yet
    sender = stack.enter_context(closing(unconnected))

    def send(data: bytes) -> int | None:
        """From within: what replaces the socket is opened where the sender is. Return an errno, or None."""
        seams.seam_set_reconnected(sender.address, LONG_AGO)

        def attempt() -> int | None:
            try:
                sender.send(data)
            except OSError as error:
                return error.errno
            return None

        return rover.inside(attempt)

    assert send(b"too early") == errno.ENETUNREACH
    cable(rover, "lan", "10.78.1.1/24", station, "lan", "10.78.1.2/24")
    board = stack.enter_context(station.inside(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
    board.bind(address)
    board.settimeout(10)
    assert send(b"first") is None
    assert board.recv(100) == b"first"
    rover.ip("address", "del", "10.78.1.1/24", "dev", "lan")
    assert send(b"lost") == errno.ENETUNREACH
    rover.ip("address", "add", "10.78.1.3/24", "dev", "lan")
    assert send(b"second") is None
    assert board.recvfrom(100) == (b"second", ("10.78.1.3", sender.socket.getsockname()[1]))


def test_nothing_is_sent_after_the_end(native: Make, board: socket.socket) -> None:
    sender = native(endpoint("board", Address(*board.getsockname())))
    send = sender.send
    sender.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:  # which usually gets the closed one's descriptor
        other.connect(board.getsockname())
        del sender
        gc.collect()
        for _ in range(2):
            with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
                send(b"to whom?")
    board.setblocking(False)
    with pytest.raises(BlockingIOError):
        board.recv(100)
