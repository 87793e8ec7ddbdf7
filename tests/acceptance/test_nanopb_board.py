"""What a board with nanopb obeys of what the router sends, and what a basestation reads of what such a board sends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from time import sleep
from typing import NamedTuple

import pytest

from tests.acceptance.payloads import FRAME, WIRE, Sample, for_boards, sample
from tests.acceptance.rover_map import HOSTS, ROUTER
from tests.acceptance.site import IMPATIENT_ROVER, RouterProcess, Site, site, total
from tests.boards.board import Board, Verdict, compiled
from tests.ports import free_port
from tests.tables import PROTOS

EXACT = "127.0.0.6"
"""Where the router takes exact envelopes only."""

TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rover/protos, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen:
  repairing: {{address: 127.0.0.5:{listen}, framing: zero_trimmed}}
  exact: {{address: 127.0.0.6:{listen}, framing: exact}}
endpoints:
{endpoints}"""
ROUTES = "routes:\n" + "".join(
    f"""\
  {case}:
    - {{{{source: basestation, destinations: [board, other_board, trimming_board], deadman: {{{{none: for tests}}}}}}}}
    - {{{{source: board, destinations: basestation}}}}
"""
    for case in WIRE.envelopes.first.cases
)
TRIMMED = """\
version: 1
extends: table.yaml
endpoints:
  trimming_board: {trim_trailing_zeros: true}
"""
SOCKETS = {"basestation": HOSTS["basestation"], "other_board": "127.0.0.40", "trimming_board": "127.0.0.41"}

REDUNDANT = tuple(map(bytes.fromhex, ("c2018000", "c201808000", "c20180808000")))
"""A released stick, with a length that takes more bytes than it needs."""


def drive(**values: int) -> bytes:
    return sample("manual_drive", WIRE.envelopes.first.cases["manual_drive"].message_class(**values)).datagram


RELEASED = drive()
FORWARD = drive(forward_backward=100)
MANUAL_DRIVE = WIRE.envelopes.first.cases["manual_drive"].number


class Link(NamedTuple):
    """A basestation and a board, with a router between them that sends the same to two plain sockets."""

    place: Site
    board: Board

    def command(self, *datagrams: bytes, to: str = ROUTER) -> None:
        for datagram in datagrams:
            self.place.endpoints["basestation"].sendto(datagram, (to, self.place.listen))

    def arrivals(self, datagram: bytes) -> tuple[Verdict, bytes, bytes]:
        """What becomes of a command at the board, the other board and the trimming one."""
        self.command(datagram)
        return self.board.receive(), self.place.receive("other_board"), self.place.receive("trimming_board")


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("board"), PROTOS, "components/common/envelope.proto", "PBEnvelope")


@pytest.fixture(scope="module")
def link(program: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Link]:
    folder = tmp_path_factory.mktemp("link")
    with ExitStack() as stack:
        place = stack.enter_context(site(folder, SOCKETS))
        board, line = on_board(stack, program, place, "board")
        place.table(TABLE + line + ROUTES)
        trimmed = folder / "trimmed.yaml"
        trimmed.write_text(TRIMMED)
        stack.enter_context(RouterProcess(folder, trimmed))
        yield Link(place, board)


def on_board(stack: ExitStack, program: Path, place: Site, name: str) -> tuple[Board, str]:
    """A board that runs, and its line of a table."""
    address = HOSTS["driving_board"], free_port(HOSTS["driving_board"])
    board = stack.enter_context(Board(program, address, (ROUTER, place.listen)))
    return board, f"  {name}: {{{{address: {address[0]}:{address[1]}, kind: board}}}}\n"


def framings(exact: bytes) -> Sequence[bytes]:
    """Exact, trimmed, padded to a frame of fixed size, and trimmed and padded to one longer than any envelope."""
    trimmed = exact.rstrip(b"\0")
    return exact, trimmed, exact.ljust(FRAME, b"\0"), trimmed.ljust(1400, b"\0")


def obeyed(made: Sample) -> Verdict:
    """What the board says of an envelope with these values, whatever its encoding was."""
    return Verdict(WIRE.envelopes.first.cases[made.case].number, sample(made.case, made.payload).datagram)


@pytest.mark.parametrize("case", WIRE.envelopes.first.cases)
def test_boards_get_the_exact_envelope_in_whatever_framing_it_came(link: Link, case: str) -> None:
    for made in for_boards(case):
        exact = made.datagram
        for datagram in framings(exact):
            assert link.arrivals(datagram) == (obeyed(made), exact, exact.rstrip(b"\0")), datagram.hex()


@pytest.mark.parametrize("case", WIRE.envelopes.first.cases)
def test_the_router_reads_what_it_has_trimmed_itself(link: Link, case: str) -> None:
    for made in for_boards(case):
        *_, trimmed = link.arrivals(made.datagram)
        assert link.arrivals(trimmed) == (obeyed(made), made.datagram, trimmed)


@pytest.mark.parametrize("exact", REDUNDANT, ids=bytes.hex)
def test_a_length_that_was_cut_at_the_end_gets_its_zero_back(link: Link, exact: bytes) -> None:
    released = Verdict(MANUAL_DRIVE, RELEASED)
    assert link.arrivals(exact) == (released, exact, exact.rstrip(b"\0"))
    assert link.arrivals(exact.rstrip(b"\0")) == (released, exact, exact.rstrip(b"\0"))


@pytest.mark.parametrize("case", WIRE.envelopes.first.cases)
def test_a_basestation_reads_the_exact_envelope_in_whatever_framing_a_board_sends(link: Link, case: str) -> None:
    for made in for_boards(case):
        for form in ("exact", "trimmed", "padded"):
            link.board.send(form, made.datagram)
            arrived = link.place.receive("basestation")
            assert arrived == sample(case, made.payload).datagram
            assert WIRE.envelopes.first.message_class.FromString(arrived).WhichOneof("payload") == case
        for datagram in framings(made.datagram):
            link.board.send("raw", datagram)
            assert link.place.receive("basestation") == made.datagram


@pytest.mark.parametrize("case", WIRE.envelopes.first.cases)
def test_where_framing_is_exact_nothing_is_repaired(link: Link, case: str) -> None:
    before, refused = link.place.scrape(), 0
    for made in for_boards(case):
        exact = made.datagram
        for datagram in (exact.rstrip(b"\0"), exact.ljust(FRAME, b"\0")):
            if datagram != exact:
                link.command(datagram, to=EXACT)
                refused += 1
        link.command(exact, to=EXACT)
        assert link.board.receive() == obeyed(made)
    assert refused
    counts = link.place.changes(before)
    assert total(counts, "datagrams_rejected", listener="exact", reason="malformed") == refused
    assert total(counts, "datagrams_padded") == 0
    link.place.waiting()


def test_all_that_was_sent_to_the_board_was_obeyed(link: Link) -> None:
    """Last of the link's tests."""
    assert link.board.waiting() == []
    assert link.place.waiting() == {}
    assert total(link.place.scrape(), "datagrams_sent", destination="board") == link.board.obeyed


@pytest.mark.parametrize("framing", [1, 2], ids=["trimmed", "padded"])
def test_the_last_command_that_the_board_obeys_is_the_released_stick(
    program: Path, tmp_path: Path, framing: int
) -> None:
    """The operator drives for half a second, then leaves the stick alone for one."""
    others = {name: host for name, host in HOSTS.items() if name != "driving_board"}
    with ExitStack() as stack:
        place = stack.enter_context(site(tmp_path, others))
        board, line = on_board(stack, program, place, "driving_board")
        stack.enter_context(RouterProcess(tmp_path, place.table(IMPATIENT_ROVER + line)))
        for command, times in ((FORWARD, 25), (RELEASED, 50)):
            for _ in range(times):
                place.send("basestation", framings(command)[framing])
                sleep(0.02)
        heard = board.waiting()
    assert not [verdict for verdict in heard if verdict.refused]
    driven = [verdict.envelope for verdict in heard if verdict.case == MANUAL_DRIVE]
    assert driven.count(FORWARD) > 20
    assert driven[-25:] == [RELEASED] * 25
