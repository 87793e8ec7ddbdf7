"""The receive thread: takes datagrams from all listeners and gives each to whoever it is for, until told to stop."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Callable, Mapping, Sequence

from router.edges.udp import Listener

Receive = Callable[[bytes, "tuple[str, int]"], None]


class ReceiveThread:
    """Calls `receive[listener](data, peer)` for each datagram, on one thread of its own.

    `limit` is the longest datagram in bytes that is received whole. A longer one arrives with its true
    length (MSG_TRUNC), its tail being whatever the memory held: the receiver must refuse it by length.
    What `receive` raises goes to `failed`, and receiving goes on.
    """

    def __init__(
        self,
        listeners: Sequence[Listener],
        receive: Mapping[str, Receive],
        limit: int,
        failed: Callable[[Exception], None],
    ) -> None:
        self._listeners = listeners
        self._receive = receive
        self._size = limit + 1
        self._failed = failed
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="receive")

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Lets nothing new in, handles what the kernel already holds, and returns when that is done."""
        for listener in self._listeners:
            listener.end_input()
        self._ended = True
        self._thread.join()

    def _run(self) -> None:
        receive_all = self._from_one if len(self._listeners) == 1 else self._from_many
        while True:
            try:
                return receive_all()
            except Exception as error:  # noqa: BLE001 a fault of the router, told loudly, is no reason to stop receiving
                self._failed(error)

    def _from_one(self) -> None:
        """One system call per datagram: a blocking receive is also the wait."""
        [listener] = self._listeners
        receive, receive_from, size = self._receive[listener.name], listener.socket.recvfrom, self._size
        while True:
            data, peer = receive_from(size, socket.MSG_TRUNC)
            if peer is None:
                return
            receive(data, peer)

    def _from_many(self) -> None:
        """One datagram per listener and turn, so that a flooded listener cannot starve the others."""
        size, flags = self._size, socket.MSG_TRUNC | socket.MSG_DONTWAIT
        with select.epoll() as waiting:
            open_ones = {}
            for listener in self._listeners:
                waiting.register(listener.socket, select.EPOLLIN)
                open_ones[listener.socket.fileno()] = (listener.socket.recvfrom, self._receive[listener.name])
            while open_ones:
                for descriptor, _ in waiting.poll():
                    receive_from, receive = open_ones[descriptor]
                    try:
                        data, peer = receive_from(size, flags)
                    except BlockingIOError:  # what arrived was damaged, or this listener has ended and is drained
                        if self._ended:
                            waiting.unregister(descriptor)
                            del open_ones[descriptor]
                    else:
                        receive(data, peer)
