"""How simulated endpoints react to the datagrams that they receive. Times are seconds since the start."""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from google.protobuf.message import Message

from router.compiler.compiled_table import DeadmanPlan
from router.datagrams import Decoded, Wire
from router.errors import DecodeError, UsageError, did_you_mean
from router.table.model import RouteTable
from router.table.model.endpoints import EndpointKind
from router.table.model.targets import Priority
from router.types.model import MessageType
from router.values.printing import compact

TIMEOUT = 1.0
"""Seconds without a command after which a board stops on its own, or is reported as continuing the last one."""

STOPPING = 0.4
"""Seconds in which a board's motors stop from full speed."""

MISSED_REPEATS = 3
"""A deadman counts as ended when this many of its repeats are missing."""


class State(enum.Enum):
    WAITING = "waiting"
    OBEYING = "obeying"
    HALTED = "halted"
    STOPPED = "stopped"
    CONTINUING = "continuing"


_STANDING = {State.WAITING, State.HALTED, State.STOPPED}


@dataclass(frozen=True, slots=True)
class Stop:
    """A payload that a deadman sends in place of commands. It counts for `hold` seconds.

    `text` describes all payloads of the deadman.
    """

    case: str
    message: Message
    hold: float
    text: str


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a board's state, or the first message of a case that it ignores, with its time and description."""

    at: float
    board: str
    state: State
    text: str

    def __str__(self) -> str:
        return f"{self.at:.1f} s: {self.board} {self.text}"


def command_cases(wire: Wire, table: RouteTable, board: str) -> frozenset[str]:
    """Return the payload cases that the table sends to a board with the priority of commands."""
    return frozenset(
        case.name
        for route in table.routes
        if route.priority in (None, Priority.COMMAND)
        and any(destination.endpoint.value == board for destination in route.destinations)
        for case in wire.envelopes.held(wire.case(route.case.value), board)
    )


def stops_for(wire: Wire, deadmen: Iterable[DeadmanPlan], board: str) -> list[Stop]:
    """Return the payloads that the deadmen of a program send to this board."""
    return [
        Stop(payload.case.name, payload.message, MISSED_REPEATS * plan.repeat / 1e9, text)
        for plan in deadmen
        for endpoint, datagrams in plan.datagrams
        if endpoint == board
        for payloads in [[wire.decode(datagram, wire.envelopes.to(board)) for datagram in datagrams]]
        for text in [", ".join(map(_described, payloads))]
        for payload in payloads
    ]


def _described(payload: Decoded) -> str:
    return f"{payload.case.name} {compact(payload.message, payload.case.type)}"


class Board:
    """Obeys `commands`, halts on `stops`, and stops after TIMEOUT seconds without either.

    A halt ends with the first command after the deadman has ended, since commands of other routes may continue.
    `changed` is called with every new state.

    With `obeys` it acts on these payload cases only, like firmware without a timeout: it continues the last command
    until one of them changes it. `ignored` counts the others.
    """

    def __init__(
        self,
        name: str,
        commands: Collection[str],
        stops: Sequence[Stop],
        changed: Callable[[Change], None],
        obeys: Collection[str] | None = None,
    ) -> None:
        self.state = State.WAITING
        self.ignored: Counter[str] = Counter()
        self._name = name
        self._commands = commands
        self._stops = stops
        self._changed = changed
        self._obeys = obeys
        self._since = 0.0
        self._moved_until = -STOPPING
        self._commanded_at = 0.0
        self._halted_until = 0.0
        self._halt = ""

    def take(self, now: float, decoded: Decoded) -> None:
        """Process a received datagram."""
        case, message = decoded.case, decoded.message
        if self._obeys is not None and case.name not in self._obeys:
            self.ignored[case.name] += 1
            if self.ignored[case.name] == 1:
                self._changed(Change(now, self._name, self.state, f"ignores {case.name}, which it does not obey"))
            return
        stop = next((stop for stop in self._stops if stop.case == case.name and stop.message == message), None)
        if stop is not None:
            self._commanded_at, self._halted_until = now, now + stop.hold
            self._halt = stop.text
            self._enter(now, State.HALTED)
        elif case.name in self._commands:
            self._commanded_at = now
            if self.state is not State.HALTED or now >= self._halted_until:
                self._enter(now, State.OBEYING)

    def advance(self, now: float) -> None:
        """Check for missing commands."""
        if now - self._commanded_at < TIMEOUT:
            return
        if self._obeys is None and self.state in (State.OBEYING, State.HALTED):
            self._enter(now, State.STOPPED)
        elif self._obeys is not None and self.state is State.OBEYING:
            self._enter(now, State.CONTINUING)

    def pace(self, now: float) -> float:
        """Return how fast the motors turn, from 0 to 1: a board that halts or stops slows down for STOPPING seconds."""
        if self.state not in _STANDING:
            return 1.0
        return max(0.0, 1 - (now - self._moved_until) / STOPPING)

    def status(self, now: float) -> str:
        """Return the state as text for people."""
        if self.state is State.WAITING:
            return "no commands yet"
        if self.state is State.STOPPED:
            return f"no commands for {now - self._commanded_at:.1f} s: stopped"
        if self.state is State.CONTINUING:
            return f"no commands for {now - self._commanded_at:.1f} s: continues the last one"
        if self.state is State.HALTED:
            return f"halted by a deadman for {now - self._since:.1f} s: {self._halt}"
        return "obeys commands"

    def _enter(self, now: float, state: State) -> None:
        if state is self.state:
            return
        was, lasted = self.state, now - self._since
        if was not in _STANDING:
            self._moved_until = now
        self.state, self._since = state, now
        if state is State.HALTED:
            text = f"halted by a deadman: {self._halt}"
        elif state is State.OBEYING and was is not State.WAITING:
            text = f"obeys commands again, after {lasted:.1f} s"
        else:
            text = self.status(now)
        self._changed(Change(now, self._name, state, text))


def boards(
    wire: Wire,
    table: RouteTable,
    deadmen: Iterable[DeadmanPlan],
    changed: Callable[[Change], None],
    obeys: Mapping[str, Collection[str]],
) -> dict[str, Board]:
    """Return the boards that the table sends commands to, by endpoint; those in `obeys` obey these payload cases only.

    Raises UsageError if `obeys` names a board or a payload case to which nothing is sent.
    """
    plans = tuple(deadmen)
    by_name = {}
    for name, endpoint in table.endpoints.items():
        commands, stops = command_cases(wire, table, name), stops_for(wire, plans, name)
        if endpoint.kind is EndpointKind.BOARD and (commands or stops):
            by_name[name] = Board(name, commands, stops, changed, obeys.get(name))
            sent = commands | {stop.case for stop in stops}
            for case in sorted(set(obeys.get(name, ())) - sent):
                raise UsageError(f"nothing sends '{case}' to {name}", did_you_mean(case, sent))
    for name in obeys.keys() - by_name:
        raise UsageError(f"no board that gets commands is called '{name}'", did_you_mean(name, by_name))
    return by_name


PART = ("frame_id", "total_count", "index")
"""Fields of a payload that is part of a frame: frame number, number of parts, index of this part."""

FRAME_TIMEOUT = 1_000_000_000
"""Nanoseconds from the first part of a frame until an incomplete frame is discarded."""

MOST_FRAMES, MOST_PARTS = 64, 8192
"""Maximum frames that are assembled at once, and maximum parts of a frame."""


def is_part(kind: MessageType) -> bool:
    return all(kind.field(name) for name in PART)


class Frames:
    """Counts the frames of one payload case that a simulated basestation assembles. `astray`: parts of no frame."""

    def __init__(self) -> None:
        self.complete = 0
        self.incomplete = 0
        self.astray = 0
        self._missing: dict[tuple[int, int], tuple[float, set[int]]] = {}
        """Deadline and missing parts by frame number and number of parts, the oldest first.

        A complete frame is kept until its deadline, so that copies of its parts are recognised.
        """

    def take(self, now: int, part: Any) -> None:
        """Add a part; `now` in monotonic ns."""
        self.advance(now)
        if not 0 <= part.index < part.total_count <= MOST_PARTS:
            self.astray += 1
            return
        frame = part.frame_id, part.total_count
        _, missing = self._missing.setdefault(frame, (now + FRAME_TIMEOUT, set(range(part.total_count))))
        if missing == {part.index}:
            self.complete += 1
        missing.discard(part.index)
        if len(self._missing) > MOST_FRAMES:
            self._forget_oldest()

    def advance(self, now: int) -> None:
        """Discard overdue frames."""
        while self._missing and next(iter(self._missing.values()))[0] <= now:
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        _, missing = self._missing.pop(next(iter(self._missing)))
        self.incomplete += bool(missing)


@dataclass(slots=True)
class Arrivals:
    """The newest message of one payload case, its time, and how many were received."""

    last: Message
    at: float
    count: int = 1


class Inbox:
    """What one endpoint has received. `arrivals` and `frames` are by payload case; a basestation has no `board`."""

    def __init__(self, wire: Wire, endpoint: str, board: Board | None) -> None:
        self.board = board
        self.arrivals: dict[str, Arrivals] = {}
        self.frames: dict[str, Frames] = {}
        self.undecodable = 0
        self.endpoint = endpoint
        self._wire, self._envelope = wire, wire.envelopes.to(endpoint)

    def take(self, now: float, datagram: bytes) -> Sequence[Decoded]:
        """Process a received datagram, and return its messages."""
        try:
            found = self._wire.decode_all(datagram, self._envelope)
        except DecodeError:
            self.undecodable += 1
            return ()
        for decoded in found:
            self._take(now, decoded)
        return found

    def _take(self, now: float, decoded: Decoded) -> None:
        case, message = decoded.case, decoded.message
        arrivals = self.arrivals.get(case.name)
        if arrivals is None:
            self.arrivals[case.name] = Arrivals(message, now)
        else:
            arrivals.last, arrivals.at, arrivals.count = message, now, arrivals.count + 1
        if self.board is not None:
            self.board.take(now, decoded)
        elif is_part(case.type):
            self.frames.setdefault(case.name, Frames()).take(_nanoseconds(now), message)

    def advance(self, now: float) -> None:
        """Check for missing commands and incomplete frames."""
        if self.board is not None:
            self.board.advance(now)
        for frames in self.frames.values():
            frames.advance(_nanoseconds(now))


def _nanoseconds(seconds: float) -> int:
    return int(seconds * 1e9)
