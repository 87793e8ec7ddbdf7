"""What one simulated endpoint has received. Knows no sockets; times are seconds since the start."""

from __future__ import annotations

from dataclasses import dataclass

from google.protobuf.message import Message

from router.engine.wire import Wire
from router.errors import DecodeError
from router.tools.board import Board
from router.tools.frames import Frames, is_part


@dataclass(slots=True)
class Arrivals:
    """What was received of one payload case: the newest message and when, and how many."""

    last: Message
    at: float
    count: int = 1


class Inbox:
    """`arrivals` and `frames` are by payload case. `board` is None where commands mean nothing: the basestation."""

    def __init__(self, wire: Wire, board: Board | None) -> None:
        self.board = board
        self.arrivals: dict[str, Arrivals] = {}
        self.frames: dict[str, Frames] = {}
        self.undecodable = 0
        self._wire = wire

    def take(self, now: float, datagram: bytes) -> None:
        try:
            decoded = self._wire.decode(datagram)
        except DecodeError:
            self.undecodable += 1
            return
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

    def look(self, now: float) -> None:
        """Time has passed: commands may be missing, frames incomplete."""
        if self.board is not None:
            self.board.look(now)
        for frames in self.frames.values():
            frames.look(_nanoseconds(now))


def _nanoseconds(seconds: float) -> int:
    return int(seconds * 1e9)
