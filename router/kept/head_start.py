"""A head start: executes a kept program before most of the router is imported.

`begin` finds the kept program of this command line, opens its sockets, has its deadmen send, and starts the threads
that forward and brake. The router adopts them (`app/router.py`) if the program that it has compiled meanwhile is the
same. This module imports only small ones.
"""

from __future__ import annotations

import ctypes
import signal
from contextlib import ExitStack

from router import declared as c
from router.carrier.deadmen import datagrams_of
from router.carrier.deferrals import Adoption, timer_change
from router.carrier.forwarding import KEPT_GENERATION, Forwarding
from router.carrier.sender import NativeSender
from router.carrier.state import open_native
from router.clock import boottime_ns
from router.kept import store
from router.library import library
from router.net.sockets import ListeningSocket, open_sending, placed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping
    from mmap import mmap
    from typing import Any

    from router.inputs import Plain

_WORD = 8


class HeadStart:
    """A running kept program, which was compiled from `inputs`.

    `listening` and `senders` are by name; `opened` has addresses by place, as in `State.get_or_open`; `sent` has the
    endpoints that deadmen have sent to, by route.
    """

    def __init__(self, kept: store.Kept) -> None:
        """Open and start everything. Raises OSError or MemoryError, with nothing left open."""
        self.inputs: Plain = kept.inputs
        self.library = library()
        self.listening: dict[str, ListeningSocket] = {}
        self.senders: dict[str, NativeSender] = {}
        self.opened: dict[tuple[str | None, ...], int] = {}
        self.sent: dict[str, list[str]] = {}
        parts: Mapping[str, Any] = kept.parts  # type: ignore[assignment]  # as carrier/image.py makes them
        self._kept: tuple[object, bytes] | None = (kept.parts, bytes(kept.image))
        self.forwarding = Forwarding(self.library, parts["counters"], parts["names"])
        with ExitStack() as undo:
            undo.callback(self._close_sockets)
            undo.callback(self.forwarding.carrier.close)
            self._open_sockets(parts)
            self._open_objects(parts)
            self._image = _Image(kept.image, parts, self._symbols(parts))
            self.topics = c.PublishChange(timers=self._timers(parts, of_topics=True), generation=KEPT_GENERATION)
            self._change = c.Change(program=self._image.at(c.Program, parts["program"]))
            self._change.timers = self._timers(parts, of_topics=False)
            undo.callback(self.forwarding.deadmen.end)
            self.forwarding.mirror(parts["mirror_lost"])
            self._start_deadmen(parts)
            self._fill_listeners(parts)
            self.forwarding.carrier.start(self._change, self._image)
            undo.pop_all()

    def close(self) -> None:
        """Stop as the router does: handle what has arrived, and have armed deadmen send."""
        for each in self.listening.values():
            each.end_input()
        self.forwarding.carrier.stop_receiving()
        self.forwarding.deadmen.end()
        self.forwarding.carrier.close()
        self._close_sockets()

    def matches(self, parts: object, image: bytes) -> bool:
        """Return whether the kept program has these parts and this image. Call it only once."""
        kept, self._kept = self._kept, None
        return kept == (parts, image)

    def bind_topic(self, topic: str, publisher: int) -> None:
        """Set the publisher of a topic, before the publish thread runs."""
        self._image.set(("publisher", topic), publisher)

    def _open_sockets(self, parts: Mapping[str, Any]) -> None:
        for name, address, interface, receive_buffer in parts["listeners"]:
            try:
                self.listening[name] = ListeningSocket(address, interface, receive_buffer)
            except OSError as error:
                raise OSError(error.errno, f"listener '{name}' cannot be opened: {error.strerror}") from error
        every = [*self.listening.values()]
        for name, address, is_board, source_name in parts["senders"]:
            source = placed(self.listening.get(source_name), every)
            try:
                to_send = open_sending(source, every, is_board=is_board)
            except OSError:  # as in `net.udp.open_sending`, which logs it later
                source, to_send = None, open_sending(None, is_board=is_board)
            self.senders[name] = NativeSender(self.library, address, to_send, source)

    def _open_objects(self, parts: Mapping[str, Any]) -> None:
        """Open limits, pacers, deferrals, collectors and deadmen in this order: each refers to earlier ones."""
        for place, function, arguments in parts["openings"]:
            plain = [self._argument(each, parts) for each in arguments]
            self.opened[tuple(place)] = open_native(self.library, function, *plain)

    def _argument(self, argument: object, parts: Mapping[str, Any]) -> object:
        """Decode an argument from the form that `image._plain` gives it."""
        if isinstance(argument, tuple):
            return self._address(parts["symbols"][argument[0]], parts)
        if not isinstance(argument, list):
            return argument
        made = (c.DeadmanDestination * len(argument))()
        for to, (sender, datagrams, sent, send_errors, number, follows, is_heard, last_seen, *obeyed) in zip(
            made, argument, strict=True
        ):
            to.sender, to.datagrams, to.count = self._argument(sender, parts), datagrams_of(datagrams), len(datagrams)
            to.sent, to.send_errors, to.id, to.follows = sent, send_errors, number, follows
            to.is_heard, to.last_seen = is_heard, last_seen
            to.within, to.disobeyed, to.stopping = obeyed
        return made

    def _symbols(self, parts: Mapping[str, Any]) -> list[tuple[tuple[str | None, ...], int]]:
        return [(name, self._address(name, parts)) for name in parts["symbols"]]

    def _address(self, symbol: tuple[str | None, ...], parts: Mapping[str, Any]) -> int:
        kind, name = symbol[0], symbol[1] if len(symbol) > 1 else None
        if kind == "sender":
            return self.senders[str(name)].address
        if kind == "opened":
            return self.opened[symbol[1:]]
        if kind == "deadmen":
            return self.forwarding.deadmen.address
        if kind == "wanted":
            return ctypes.addressof(_WANTED if name in parts["always_wanted"] else _UNWANTED)
        return 0  # a publisher: see `bind_topic`

    def _timers(self, parts: Mapping[str, Any], *, of_topics: bool) -> c.TimerChange:
        symbols, base = parts["symbols"], self._image.base
        return timer_change(
            [
                Adoption(
                    self._address(symbols[timer], parts),
                    is_topic,
                    None if targets is None else base + targets,
                    None if target is None else base + target,
                )
                for timer, is_topic, targets, target in parts["adopted"]
                if is_topic is of_topics
            ]
        )

    def _start_deadmen(self, parts: Mapping[str, Any]) -> None:
        for route, endpoints in parts["deadmen"]:
            address = self.opened["deadman", route]
            reached = self.library.deadman_start(self.forwarding.deadmen.address, address, boottime_ns())
            self.sent[route] = [endpoint for bit, endpoint in enumerate(endpoints) if reached >> bit & 1]

    def _fill_listeners(self, parts: Mapping[str, Any]) -> None:
        if not self.listening:
            return
        listeners = self._image.array(c.Listener, parts["listener_array"], len(self.listening))
        for structure, each in zip(listeners, self.listening.values(), strict=True):
            structure.fd, structure.keeps_input = each.socket.fileno(), each.is_inherited

    def _close_sockets(self) -> None:
        for sender in self.senders.values():
            sender.close()
        for each in self.listening.values():
            each.socket.close()


_WANTED, _UNWANTED = (ctypes.c_uint8 * 1)(1), (ctypes.c_uint8 * 1)(0)
"""The byte `wanted`. Topics that serve late joiners get their messages later; others have no known subscriber yet."""


class _Image:
    """The image of a program in memory, at `base`."""

    def __init__(
        self, memory: mmap, parts: Mapping[str, Any], symbols: list[tuple[tuple[str | None, ...], int]]
    ) -> None:
        self.base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
        self._memory = memory
        self._words = memoryview(memory).cast("B")[: len(memory) // _WORD * _WORD].cast("Q")
        self._places: dict[tuple[str | None, ...], list[int]] = {}
        for word in parts["relocations"]:
            self._words[word] += self.base
        for word, number in parts["imports"]:
            name, address = symbols[number]
            self._words[word] = address
            self._places.setdefault(name, []).append(word)

    def at(self, kind: Any, offset: int) -> Any:
        """Return a pointer to a structure."""
        return ctypes.pointer(kind.from_address(self.base + offset))

    def array(self, kind: Any, offset: int, count: int) -> Any:
        return (kind * count).from_address(self.base + offset)

    def set(self, symbol: tuple[str | None, ...], address: int) -> None:
        """Give a symbol another address."""
        for word in self._places.get(symbol, ()):
            self._words[word] = address


class HeadStartAttempt:
    """The result of the search for a kept program: a head start, or why there is none ("" if nothing is kept)."""

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
    """Start the kept program of this command line, with SIGINT and SIGTERM blocked until the router handles them."""
    ATTEMPTS.append(_attempt())
    return ATTEMPTS[0]


def _attempt() -> HeadStartAttempt:
    kept, why = store.find()
    if kept is None or (why := store.count_try()):
        return HeadStartAttempt(None, why)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        return HeadStartAttempt(HeadStart(kept))
    except Exception as error:  # noqa: BLE001 - after any error, the router starts without it and logs why
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        listener = error.strerror if isinstance(error, OSError) else ""
        return HeadStartAttempt(None, listener or f"{type(error).__name__}: {error}")
