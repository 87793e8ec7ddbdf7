"""A head start: loads the image of an earlier start before most of the router is imported.

`begin` finds the image of this command line, opens its sockets, has its deadmen send, and starts the threads that
forward and brake. It is the first image that the router adopts; the compiled one replaces it as at a reload
(`app/runtime.py`). This module imports only small ones.
"""

from __future__ import annotations

import signal
from contextlib import ExitStack

from router.carrier.forwarding import FIRST_GENERATION, Forwarding
from router.carrier.sender import NativeSender
from router.clock import boottime_ns
from router.library import library
from router.net.sockets import ListeningSocket, open_sending, placed
from router.startup_image import store

TYPE_CHECKING = False
if TYPE_CHECKING:
    from router.image.image import Image
    from router.inputs import Plain


class HeadStart:
    """A running image, which was compiled from `inputs`.

    `listening` are its listeners by name. `senders` are by endpoint, each with what it depends on: the address,
    whether it is a board, and its cast. `sent` has the endpoints that deadmen have sent to, by route.
    """

    def __init__(self, image: Image, inputs: Plain) -> None:
        """Open and start everything. Raises OSError or MemoryError, with nothing left open."""
        self.inputs = inputs
        self.listening: dict[str, ListeningSocket] = {}
        self.senders: dict[str, tuple[object, NativeSender]] = {}
        self.sent: dict[str, list[str]] = {}
        self.forwarding = Forwarding(library(), image.counters, image.names)
        with ExitStack() as undo:
            undo.callback(self._close_sockets)
            undo.callback(self.forwarding.threads.close)
            self._open_sockets(image)
            senders = {name: sender for name, (_, sender) in self.senders.items()}
            self.image = self.forwarding.load(image, senders, FIRST_GENERATION)
            self.image.bind_listeners(self.listening)
            undo.callback(self.forwarding.deadmen.end)
            self.forwarding.mirror(image.mirror_lost)
            for route, deadman in self.image.deadmen.items():
                self.sent[route] = deadman.start(boottime_ns())
            self.forwarding.threads.start(self.image.change(), self.image)
            undo.pop_all()

    def close(self) -> None:
        """Stop as the router does: handle what has arrived, and have armed deadmen send."""
        for each in self.listening.values():
            each.end_input()
        self.forwarding.threads.stop_receiving()
        self.forwarding.deadmen.end()
        self.image.stop_links()
        self.forwarding.threads.close()
        self._close_sockets()

    def _open_sockets(self, image: Image) -> None:
        for name, address, interface, receive_buffer, groups in image.listeners:
            try:
                self.listening[name] = ListeningSocket(address, interface, receive_buffer, groups)
            except OSError as error:
                raise OSError(error.errno, f"listener '{name}' cannot be opened: {error.strerror}") from error
        every = [*self.listening.values()]
        for name, address, is_board, cast, listener in image.senders:
            source = placed(self.listening.get(listener) if listener is not None else None, every)
            try:
                opened = open_sending(source, every, is_board=is_board, host=address[0])
            except OSError:  # as in `net.udp.open_sending`, which logs it later
                source, opened = None, open_sending(None, is_board=is_board, host=address[0])
            sender = NativeSender(library(), address, opened, source, cast)
            self.senders[name] = (address, is_board, cast), sender

    def _close_sockets(self) -> None:
        for _, sender in self.senders.values():
            sender.close()
        for each in self.listening.values():
            each.socket.close()


class HeadStartAttempt:
    """The result of the search for an image: a head start, or why there is none ("" if no image is stored)."""

    def __init__(self, head_start: HeadStart | None = None, why: str = "") -> None:
        self.head_start = head_start
        self.why = why

    def pass_on(self) -> None:
        """Leave it to the router to close the head start."""
        self.head_start = None

    def close(self) -> None:
        """Close the head start unless it was passed on."""
        if self.head_start is not None:
            self.head_start.close()
            self.head_start = None


ATTEMPTS: list[HeadStartAttempt] = []
"""The result of `begin`, which runs at most once per process."""


def begin() -> HeadStartAttempt:
    """Start with the image of this command line, with SIGINT and SIGTERM blocked until the router handles them."""
    ATTEMPTS.append(_attempt())
    return ATTEMPTS[0]


def _attempt() -> HeadStartAttempt:
    stored, why = store.find()
    if stored is None or (why := store.count_try()):
        return HeadStartAttempt(None, why)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        return HeadStartAttempt(HeadStart(stored.image, stored.inputs))
    except Exception as error:  # noqa: BLE001 - after any error, the router starts without it and logs why
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        listener = error.strerror if isinstance(error, OSError) else ""
        return HeadStartAttempt(None, listener or f"{type(error).__name__}: {error}")
