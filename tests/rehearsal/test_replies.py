"""Two routers that answer each other soon stop, or go on slowly: `max_rate` of a reply is what ends it."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.compiler import check_table
from router.rehearsal.rehearsal import START, Rehearsal, Sent
from tests.rehearsal.test_tables import TABLES

TABLE = """
version: 1
envelope: {protos: PROTOS, message: Frame, oneof: payload}
listen: {rover: {address: "127.0.0.1:5000"}}
endpoints: {other: {address: "127.0.0.2:5000", kind: tool}}
routes:
  connect: {source: other, reply: REPLY}
"""
MS = 1_000_000
SECONDS = 10


def exchanged(folder: Path, reply: str, delay: int) -> int:
    """Return how many datagrams two routers send each other in SECONDS after a single one; each takes `delay`."""
    path = folder / "table.yaml"
    path.write_text(TABLE.replace("PROTOS", str(TABLES / "reply")).replace("REPLY", reply))
    program = check_table(path, {}).program
    assert program is not None
    routers = Rehearsal(program), Rehearsal(program)
    data, now, sent = bytes.fromhex("1200"), START, 0
    while now < START + SECONDS * 1000 * MS:
        now += delay
        router = routers[sent % 2]
        router.advance(now)
        router.events.clear()
        router.datagram("rover", ("127.0.0.2", 5000), data)
        replies = [event.data for event in router.events if isinstance(event, Sent)]
        if not replies:
            break
        [data] = replies
        sent += 1
    return sent


@pytest.mark.parametrize(("delay", "most"), [(MS // 10, 2), (5 * MS, 2), (30 * MS, SECONDS * 20 * 2 + 2)])
def test_two_routers_do_not_answer_each_other_without_limit(tmp_path: Path, delay: int, most: int) -> None:
    assert 2 <= exchanged(tmp_path, "{connect: {sender: ROVER}}", delay) <= most


def test_a_condition_ends_it_at_once(tmp_path: Path) -> None:
    reply = "{case: connect, fields: {sender: ROVER}, when: sender != Device.ROVER}"
    assert exchanged(tmp_path, reply, 100 * MS) == 1
