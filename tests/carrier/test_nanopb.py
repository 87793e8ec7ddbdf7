"""What `board_takes` accepts, a board in nanopb decodes: it is sent datagrams without a router between them."""

from __future__ import annotations

import ctypes
import random
import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.boards.board import OPTIONS, REQUIRED, Board, Verdict, compiled
from tests.carrier.test_boards import COMPLETE, INCOMPLETE, Boards
from tests.envelopes import I32, VARINT, framed, tag, varint
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


TEXTS, NUMBERS, IGNORED = 1, 2, 3
NEEDED = tag(8, I32) + bytes(4)


def integer(number: int, value: int) -> bytes:
    return tag(number, VARINT) + varint(value % (1 << 64))


def zigzag(number: int, value: int) -> bytes:
    return integer(number, 2 * value if value >= 0 else -2 * value - 1)


def texts(*fields: bytes) -> bytes:
    return framed(TEXTS, b"".join(fields))


def numbers(*fields: bytes) -> bytes:
    return framed(NUMBERS, b"".join(fields) + NEEDED)


AT_THE_LIMITS = {
    "a text of the file's size": texts(framed(1, b"12345")),
    "a text of the field's size": texts(framed(2, b"1234567")),
    "a text of the line's size": texts(framed(3, b"123")),
    "bytes of a fixed size": texts(framed(4, b"123")),
    "a list of the message's count": texts(framed(5, b"12345") * 2),
    "a list of a fixed count": texts(framed(6, b"\1\2\3")),
    "the largest byte": numbers(integer(1, 127)),
    "the smallest byte": numbers(integer(1, -128)),
    "the largest zigzag": numbers(zigzag(2, 127)),
    "the smallest zigzag": numbers(zigzag(2, -128)),
    "the largest octet": numbers(integer(3, 255)),
    "the largest half": numbers(integer(4, 2**31 - 1)),
    "the smallest half": numbers(integer(4, -(2**31))),
    "the largest word": numbers(integer(5, 2**16 - 1)),
    "packed octets": numbers(framed(6, varint(255) * 4)),
    "octets one by one": numbers(integer(6, 255) * 4),
    "an unknown gear that fits": numbers(integer(7, 255)),
    "a skipped field": numbers(tag(9, I32) + b"\0\0\xc0\x7f"),
}
BEYOND = {
    "a text of the file's size": texts(framed(1, b"123456")),
    "a text of the field's size": texts(framed(2, b"12345678")),
    "a text of the line's size": texts(framed(3, b"1234")),
    "bytes of a fixed size": texts(framed(4, b"12")),
    "a list of the message's count": texts(framed(5, b"") * 3),
    "a list of a fixed count": texts(framed(6, b"\1\2")),
    "the largest byte": numbers(integer(1, 128)),
    "the smallest byte": numbers(integer(1, -129)),
    "the largest zigzag": numbers(zigzag(2, 128)),
    "the smallest zigzag": numbers(zigzag(2, -129)),
    "the largest octet": numbers(integer(3, 256)),
    "the largest word": numbers(integer(5, 2**16)),
    "packed octets": numbers(framed(6, varint(1) + varint(256))),
    "octets one by one": numbers(integer(6, 1) + integer(6, 256)),
    "a gear that does not fit": numbers(integer(7, 256)),
    "a field that only nanopb needs": framed(NUMBERS, b""),
}
TRUNCATED = {"the largest half": numbers(integer(4, 2**31)), "the smallest half": numbers(integer(4, -(2**31) - 1))}
"""An int64 in an int32_t: nanopb truncates these, and so decodes other numbers."""


def test_nanopb_decodes_up_to_the_limits_of_its_options_in_protos(library: ctypes.CDLL, tmp_path: Path) -> None:
    carrier = Boards(library, OPTIONS)
    with direct(tmp_path, OPTIONS) as board:
        for name, data in AT_THE_LIMITS.items():
            assert (carrier.refusal(data), board.verdict(data).refused) == (None, ""), name
        for name, data in BEYOND.items():
            assert carrier.refusal(data), name
            assert board.verdict(data).refused, name
        for name, data in TRUNCATED.items():
            assert carrier.refusal(data), name
        assert board.verdict(framed(IGNORED, NEEDED)).refused == "no payload"
