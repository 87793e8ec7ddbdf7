from __future__ import annotations

from types import SimpleNamespace

from router.engine.wire import wire_of_protos
from router.tools.frames import TIMEOUT, Frames, is_part
from tests.tables import PROTOS


def part(frame_id: int, total_count: int, index: int) -> SimpleNamespace:
    return SimpleNamespace(frame_id=frame_id, total_count=total_count, index=index)


def counts(frames: Frames) -> tuple[int, int, int]:
    return frames.complete, frames.incomplete, frames.astray


def test_a_frame_is_complete_with_its_last_part_in_any_order() -> None:
    frames = Frames()
    for index in (2, 0, 0, 1):
        frames.take(0, part(7, 3, index))
    assert counts(frames) == (1, 0, 0)


def test_a_frame_that_lacks_a_part_is_given_up_in_time() -> None:
    frames = Frames()
    frames.take(5, part(7, 2, 1))
    frames.look(TIMEOUT)
    assert counts(frames) == (0, 0, 0)
    frames.look(5 + TIMEOUT)
    assert counts(frames) == (0, 1, 0)


def test_a_part_of_no_possible_frame_is_astray() -> None:
    frames = Frames()
    frames.take(0, part(7, 2, 2))
    frames.take(0, part(7, 0, 0))
    assert counts(frames) == (0, 0, 2)


def test_parts_are_known_by_their_fields() -> None:
    cases = wire_of_protos(PROTOS).envelope.cases
    assert [name for name, case in cases.items() if is_part(case.type)] == ["detected_object"]
