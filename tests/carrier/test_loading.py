"""What an image needs open goes along to the next one by key."""

from __future__ import annotations

import ctypes
from pathlib import Path

from router.carrier.deadmen import Deadmen
from router.carrier.loading import LoadedImage
from router.carrier.ring import Ring
from router.image.writer import write_image
from tests.carrier.serving_ros import Board
from tests.small_tables import program

HEAD = """version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {here: {address: 127.0.0.1:5000}}
endpoints:
  basestation: {address: 127.0.0.1:5001, kind: basestation}
  driving_board: {address: 127.0.0.2:5002, kind: tool}
routes:
"""
ROUTES = """\
  manual_drive:
    source: basestation
    destinations: [{endpoint: driving_board, max_rate: RATE}]
    deadman: {timeout: 1h, send: {manual_brake: {brake: true}}, to: [driving_board]}
"""


def test_what_has_the_same_key_is_the_same_object_in_the_next_image(library: ctypes.CDLL, tmp_path: Path) -> None:
    group = Deadmen(library, (ctypes.c_int64 * 1000)(), Ring(library, 1 << 12))
    senders = {"driving_board": Board(library)}

    def loaded(rate: str, generation: int, before: LoadedImage | None = None) -> LoadedImage:
        image = write_image(program(tmp_path, ROUTES.replace("RATE", rate), HEAD))
        return LoadedImage(library, image, senders, group.address, generation, before)

    first = loaded("1 Hz", 1)
    same = loaded("1 Hz", 2, first)
    assert same._opened == first._opened
    other = loaded("2 Hz", 3, same)
    assert other.deadmen == same.deadmen
    assert len(other._opened.items() - same._opened.items()) == 1  # the limit
    other.forget_before()
    senders["driving_board"] = Board(library)  # as after a change of its address
    assert loaded("2 Hz", 4, other).deadmen["manual_drive"] is not other.deadmen["manual_drive"]
