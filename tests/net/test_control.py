"""The queue of a control socket, which every user of the computer can fill."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from router.net import control
from tests.ports import free_port

HOST = "127.0.0.1"


@pytest.fixture
def port() -> int:
    return free_port(kind=socket.SOCK_STREAM)


@pytest.fixture
def listening(port: int) -> Iterator[socket.socket]:
    """A control socket whose queue is full."""
    with ExitStack() as opened:
        queue = opened.enter_context(closing(control.listen(HOST, port)))
        error = 0
        while error == 0:
            stranger = opened.enter_context(socket.socket(socket.AF_UNIX))
            stranger.setblocking(False)
            error = stranger.connect_ex(queue.getsockname())
        assert error == errno.EAGAIN
        yield queue


def test_the_owner_waits_until_there_is_room(listening: socket.socket, port: int) -> None:
    def accept() -> None:
        listening.accept()[0].close()

    later = threading.Timer(0.2, accept)
    later.start()
    with closing(control.connect(HOST, port, 10)) as connection:
        assert connection.gettimeout() == 10
    later.join()


def test_the_owner_does_not_wait_for_ever(listening: socket.socket, port: int) -> None:
    with pytest.raises(BlockingIOError):
        control.connect(HOST, port, 0.1)


@pytest.mark.parametrize("host", ["::1", "::"])
def test_a_router_at_an_ipv6_address_is_found(host: str) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with closing(control.listen(host, port)):
        control.connect("::1", port, 10).close()
        with pytest.raises(ConnectionRefusedError):
            control.connect("127.0.0.1", port, 10)
        with pytest.raises(OSError, match="assign requested address"):  # another computer's
            control.connect("2001:db8::77", port, 10)
