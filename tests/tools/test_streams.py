from __future__ import annotations

import math

import pytest

from router.engine.wire import Wire
from router.errors import UsageError
from router.tools.streams import Silence, Stream, parse_silence


@pytest.mark.parametrize(
    ("text", "silence"),
    [
        ("basestation:5-8", Silence("basestation", 5.0, 8.0)),
        ("manual_drive:0.5-", Silence("manual_drive", 0.5, math.inf)),
    ],
)
def test_a_silence_is_a_name_and_a_time(text: str, silence: Silence) -> None:
    assert parse_silence(text) == silence


@pytest.mark.parametrize("text", ["basestation", "basestation:5", ":5-8", "a:5-8-9", "a:b-c"])
def test_what_is_no_silence_is_explained(text: str) -> None:
    with pytest.raises(UsageError, match="such as basestation:5-8"):
        parse_silence(text)


def test_a_silence_covers_an_endpoint_or_a_case_from_its_start_until_before_its_end(wire: Wire) -> None:
    stream = Stream("station", wire.case("plain"), rate=1.0, offset=0.0)
    for name in ("station", "plain"):
        covered = [at for at in (4.9, 5.0, 7.9, 8.0) if Silence(name, 5.0, 8.0).covers(stream, at)]
        assert covered == [5.0, 7.9]
    assert not Silence("board", 5.0, 8.0).covers(stream, 6.0)
