"""A program whose messages from ROS the carrier serves, between a simulated middleware and in-memory sockets."""

from __future__ import annotations

import ctypes
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from ctypes import POINTER, c_bool, c_char_p, c_int, c_int64, c_size_t, c_uint, c_void_p
from dataclasses import replace
from pathlib import Path
from struct import Struct
from typing import Any

from router.carrier.build import NATIVE, compile_c
from router.carrier.deadmen import Deadmen
from router.carrier.from_ros import FromRosThread
from router.carrier.loading import LoadedImage
from router.carrier.ring import Ring
from router.carrier.ros_routes import RosRoutes
from router.compiler.compiled_table import CompiledTable
from router.image.names import Names
from router.image.writer import write_image
from tests.small_tables import Ledger

MOST_COUNTERS = 1 << 16
_LOST = Struct("@IIIIIIiIIIII3q")


class Serialized(ctypes.Structure):
    """The beginning of `struct serialized_message`."""

    _fields_ = (("buffer", c_void_p), ("length", c_size_t))


_MIDDLEWARE: Mapping[str, tuple[Any, tuple[type, ...]]] = {
    "middleware_advertise": (c_void_p, ()),
    "middleware_callers": (c_int, (c_void_p,)),
    "middleware_count": (c_size_t, (c_void_p,)),
    "middleware_impede": (None, (c_void_p, c_bool, c_uint, c_char_p)),
    "middleware_message": (POINTER(Serialized), (c_void_p, c_size_t)),
    "middleware_open": (c_void_p, ()),
    "middleware_put": (None, (c_void_p, c_void_p, c_size_t, c_int64, c_int64)),
    "middleware_set": (None, (c_void_p, c_bool, c_bool)),
    "middleware_take": (c_int, (c_void_p, c_void_p, c_void_p, c_void_p)),
    "middleware_takers": (c_int, (c_void_p,)),
}


def middleware(output: Path) -> ctypes.CDLL:
    """The functions of middleware.c, compiled to the library `output`."""
    source = Path(__file__).with_name("middleware.c")
    compile_c(["-shared", "-fPIC", str(source), f"-I{NATIVE}", "-o", str(output)])
    loaded = ctypes.CDLL(str(output))
    for name, (returned, taken) in _MIDDLEWARE.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = returned, taken
    return loaded


class Subscription:
    """Stands in for `ros.receiving.RawSubscription`."""

    capacity = 1000

    def __init__(self, functions: ctypes.CDLL) -> None:
        self._functions = functions
        self.address: int = functions.middleware_open()
        self._eventfd: int | None = None

    def announce_to(self, eventfd: int | None) -> None:
        self._eventfd = eventfd

    def put(self, message: bytes, sent: int, received: int = 0) -> None:
        self._functions.middleware_put(self.address, message, len(message), sent, received)
        if self._eventfd is not None:
            os.eventfd_write(self._eventfd, 1)

    def set(self, *, is_stuck: bool = False, refuses: bool = False) -> None:
        self._functions.middleware_set(self.address, is_stuck, refuses)

    @property
    def is_taken_from(self) -> bool:
        """Whether the thread is inside the middleware."""
        return bool(self._functions.middleware_takers(self.address))

    def take_all(self) -> Sequence[object]:
        taken = []
        while not self._functions.middleware_take(self.address, None, None, None):
            taken.append(object())
        return taken


class Board:
    """Records the datagrams for an endpoint. `address` is the address of a `struct sender`."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._near.setblocking(False)
        self._far.setblocking(False)
        self.address: int = library.sender_open(self._near.fileno(), -1, 1, 1)

    def break_down(self) -> None:
        """Make sending fail from now on."""
        broken = os.open(os.devnull, os.O_WRONLY)
        os.dup2(broken, self._near.fileno(), inheritable=False)
        os.close(broken)

    def received(self) -> list[bytes]:
        """Return the datagrams received since the last call."""
        return list(self._take())

    def _take(self) -> Iterator[bytes]:
        with suppress(BlockingIOError):
            while True:
                yield self._far.recv(1 << 16)

    def close(self) -> None:
        self._near.close()
        self._far.close()


class ServingRos:
    """The thread for messages from ROS. It starts to serve at `serve`."""

    def __init__(self, library: ctypes.CDLL, functions: ctypes.CDLL, program: CompiledTable, stack: ExitStack) -> None:
        self.program = program
        self.library = library
        self.counters = (c_int64 * MOST_COUNTERS)()
        self._braked = (c_int64 * MOST_COUNTERS)()
        self.names = Names()
        self.events = Ring(library, 1 << 16)
        self.boards = {endpoint.name: Board(library) for endpoint in program.senders}
        for board in self.boards.values():
            stack.callback(board.close)
        self.deadmen = Deadmen(library, self._braked, Ring(library, 1 << 12))
        image = LoadedImage(library, write_image(program, self.names), self.boards, self.deadmen.address, 1)
        self.by_route = image.deadmen
        self.messages = RosRoutes.of(image)
        library.timers_change(self.deadmen.address, ctypes.byref(image.timers(of_topics=False)))
        self.subscriptions = {topic: Subscription(functions) for topic in self.messages.topics}
        take, reset = (ctypes.cast(getattr(functions, name), c_void_p).value for name in _CALLED)
        assert take
        assert reset
        self.thread = FromRosThread(library, self.deadmen.address, self.counters, self.events)
        self.thread.start(take, reset)
        stack.callback(self.thread.stop)

    def serve(self, subscriptions: Mapping[str, Subscription] | None = None) -> None:
        self.thread.serve(replace(self.messages, subscriptions=subscriptions or self.subscriptions))

    def ledger(self) -> Ledger:
        size = max(index for _, index in self.program.counters.series()) + 1
        return Ledger(self.program, list(self.thread.counters(size)))

    def count(self, metric: str, *labels: str) -> int:
        return self.thread.counters(MOST_COUNTERS)[self.program.counters.index(metric, *labels)]

    def losses(self) -> list[tuple[str, str, int, int]]:
        """The route, target, reason and errno of each event since the last call."""
        return [(self.names.name(each[2]), self.names.name(each[4]), each[5], each[6]) for each in self._events()]

    def refusals(self) -> list[tuple[str, str, int, str, int]]:
        """The route, target, reason, topic and place in the program of each event since the last call."""
        name = self.names.name
        return [(name(each[2]), name(each[4]), each[5], name(each[3]), each[9]) for each in self._events()]

    def _events(self) -> Iterator[tuple[int, ...]]:
        """Each `struct lost_event` since the last call."""
        records, at = bytes(self.events.take()), 0
        while at < len(records):
            yield _LOST.unpack_from(records, at)
            at += _LOST.unpack_from(records, at)[0]


_CALLED = "middleware_take", "middleware_reset"
