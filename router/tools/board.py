"""What a simulated board makes of what it is told: it obeys commands, halts for a deadman, stops when left alone.

Knows neither sockets nor clocks: whoever calls tells the time, in seconds since the start.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

from google.protobuf.message import Message

from router.compiler.program import DeadmanPlan
from router.engine.wire import Decoded, Wire
from router.table.model import EndpointKind, Priority, RouteTable
from router.values import compact

TIMEOUT = 1.0
"""Seconds without a command after which a board stops by itself: it trusts no router."""

MISSED_REPEATS = 3
"""A deadman that was not heard for so many of its repeats has let go."""


class State(enum.Enum):
    WAITING = "waiting"
    OBEYING = "obeying"
    HALTED = "halted"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class Stop:
    """What a deadman sends in place of commands. It holds for `hold` seconds."""

    case: str
    message: Message
    hold: float


@dataclass(frozen=True, slots=True)
class Change:
    """A board's state has changed: when, in seconds since the start, and in which words."""

    at: float
    board: str
    state: State
    text: str

    def __str__(self) -> str:
        return f"{self.at:.1f} s: {self.board} {self.text}"


def command_cases(table: RouteTable, board: str) -> frozenset[str]:
    """The payload cases that the table sends to a board, but for those that it calls less than commands."""
    return frozenset(
        route.case.value
        for route in table.routes
        if route.priority in (None, Priority.COMMAND)
        and any(destination.endpoint.value == board for destination in route.destinations)
    )


def stops_for(wire: Wire, deadmen: Iterable[DeadmanPlan], board: str) -> list[Stop]:
    """What the deadmen of a program send to this board."""
    return [
        Stop(decoded.case.name, decoded.message, MISSED_REPEATS * plan.repeat / 1e9)
        for plan in deadmen
        for endpoint, datagram in plan.datagrams
        if endpoint == board
        for decoded in [wire.decode(datagram)]
    ]


class Board:
    """Obeys `commands`, halts for `stops`, and stops when neither came for TIMEOUT seconds.

    A halt ends with the first command after the deadman has let go: commands of another route may go on meanwhile.
    `changed` hears of every new state.
    """

    def __init__(
        self, name: str, commands: Collection[str], stops: Sequence[Stop], changed: Callable[[Change], None]
    ) -> None:
        self.state = State.WAITING
        self._name = name
        self._commands = commands
        self._stops = stops
        self._changed = changed
        self._since = 0.0
        self._told_at = 0.0
        self._halted_until = 0.0
        self._halt = ""

    def take(self, now: float, decoded: Decoded) -> None:
        """A datagram has arrived."""
        case, message = decoded.case, decoded.message
        stop = next((stop for stop in self._stops if stop.case == case.name and stop.message == message), None)
        if stop is not None:
            self._told_at, self._halted_until = now, now + stop.hold
            self._halt = f"{case.name} {compact(message, case.type)}"
            self._become(now, State.HALTED)
        elif case.name in self._commands:
            self._told_at = now
            if self.state is not State.HALTED or now >= self._halted_until:
                self._become(now, State.OBEYING)

    def look(self, now: float) -> None:
        """Time has passed."""
        if self.state in (State.OBEYING, State.HALTED) and now - self._told_at >= TIMEOUT:
            self._become(now, State.STOPPED)

    def told(self, now: float) -> str:
        """The state in words."""
        if self.state is State.WAITING:
            return "no commands yet"
        if self.state is State.STOPPED:
            return f"no commands for {now - self._told_at:.1f} s: stopped"
        if self.state is State.HALTED:
            return f"halted by a deadman for {now - self._since:.1f} s: {self._halt}"
        return "obeys commands"

    def _become(self, now: float, state: State) -> None:
        if state is self.state:
            return
        was, lasted = self.state, now - self._since
        self.state, self._since = state, now
        if state is State.HALTED:
            text = f"halted by a deadman: {self._halt}"
        elif state is State.OBEYING and was is not State.WAITING:
            text = f"obeys commands again, after {lasted:.1f} s"
        else:
            text = self.told(now)
        self._changed(Change(now, self._name, state, text))


def boards(
    wire: Wire, table: RouteTable, deadmen: Iterable[DeadmanPlan], changed: Callable[[Change], None]
) -> dict[str, Board]:
    """The boards that the table sends commands to, by endpoint."""
    plans = tuple(deadmen)
    found = {}
    for name, endpoint in table.endpoints.items():
        commands, stops = command_cases(table, name), stops_for(wire, plans, name)
        if endpoint.kind is EndpointKind.BOARD and (commands or stops):
            found[name] = Board(name, commands, stops, changed)
    return found
