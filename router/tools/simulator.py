"""All boards and the basestation of a route table on one machine, over real UDP, serial lines and TCP.

Each endpoint binds its own address, sends the payload cases that have it as their source, receives, and replies to the
requests of services. At the other end of a serial line, it is a pty in the place of the line's device; over TCP, it
accepts the router or connects to it.
"""

from __future__ import annotations

import errno
import heapq
import os
import random
import re
import selectors
import socket
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from router.compiler.compiled_table import DeadmanPlan, ServicePlan
from router.compiler.expressions.tree import ENVELOPE, MESSAGE
from router.compiler.network import fitting
from router.compiler.resolution import stand_in
from router.datagrams import Decoded, Wire
from router.errors import UsageError, did_you_mean, listed
from router.hosts import LOOPBACK, LOOPBACK_IPV6, loopback_of
from router.net.addresses import family, socket_address
from router.table.addresses import Address, LinkPlace
from router.table.model import RouteTable
from router.table.model.endpoints import Endpoint, Listener
from router.table.model.routes import ANY
from router.table.units import LARGEST_DATAGRAM
from router.tools import links
from router.tools.board import Change, Inbox, boards
from router.tools.link_end import LinkEnd
from router.tools.payloads import RATES, USUAL_RATE, PayloadModel, Pose, pose
from router.tools.sim_replies import Reply, replies
from router.tools.udp import listener_address, open_udp, place_of
from router.types.model import Int, MessageType
from router.types.paths import type_at
from router.types.protobuf import PayloadCase

STRANGER = "(anybody)"
"""The sender of payload cases that the table takes from any source."""

_SILENCE = re.compile(r"(?P<name>\w+):(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)?")


@dataclass(frozen=True, slots=True)
class Numbered:
    """The integer field that grows from message to message, by path: of the payload, or `is_beside` it."""

    path: tuple[str, ...]
    type: Int
    is_beside: bool

    def set(self, message: Any, number: int) -> None:
        """Set the field of a payload or an envelope. The number wraps around to 0."""
        *way, last = self.path
        for name in way:
            message = getattr(message, name)
        setattr(message, last, number % (self.type.high + 1))


@dataclass(frozen=True, slots=True)
class Stream:
    """One payload case that one endpoint sends, at `rate` Hz, the first after `offset` seconds.

    `numbered` is what `order` of its route compares.
    """

    endpoint: str
    case: PayloadCase
    rate: float
    offset: float
    numbered: Numbered | None = None


@dataclass(frozen=True, slots=True)
class Silence:
    """A time in which an endpoint sends nothing, or a payload case is not sent; seconds since the start."""

    name: str
    start: float
    end: float

    def covers(self, sent: Stream | Reply, at: float) -> bool:
        return self.start <= at < self.end and self.name in (sent.endpoint, sent.case.name)


def parse_silence(text: str) -> Silence:
    """Parse `basestation:5-8`, or `manual_drive:5-` without an end. Raises UsageError for other text."""
    match = _SILENCE.fullmatch(text)
    if match is None:
        raise UsageError(f"'{text}' is not NAME:FROM-TO with seconds, such as basestation:5-8 or basestation:5-")
    silence = Silence(match["name"], float(match["start"]), float(match["end"] or "inf"))
    if silence.end <= silence.start:
        raise UsageError(f"'{text}' ends before it begins")
    return silence


_OBEDIENCE = re.compile(r"(?P<board>\w+):(?P<cases>\w+(,\w+)*)")


def parse_obedience(texts: Iterable[str]) -> dict[str, frozenset[str]]:
    """Parse `driving_board:manual_drive,drive_motor`: boards, and the payload cases that each obeys.

    Raises UsageError for other text.
    """
    obeys: dict[str, frozenset[str]] = {}
    for text in texts:
        match = _OBEDIENCE.fullmatch(text)
        if match is None:
            raise UsageError(f"'{text}' is not NAME:CASE, such as driving_board:manual_drive,drive_motor")
        obeys[match["board"]] = obeys.get(match["board"], frozenset()) | set(match["cases"].split(","))
    return obeys


def check_silences(silences: Collection[Silence], sent: Iterable[Stream | Reply]) -> None:
    """Raise UsageError for a name that is neither a sender nor a payload case that is sent."""
    known = {name for each in sent for name in (each.endpoint, each.case.name)} - {STRANGER}
    for silence in silences:
        if silence.name not in known:
            hint = did_you_mean(silence.name, known)
            raise UsageError(f"no endpoint or payload case that is sent is called '{silence.name}'", hint)


FEEDS = 5
"""Minimum number of commands within the timeout of their deadman."""


def streams(wire: Wire, table: RouteTable, seed: int, speed: float) -> Iterator[Stream]:
    """Yield the streams of the table's UDP sources, in the order of the table. Raises UsageError for unknown names."""
    for route in table.routes:
        if not route.sources:
            continue
        case = wire.case(route.case.value)
        rate = RATES.get(case.name, USUAL_RATE)
        if route.deadman is not None:
            rate = max(rate, FEEDS * 1e9 / route.deadman.timeout.value)
        rate *= speed
        numbered = _numbered(route.order.text, case, wire) if route.order else None
        for source in route.sources:
            sender = STRANGER if source.value == ANY else source.value
            if sender != STRANGER and sender not in table.endpoints:
                hint = did_you_mean(sender, table.endpoints)
                raise UsageError(f"{source.span}: there is no endpoint '{sender}'", hint)
            offset = random.Random(f"{seed}/{case.name}/{sender}").uniform(0, 1 / rate)
            yield Stream(sender, case, rate, offset, numbered)


_PATH = re.compile(r"[A-Za-z_]\w*(?:\.\w+)*")


def _numbered(order: str, case: PayloadCase, wire: Wire) -> Numbered | None:
    """Return the first integer field that an expression reads."""
    for match in _PATH.finditer(order):
        first, *rest = steps = match[0].split(".")
        beside = wire.envelopes.of(case.name).beside if first == ENVELOPE else MessageType("")
        payload = case.type if first == MESSAGE else MessageType("")
        for kind, path in ((case.type, steps), (payload, rest), (beside, rest)):
            if isinstance(found := type_at(kind, path), Int):
                return Numbered(tuple(path), found, kind is beside)
    return None


DRAIN = 256
"""Datagrams read from one socket before the next one is served."""

PATIENCE = 0.2
"""Longest delay in seconds before `stop` or missing commands are noticed."""

LATE = 1.0
"""Seconds behind schedule after which messages are skipped rather than sent in a burst."""

MOST_CHANGES = 100
"""How many of the newest changes of boards are kept."""


@dataclass(slots=True)
class Statistics:
    """Counts since the start. `sent` is by endpoint and by payload case, `inboxes` by endpoint.

    `is_answered`: whether a route forwards or answers what endpoints send (what comes from ROS may not be published
    yet).
    `unsent` are datagrams that the kernel refused to take, and frames for a link that is full or not open.
    `changes` are those of the boards, the newest last.
    """

    sent: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    unsent: int = 0
    is_answered: bool = True
    inboxes: dict[str, Inbox] = field(default_factory=dict)
    changes: deque[Change] = field(default_factory=lambda: deque(maxlen=MOST_CHANGES))


@contextmanager
def _of_this_computer() -> Iterator[None]:
    """Say what to do about an address that is not one of this computer."""
    try:
        yield
    except UsageError as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno == errno.EADDRNOTAVAIL:
            raise UsageError(
                str(error),
                "simulate a table with addresses of this computer, for example 127.0.0.2; "
                "routes/sim.yaml has such addresses for the rover's endpoints",
            ) from error
        raise


class Simulator:
    """Simulates the endpoints of a table, and binds the addresses of all at once.

    Raises UsageError if one cannot be bound or opened, and for a table without listeners. `deadmen` and `services` are
    those of the compiled program: boards halt on what deadmen send, and endpoints reply to the requests of services.
    Boards in `obeys` obey these payload cases only. `lengths` are those of lists that mappings need
    (`lengths.needed_lengths`).
    """

    def __init__(
        self,
        wire: Wire,
        table: RouteTable,
        seed: int,
        speed: float = 1.0,
        *,
        deadmen: Sequence[DeadmanPlan] = (),
        services: Sequence[ServicePlan] = (),
        silences: Sequence[Silence] = (),
        obeys: Mapping[str, Collection[str]] | None = None,
        lengths: Mapping[str, int] | None = None,
    ) -> None:
        if not table.listeners:
            raise UsageError(f"{table.path} has no listeners: nothing receives what boards would send")
        self.statistics = Statistics(
            is_answered=any(route.sources and (route.destinations or route.reply) for route in table.routes)
        )
        played = boards(wire, table, deadmen, self.statistics.changes.append, obeys or {})
        self.statistics.inboxes = {name: Inbox(wire, name, played.get(name)) for name in table.endpoints}
        self._wire = wire
        self._table = table
        self._streams = tuple(streams(wire, table, seed, speed))
        self._numbers = [0] * len(self._streams)
        self._silences = silences
        self._replies = [
            (reply, PayloadModel(reply.case.name, reply.case.type, seed, lengths))
            for reply in replies(wire, table, services)
        ]
        check_silences(silences, [*self._streams, *(reply for reply, _ in self._replies)])
        self._models = [PayloadModel(stream.case.name, stream.case.type, seed, lengths) for stream in self._streams]
        self._selector = selectors.DefaultSelector()
        self._opened: list[socket.socket | LinkEnd] = []
        self._unopened: dict[LinkEnd, Inbox] = {}
        """The ends of links that the router has not opened."""
        self._ends: dict[str, LinkEnd] = {}
        """The first end of each link."""
        self._senders: dict[str, Callable[[bytes, str], None]] = {}
        self._stopping = False
        try:
            self._routers = {listener.name: listener_address(listener) for listener in table.sockets}
            names, envelopes = (*self._routers, *(link.name for link in table.links)), wire.envelopes
            self._receivers = {
                case: [name for name in names if envelopes.at(name) is envelopes.of(case)] or [*names]
                for case in envelopes.cases
            }
            for endpoint in table.endpoints.values():
                self._open_endpoint(endpoint)
            hosts = sorted({loopback_of(address.host) for address in self._routers.values()})
            self._senders[STRANGER] = self._sending([self._open(Address(host, 0), STRANGER) for host in hosts], None)
        except BaseException:
            self.close()
            raise

    @property
    def summary(self) -> str:
        """One line for people."""
        endpoints, cases = len(self._senders) - 1, len(self._streams)
        who = "1 endpoint sends" if endpoints == 1 else f"{endpoints} endpoints send"
        what = "1 payload case" if cases == 1 else f"{cases} payload cases"
        rate = sum(stream.rate for stream in self._streams)
        to = listed([*map(str, [*self._routers.values()][:1]), *map(str, self._ends.values())])
        requests = sorted({reply.request for reply, _ in self._replies})
        answers = f", and replies to {listed(requests)}" if requests else ""
        return f"{who} {what}, {rate:.0f}/s, to {to}{answers}"

    def _open_endpoint(self, endpoint: Endpoint) -> None:
        """Open one socket for both directions, and a second one to send if the endpoint has another `source_port`.

        The other end of a link has that.
        """
        inbox = self.statistics.inboxes[endpoint.name]
        listener = endpoint.listener.value if endpoint.listener is not None else None
        if isinstance(endpoint.address.value, LinkPlace) and listener is not None:
            end = self._open_end(self._table.listeners[listener], endpoint)
            self._ends.setdefault(listener, end)
            self._unopened[end] = inbox
            self._senders[endpoint.name] = lambda data, _: end.send(data)
            return
        if endpoint.address.value.is_learned:
            loopback = LOOPBACK if False in fitting(self._table, endpoint) else LOOPBACK_IPV6
            port = endpoint.source_port.value if endpoint.source_port else 0
            address = Address(stand_in(self._table, endpoint, loopback), port)
        else:
            address = place_of(endpoint, self._table)
        receiver = sender = self._open(address, endpoint.name, endpoint)
        if endpoint.source_port is not None and endpoint.source_port.value != address.port:
            sender = self._open(Address(address.host, endpoint.source_port.value), endpoint.name)
        for opened in {receiver, sender}:  # replies go to the port that the endpoint sends from
            self._selector.register(opened, selectors.EVENT_READ, (opened, inbox))
        self._senders[endpoint.name] = self._sending([sender], listener)

    def _sending(self, senders: Collection[socket.socket], listener: str | None) -> Callable[[bytes, str], None]:
        """Return a function that sends the envelope of a payload case to a listener, from the socket of its family.

        The default is the first one that receives the case; a link only if no other does.
        """
        by_family = {sender.family: sender for sender in senders}

        def send(data: bytes, case: str) -> None:
            for name in [listener] if listener is not None else self._receivers[case]:
                if (end := self._ends.get(name)) is not None:
                    return end.send(data)
                to = self._routers[name]
                if (sender := by_family.get(family(to.host))) is not None:
                    sender.sendto(data, socket_address(*to))
                    return None
            raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

        return send

    def _open_end(self, link: Listener, endpoint: Endpoint) -> LinkEnd:
        with _of_this_computer():
            end = links.board_end(link, endpoint)
        self._opened.append(end)
        return end

    def _open(self, address: Address, owner: str, endpoint: Endpoint | None = None) -> socket.socket:
        with _of_this_computer():
            opened = open_udp(address, owner, endpoint)
        self._opened.append(opened)
        return opened

    def close(self) -> None:
        self._selector.close()
        for opened in self._opened:
            opened.close()

    def stop(self) -> None:
        """Make `run` return soon; safe in a signal handler."""
        self._stopping = True

    def run(self, duration: float | None, every: float, report: Callable[[float], None]) -> float:
        """Send and receive for `duration` seconds, or until stopped. Returns the elapsed seconds.

        `report` is called with the elapsed seconds, about once every `every` seconds.
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
            self._watch_opened()
            wake = min(now + PATIENCE, next_report, *(at for at, _ in due[:1]))
            for key, _ in self._selector.select(max(0.0, wake - (time.monotonic() - start))):
                receiver, inbox = key.data
                self._receive(receiver, inbox, time.monotonic() - start, epoch)
            now = time.monotonic() - start
            for inbox in self.statistics.inboxes.values():
                inbox.advance(now)
        return now

    def _next(self, at: float, rate: float, now: float) -> float:
        """Return the time after `at` at which the stream is due; after a suspend, missed messages are skipped."""
        missed = int((now - at) * rate) if now - at > LATE else 0
        return at + (1 + missed) / rate

    def _send(self, index: int, at: float, epoch: float) -> None:
        stream = self._streams[index]
        if any(silence.covers(stream, at) for silence in self._silences):
            return
        message = stream.case.message_class()
        self._models[index].fill(message, self._pose(stream.endpoint, at, epoch))
        around = self._wire.envelopes.of(stream.case.name).message_class()
        if stream.numbered is not None:
            self._numbers[index] += 1
            stream.numbered.set(around if stream.numbered.is_beside else message, self._numbers[index])
        self._transmit(stream, message, around)

    def _reply(self, endpoint: str, request: Decoded, at: float, epoch: float) -> None:
        for reply, model in self._replies:
            if (reply.asked, reply.request) != (endpoint, request.case.name):
                continue
            if any(silence.covers(reply, at) for silence in self._silences):
                continue
            message = reply.case.message_class()
            model.fill(message, self._pose(reply.endpoint, at, epoch))
            around = self._wire.envelopes.of(reply.case.name).message_class()
            reply.copy_number(request, message, around)
            self._transmit(reply, message, around)

    def _transmit(self, sent: Stream | Reply, message: Any, around: Any) -> None:
        try:
            self._senders[sent.endpoint](self._wire.encode(sent.case, message, around), sent.case.name)
        except OSError:
            self.statistics.unsent += 1
        else:
            self.statistics.sent[sent.endpoint][sent.case.name] += 1

    def _pose(self, endpoint: str, at: float, epoch: float) -> Pose:
        """Return the rover's pose as an endpoint reports it: the motors of a board that has halted do not turn."""
        now, inbox = pose(at, epoch), self.statistics.inboxes.get(endpoint)
        if inbox is None or inbox.board is None:
            return now
        return replace(now, speed=now.speed * inbox.board.pace(at))

    def _watch_opened(self) -> None:
        """Receive from the links that have been opened; the others would always be ready."""
        for end, inbox in [*self._unopened.items()]:
            if end.is_open:
                del self._unopened[end]
                self._selector.register(end, selectors.EVENT_READ, (end, inbox))

    def _receive(self, receiver: socket.socket | LinkEnd, inbox: Inbox, now: float, epoch: float) -> None:
        if isinstance(receiver, LinkEnd):
            self._receive_frames(receiver, inbox, now, epoch)
            return
        for _ in range(DRAIN):
            try:
                data = receiver.recv(LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            self._take(inbox, data, now, epoch)

    def _receive_frames(self, end: LinkEnd, inbox: Inbox, now: float, epoch: float) -> None:
        try:
            frames = end.receive()
        except OSError:  # nobody has it open any more
            self._selector.unregister(end)
            self._unopened[end] = inbox
            return
        for frame in frames:
            if frame.problem:
                inbox.undecodable += 1
            else:
                self._take(inbox, frame.data, now, epoch)

    def _take(self, inbox: Inbox, datagram: bytes, now: float, epoch: float) -> None:
        for decoded in inbox.take(now, datagram):
            self._reply(inbox.endpoint, decoded, now, epoch)
