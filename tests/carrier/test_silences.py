"""An endpoint that was silent is heard again: noted once, but not if pauses are its rhythm or the clock was set."""

from __future__ import annotations

from pathlib import Path

import pytest

from router.carrier.events import Returned
from router.carrier.simulation import Simulation
from router.compiler.compiled_table import CompiledTable
from router.library import library
from tests.small_tables import HEAD, MS, SECOND, SENSOR_BOARD, enveloped, program

ROUTE = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"
PH = enveloped(ph_info={})


class Heard:
    """One run, with the time in ms at which each endpoint sends."""

    def __init__(self, compiled: CompiledTable) -> None:
        self.compiled = compiled
        self.simulation = Simulation(library(), 10**12)
        self.simulation.adopt(compiled)
        self.returned: list[Returned] = []
        self.ahead = 0

    def hear(self, after: int, times: int = 1, sender: tuple[str, int] = SENSOR_BOARD) -> None:
        """Receive datagrams, each `after` this many ms."""
        for _ in range(times):
            self.simulation.advance(self.simulation.now + after * MS)
            self.simulation.datagram("trimmed", sender, PH, self.simulation.now + self.ahead)
            self.returned += [each for each in self.simulation.records() if isinstance(each, Returned)]

    def set_clock(self, ahead: int) -> None:
        self.ahead = ahead
        self.simulation.set_clock(ahead)

    def count(self, metric: str) -> int:
        counters = self.simulation.counters(len(self.compiled.counters.fresh_counts()))
        return counters[self.compiled.counters.index(metric, "sensor_board")]


@pytest.fixture
def heard(tmp_path: Path) -> Heard:
    return Heard(program(tmp_path, ROUTE))


def test_a_board_that_is_reset_leaves_a_trace(heard: Heard) -> None:
    heard.hear(20, 200)
    heard.hear(2300)
    heard.hear(20, 200)
    assert heard.returned == [Returned("sensor_board", 2.3)]
    heard.hear(2600)
    assert heard.returned == [Returned("sensor_board", 2.3), Returned("sensor_board", 2.6)]
    assert heard.count("endpoint_silences") == 2
    assert heard.count("endpoint_last_silence_seconds") == 2600 * MS
    assert heard.count("endpoint_silence_seconds") == heard.count("endpoint_heard_seconds") == heard.simulation.now


def test_short_pauses_and_slow_senders_have_no_silences(heard: Heard) -> None:
    heard.hear(1900, 20)
    heard.hear(3000, 20)
    assert len(heard.returned) == 1  # when its rhythm changed
    heard.returned.clear()
    heard.hear(3000, 20)
    assert heard.returned == []


def test_who_is_never_stale_is_never_silent(tmp_path: Path) -> None:
    board = "sensor_board: {address: 192.168.0.30:8, kind: board"
    assert board in HEAD
    heard = Heard(program(tmp_path, ROUTE, HEAD.replace(board, f"{board}, stale_after: never")))
    heard.hear(20, 300)
    heard.hear(5000)
    assert heard.returned == []


def test_a_clock_that_is_set_is_no_silence(heard: Heard) -> None:
    heard.hear(20, 300)
    for ahead in (3600 * SECOND, 0, -3600 * SECOND):
        heard.set_clock(ahead)
        heard.hear(20, 300)
        assert heard.count("endpoint_silence_seconds") == heard.simulation.now
    assert heard.returned == []
    heard.hear(2300)
    assert heard.returned == [Returned("sensor_board", 2.3)]
