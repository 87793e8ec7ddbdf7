"""All boards and the basestation of a route table on one machine, over real UDP.

Each endpoint binds its own address, sends what the table names it as the source of, and counts what comes
back. Who looks at that is not known here (see `sim_view`).
"""

from __future__ import annotations

import heapq
import random
import selectors
import socket
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from google.protobuf.message import Message

from router.errors import DecodeError, did_you_mean
from router.table.model import ANY, Address, Endpoint, RouteTable
from router.tools import UsageError
from router.tools.models import moment, usual_rate
from router.tools.payload_model import PayloadModel
from router.tools.places import LOOPBACK, open_udp, reachable
from router.tools.wire import Wire
from router.types.protobuf import PayloadCase

STRANGER = "(anybody)"
"""Who sends the payload cases that the table takes from any source."""

LARGEST_DATAGRAM = 65_507
DRAIN = 256
"""Datagrams taken from one socket before the others, and the sending, have their turn."""

PATIENCE = 0.2
"""Seconds after which `stop` is noticed at the latest."""

LATE = 1.0
"""Seconds behind schedule after which messages are left out rather than sent in a burst."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One payload case that one endpoint sends, at `rate` Hz, the first after `offset` seconds."""

    endpoint: str
    case: PayloadCase
    rate: float
    offset: float


def streams(wire: Wire, table: RouteTable, seed: int, rate_scale: float) -> Iterator[Stream]:
    """What the table's UDP sources send, in the order of the table. Raises UsageError for an unknown name."""
    for route in table.routes:
        if route.is_outbound:
            continue
        case = wire.case(route.case.value)
        rate = usual_rate(case.name) * rate_scale
        for source in route.sources:
            sender = STRANGER if source.value == ANY else source.value
            if sender != STRANGER and sender not in table.endpoints:
                hint = did_you_mean(sender, table.endpoints)
                raise UsageError(f"{source.span}: there is no endpoint '{sender}'; {hint}")
            offset = random.Random(f"{seed}/{case.name}/{sender}").uniform(0, 1 / rate)
            yield Stream(sender, case, rate, offset)


@dataclass(slots=True)
class Arrivals:
    """What one endpoint received of one payload case."""

    last: Message
    count: int = 0


@dataclass(slots=True)
class Statistics:
    """Counts since the start, by endpoint and payload case.

    `unsent` are datagrams that the kernel refused to take; `undecodable` ones are by endpoint.
    """

    sent: dict[tuple[str, str], int] = field(default_factory=lambda: defaultdict(int))
    unsent: int = 0
    received: dict[tuple[str, str], Arrivals] = field(default_factory=dict)
    undecodable: dict[str, int] = field(default_factory=lambda: defaultdict(int))


class Simulator:
    """Plays the endpoints of a table. Binds every address at once; raises UsageError when one cannot be had."""

    def __init__(self, wire: Wire, table: RouteTable, seed: int, rate_scale: float = 1.0) -> None:
        self.statistics = Statistics()
        self._wire = wire
        self._streams = tuple(streams(wire, table, seed, rate_scale))
        self._models = [PayloadModel(stream.case.name, stream.case.type, seed) for stream in self._streams]
        self._router = reachable(next(iter(table.listeners.values())).address.value)
        self._selector = selectors.DefaultSelector()
        self._opened: list[socket.socket] = []
        self._senders: dict[str, socket.socket] = {}
        self._stopping = False
        try:
            for endpoint in table.endpoints.values():
                self._open_endpoint(endpoint)
            self._senders[STRANGER] = self._open(Address(LOOPBACK, 0), STRANGER)
        except BaseException:
            self.close()
            raise

    @property
    def summary(self) -> str:
        """What is simulated, for people."""
        endpoints, cases = len(self._senders) - 1, len(self._streams)
        rate = sum(stream.rate for stream in self._streams)
        return f"{endpoints} endpoints send {cases} payload cases, {rate:.0f}/s, to {self._router}"

    def _open_endpoint(self, endpoint: Endpoint) -> None:
        """One socket for both ways; a second one to send when the router knows the endpoint by its source port."""
        address = endpoint.address.value
        receiver = sender = self._open(address, endpoint.name)
        if endpoint.source_port is not None and endpoint.source_port.value != address.port:
            sender = self._open(Address(address.host, endpoint.source_port.value), endpoint.name)
        self._selector.register(receiver, selectors.EVENT_READ, (receiver, endpoint.name))
        self._senders[endpoint.name] = sender

    def _open(self, address: Address, owner: str) -> socket.socket:
        opened = open_udp(address, owner)
        self._opened.append(opened)
        return opened

    def close(self) -> None:
        self._selector.close()
        for opened in self._opened:
            opened.close()

    def stop(self) -> None:
        """Makes `run` return soon; safe in a signal handler."""
        self._stopping = True

    def run(self, duration: float | None, every: float, report: Callable[[float], None]) -> float:
        """Send and receive for `duration` seconds, or until stopped. Returns the elapsed seconds.

        `report` is called with them about once in `every` seconds.
        """
        start, epoch = time.monotonic(), time.time()
        due = [(stream.offset, index) for index, stream in enumerate(self._streams)]
        heapq.heapify(due)
        next_report = every
        now = 0.0
        while not self._stopping and (duration is None or now < duration):
            while due and due[0][0] <= now:
                at, index = due[0]
                self._send(index, at, epoch)
                heapq.heapreplace(due, (self._next(at, self._streams[index].rate, now), index))
            if now >= next_report:
                report(now)
                next_report = max(next_report + every, now)
            wake = min(now + PATIENCE, next_report, *(at for at, _ in due[:1]))
            for key, _ in self._selector.select(max(0.0, wake - (time.monotonic() - start))):
                self._receive(*key.data)
            now = time.monotonic() - start
        return now

    def _next(self, at: float, rate: float, now: float) -> float:
        """When the stream is due after `at`; a machine that slept does not make up for it."""
        missed = int((now - at) * rate) if now - at > LATE else 0
        return at + (1 + missed) / rate

    def _send(self, index: int, at: float, epoch: float) -> None:
        stream = self._streams[index]
        message = stream.case.message_class()
        self._models[index].fill(message, moment(at, epoch))
        try:
            self._senders[stream.endpoint].sendto(self._wire.encode(stream.case, message), self._router)
        except OSError:
            self.statistics.unsent += 1
        else:
            self.statistics.sent[stream.endpoint, stream.case.name] += 1

    def _receive(self, receiver: socket.socket, endpoint: str) -> None:
        for _ in range(DRAIN):
            try:
                data = receiver.recv(LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            try:
                decoded = self._wire.decode(data)
            except DecodeError:
                self.statistics.undecodable[endpoint] += 1
            else:
                key = endpoint, decoded.case.name
                arrivals = self.statistics.received.setdefault(key, Arrivals(decoded.message))
                arrivals.count += 1
                arrivals.last = decoded.message
