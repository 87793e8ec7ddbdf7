"""What `board_takes` accepts, a board in nanopb decodes: it is sent datagrams without a router between them."""

from __future__ import annotations

import ctypes
import random
import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.boards.board import REQUIRED, Board, Verdict, compiled
from tests.carrier.test_boards import COMPLETE, INCOMPLETE, Boards
from tests.envelopes import I32, VARINT, framed, tag
from tests.ports import free_port

HOST = "127.0.0.77"


class Direct:
    """A board, and a socket that sends to it."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def verdict(self, datagram: bytes) -> Verdict:
        self._socket.sendto(datagram, self._board.address)
        return self._board.receive()

    def close(self) -> None:
        self._socket.close()


@contextmanager
def direct(folder: Path, protos: Path) -> Iterator[Direct]:
    program = compiled(folder, protos, "envelope.proto", "PBEnvelope")
    with Board(program, (HOST, free_port(HOST)), (HOST, 9)) as board:
        to = Direct(board)
        try:
            yield to
        finally:
            to.close()


class Partial:
    """Random envelopes of REQUIRED that lack some of their fields, in any order, with messages in several pieces."""

    def __init__(self, seed: int) -> None:
        self._noise = random.Random(seed)

    def envelope(self) -> bytes:
        payload = framed(1, self._drive()) if self._noise.random() < 0.8 else framed(2, b"")
        second = framed(1, self._drive()) if self._noise.random() < 0.2 else b""
        return payload + self._some(second, ROBOT, SENDER)

    def _drive(self) -> bytes:
        motors = [framed(self._noise.choice((1, 2, 3, 5)), self._motor()) for _ in range(self._noise.randrange(3))]
        return self._some(framed(1, self._motor()), framed(4, b"a"), *motors)

    def _motor(self) -> bytes:
        return self._some(tag(1, I32) + bytes(4), tag(2, I32) + bytes(4))

    def _some(self, *fields: bytes) -> bytes:
        kept = [field for field in fields if self._noise.random() < 0.95]
        return b"".join(self._noise.sample(kept, len(kept)))


ROBOT, SENDER = tag(9, VARINT) + b"\1", framed(10, b"")


def test_nanopb_refuses_what_lacks_a_required_field_and_decodes_all_else(library: ctypes.CDLL, tmp_path: Path) -> None:
    carrier, noise, counts = Boards(library, REQUIRED), Partial(1), Counter[str]()
    datagrams = [*COMPLETE.values(), *(data for data, _ in INCOMPLETE.values())]
    datagrams += [noise.envelope() for _ in range(500)]
    with direct(tmp_path, REQUIRED) as board:
        for data in datagrams:
            found = carrier.refusal(data)
            refused = board.verdict(data).refused
            assert bool(refused) == bool(found), data.hex()
            counts[refused] += 1
    assert min(counts[""], counts["missing required field"]) > len(datagrams) / 10
