"""A program whose topics the carrier publishes, between sockets and a simulated middleware."""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable
from contextlib import ExitStack
from ctypes import c_int64, c_void_p
from struct import Struct
from time import monotonic, sleep
from types import SimpleNamespace
from typing import Any, cast

from router.carrier.deadmen import Deadmen
from router.carrier.forwarding_threads import ForwardingThreads
from router.carrier.loading import LoadedImage
from router.carrier.publishing import PublishThread
from router.carrier.ring import Ring
from router.compiler.compiled_table import CompiledTable
from router.declared import Demand, Wanted
from router.image.names import Names
from router.image.writer import write_image
from tests.small_tables import Ledger

MOST_COUNTERS = 1 << 12
_LOST = Struct("@IIIIIIiIIIII3q")
_CALLED = "middleware_publish", "middleware_error", "middleware_forget_error"


class Publisher:
    """Stands in for `ros.endpoints.Publication`."""

    def __init__(self, functions: ctypes.CDLL) -> None:
        self._functions = functions
        self.address: int = functions.middleware_advertise()
        self.demand = Demand(wanted=Wanted.EVERY_MESSAGE)

    def impede(self, *, is_stuck: bool = False, delay_us: int = 0, refusal: str = "") -> None:
        """Make publishing block, take this long, or fail; without arguments, make it succeed at once."""
        self._functions.middleware_impede(self.address, is_stuck, delay_us, refusal.encode())

    def await_receipt(self, timeout: float) -> bool:
        """Nothing is on its way: subscribers are part of the publisher."""
        return timeout >= 0

    @property
    def is_called(self) -> bool:
        """Whether a thread is inside the middleware."""
        return bool(self._functions.middleware_callers(self.address))

    @property
    def count(self) -> int:
        """The number of published messages."""
        return int(self._functions.middleware_count(self.address))

    def published(self) -> list[bytes]:
        found = [self._functions.middleware_message(self.address, index).contents for index in range(self.count)]
        return [ctypes.string_at(each.buffer, each.length) for each in found]


class Publishing:
    """The threads `receive` and `publish`. All targets of `program` are topics.

    `queue` is the size of the ring in bytes.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        functions: ctypes.CDLL,
        program: CompiledTable,
        stack: ExitStack,
        queue: int = 1 << 16,
    ) -> None:
        self.program = program
        self._library = library
        self._received, self._published, self._braked = ((c_int64 * MOST_COUNTERS)() for _ in range(3))
        self._names = Names()
        self._events, self._ring = Ring(library, 1 << 16), Ring(library, queue)
        self.publishers = {plan.label: Publisher(functions) for plan in program.publishers}
        self._deadmen = Deadmen(library, self._braked, Ring(library, 1 << 12))
        self._sockets = {plan.name: stack.enter_context(_bound()) for plan in program.listeners}
        self._peer = stack.enter_context(_bound())
        self._carrier = ForwardingThreads(
            library, self._deadmen.address, self._received, Ring(library, 1 << 16), self._ring
        )
        self._programs = [self._made(program, 1)]  # all of them, because an abandoned thread may use any
        addresses = tuple(ctypes.cast(getattr(functions, name), c_void_p).value or 0 for name in _CALLED)
        self.thread = PublishThread(library, self._ring, self._published, self._events, self._names)
        self.thread.start(cast("Any", addresses))
        stack.callback(self._close)
        self._change_topics()
        self._carrier.start(self._programs[0].change())
        self.sent = 0

    def send(self, *datagrams: bytes, listener: str = "exact") -> None:
        """Make the carrier receive datagrams. Returns when they are queued for the thread or dropped."""
        for datagram in datagrams:
            self._peer.sendto(datagram, self._sockets[listener].getsockname())
            self.sent += 1
            wait_until(lambda: self.ledger().total("datagrams_received") == self.sent)

    def change(self, generation: int, program: CompiledTable | None = None) -> None:
        """Receive with another program from now on; the publish thread follows."""
        self._programs.append(self._made(program or self.program, generation))
        self._change_topics()
        self._carrier.change(self._programs[-1].change(self._programs[-2]))
        self.thread.advance(generation)

    def _change_topics(self) -> None:
        before = self._programs[-2] if len(self._programs) > 1 else None
        self.thread.change(self._programs[-1].topic_change(before))

    def publish_due(self) -> None:
        """Have the thread publish the newest messages that are due."""
        self._ring.wake()

    def stop_receiving(self) -> None:
        self._carrier.stop_receiving()

    def _close(self) -> None:
        self._carrier.close()
        for publisher in self.publishers.values():
            publisher.impede()
        self.thread.stop()

    def ledger(self) -> Ledger:
        """The counts of both threads, those of the consumer read first."""
        size = self.program.counters.size
        published, received = self.thread.counters(size), self._carrier.counters(size)
        return Ledger(self.program, [mine + other for mine, other in zip(published, received, strict=True)])

    def count(self, metric: str, *labels: str) -> int:
        return self.ledger().total(metric, *labels)

    def wait_for(self, metric: str, count: int) -> None:
        wait_until(lambda: self.count(metric) == count)

    def losses(self) -> list[tuple[str, str, int, str]]:
        """The route, target, reason and text of each loss that the thread has reported since the last call."""
        records, found, at = bytes(self._events.take()), [], 0
        while at < len(records):
            size, _, route, _, target, reason, *_ = _LOST.unpack_from(records, at)
            text = records[at + _LOST.size : at + size].partition(b"\0")[0].decode()
            found.append((self._names.name(route), self._names.name(target), reason, text))
            at += size
        return found

    def stalled(self) -> tuple[str, float] | None:
        """The topic whose publisher blocks the thread, and for how many seconds; else None."""
        return self.thread.stalled()

    def _made(self, program: CompiledTable, generation: int) -> LoadedImage:
        before = self._programs[-1] if generation > 1 else None
        image = write_image(program, self._names)
        loaded = LoadedImage(self._library, image, {}, self._deadmen.address, generation, before)
        loaded.bind_topics(self.publishers)
        loaded.bind_listeners(
            {name: SimpleNamespace(socket=each, is_inherited=False) for name, each in self._sockets.items()}
        )
        return loaded


def wait_until(condition: Callable[[], object]) -> None:
    deadline = monotonic() + 20
    while not condition():
        assert monotonic() < deadline, "it never happened"
        sleep(0.001)


def _bound() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    return made
