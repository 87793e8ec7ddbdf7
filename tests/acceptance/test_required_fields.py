"""Commands that a board with nanopb refuses keep no deadman from braking; payloads that protobuf ignores are told."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from time import sleep

from tests.acceptance.rover_map import ROUTER
from tests.acceptance.site import RouterProcess, site, total
from tests.boards.board import Board, compiled
from tests.envelopes import I32, framed, tag
from tests.ports import free_port

PROTOS = Path(__file__).parents[1] / "rehearsal" / "tables" / "required"
TABLE = """\
version: 1
envelope: {{protos: {root}/tests/rehearsal/tables/required, message: PBEnvelope, oneof: payload}}
http: {{address: 127.0.0.1:{metrics}}}
listen: {{rover: {{address: 127.0.0.5:{listen}}}}}
endpoints:
{endpoints}"""
ROUTES = """\
routes:
  drive:
    source: basestation
    destinations: board
    ttl: 500ms
    deadman: {{timeout: 500ms, repeat: 50ms, send: {{stop: {{}}}}, to: board, at_start: silent}}
"""
MOTOR = tag(1, I32) + bytes(4)
COMPLETE = framed(1, framed(1, MOTOR) + framed(2, MOTOR))
INCOMPLETE = framed(1, framed(1, MOTOR))
STOP = framed(2, b"")
TIMES = 20


def test_the_board_is_braked_while_its_commands_lack_a_required_field(tmp_path: Path) -> None:
    program = compiled(tmp_path, PROTOS, "envelope.proto", "PBEnvelope")
    with ExitStack() as stack:
        place = stack.enter_context(site(tmp_path, {"basestation": "127.0.0.10"}))
        address = "127.0.0.222", free_port("127.0.0.222")
        board = stack.enter_context(Board(program, address, (ROUTER, place.listen)))
        table = place.table(TABLE + f"  board: {{{{address: {address[0]}:{address[1]}, kind: board}}}}\n" + ROUTES)
        router = stack.enter_context(RouterProcess(tmp_path, table))
        place.send("basestation", COMPLETE)
        assert board.receive().envelope == COMPLETE
        for _ in range(TIMES):
            place.send("basestation", INCOMPLETE)
            sleep(0.05)
        heard = [board.receive(), *board.waiting()]
        assert {(verdict.envelope, verdict.refused) for verdict in heard} == {(STOP, "")}
        assert total(place.scrape(), "messages_dropped", target="board", reason="missing_field") == TIMES
        [dropped] = router.events("message dropped")[:1]
        assert dropped["detail"] == "drive.right is missing; the board requires it"


def test_a_payload_before_another_one_is_counted_and_logged_as_superseded(tmp_path: Path) -> None:
    with site(tmp_path, {"basestation": "127.0.0.10", "board": "127.0.0.222"}) as place:
        table = place.table(TABLE + ROUTES)
        with RouterProcess(tmp_path, table) as router:
            place.send("basestation", STOP + COMPLETE)
            assert place.receive("board") == STOP + COMPLETE
            assert total(place.scrape(), "superseded_members", listener="rover") == 1
        [told] = router.events("datagram has several payloads; only the last one counts")
        assert str(told["detail"]).endswith(": stop, then drive")
