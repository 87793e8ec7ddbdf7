"""Messages that wait for a bandwidth or for `on_limit: latest`: deadmen hear of commands when they leave, not before,
and a reload keeps what the next table holds back as well.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from router.carrier.events import DeadmanChange
from router.carrier.simulation import Output, Simulation, Time
from router.compiler.compiled_table import CompiledTable
from tests.envelopes import LEN, framed, tag, varint
from tests.small_tables import BASESTATION, BRAKE, HEAD, MS, SECOND, SENSOR_BOARD, Ledger, enveloped, program

FAR = "  far_board: {address: 192.168.0.70:8, kind: tool, bandwidth: 10kB/s}\nroutes:"
TURN = enveloped(manual_drive={"turn": 5})
DEADMAN = "deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [far_board]"
PACED = f"""\
  manual_drive:
    - source: basestation
      destinations: [far_board]
      priority: command
      ttl: 200ms
      {DEADMAN}, disarmed_by: [pump_info]}}
  ph_info: {{source: sensor_board, destinations: [far_board], priority: bulk, deadman: {{none: no command at all}}}}
  pump_info: {{source: sensor_board, destinations: [far_board], priority: command, ttl: 200ms,
    deadman: {{none: large commands}}}}
"""
HELD = f"""\
  manual_drive:
    source: basestation
    destinations: [{{endpoint: far_board, max_rate: 3 Hz, on_limit: latest}}]
    ttl: 400ms
    {DEADMAN}}}
"""


def table(folder: Path, routes: str, far: str = FAR) -> CompiledTable:
    return program(folder, routes, HEAD.replace("routes:", far))


class Rehearsing:
    """A simulation with its `outputs` by time and target, and the `changes` of its deadmen."""

    def __init__(self, library: ctypes.CDLL, made: CompiledTable) -> None:
        self._stage = Simulation(library)
        self.outputs: list[tuple[int, str, bytes]] = []
        self.changes: list[tuple[str, bool]] = []
        self._at = 0
        self.reload(made)

    @property
    def now(self) -> int:
        return self._stage.now

    def reload(self, made: CompiledTable) -> None:
        self.program = made
        self._stage.adopt(made)
        self._collect()

    def receive(self, data: bytes, peer: tuple[str, int] = SENSOR_BOARD) -> None:
        self._stage.datagram("trimmed", peer, data, self._stage.now)
        self._collect()

    def pass_time(self, ns: int) -> None:
        self._stage.advance(self._stage.now + ns)
        self._collect()

    def end(self) -> None:
        self._stage.end()
        self._collect()

    def _collect(self) -> None:
        for record in self._stage.records():
            if isinstance(record, Time):
                self._at = record.at
            elif isinstance(record, Output):
                self.outputs.append((self._at, record.target, record.data))
            elif isinstance(record, DeadmanChange):
                self.changes.append((record.route, record.is_tripped))

    @property
    def sent(self) -> list[bytes]:
        return [data for _, _, data in self.outputs]

    def many(self, data: bytes) -> int:
        return self.sent.count(data)

    def dropped(self, route: str, target: str) -> dict[str, int]:
        found = self._ledger().counted("messages_dropped").items()
        return {labels[3]: count for labels, count in found if labels[1:3] == (route, target)}

    def assert_counters_balance(self) -> None:
        """But for the histogram: a simulation measures no durations."""
        assert [found for found in self._ledger().imbalances() if "histogram" not in found] == []

    def _ledger(self) -> Ledger:
        return Ledger(self.program, self._stage.counters(len(self.program.counters.fresh_counts())))


Rehearse = Callable[..., Rehearsing]


@pytest.fixture
def rehearse(library: ctypes.CDLL, tmp_path: Path) -> Rehearse:
    return lambda routes, far=FAR: Rehearsing(library, table(tmp_path, routes, far))


@pytest.fixture
def paced(rehearse: Rehearse) -> Rehearsing:
    return rehearse(PACED)


def large(paced: Rehearsing, case: str, size: int) -> bytes:
    """A payload whose only field nobody knows."""
    return framed(paced.program.envelopes.numbers[case], tag(30, LEN) + varint(size) + bytes(size))


def drives(simulation: Rehearsing, ns: int) -> None:
    """20 commands per second, of the operator."""
    for _ in range(ns // (50 * MS)):
        simulation.receive(TURN, BASESTATION)
        simulation.pass_time(50 * MS)


# ---- deadmen


def test_a_command_in_the_queue_is_dropped_when_another_route_takes_over(rehearse: Rehearse) -> None:
    """Else it would leave after the newer command, which has priority."""
    paced = rehearse(PACED.replace("priority: command", "priority: bulk", 1))
    paced.receive(large(paced, "pump_info", 1400))
    paced.receive(TURN, BASESTATION)  # waits for the bandwidth
    paced.pass_time(10 * MS)
    paced.receive(enveloped(pump_info={}))
    assert paced.dropped("manual_drive", "far_board")["superseded"] == 1
    paced.pass_time(SECOND)
    assert paced.many(TURN) == 0
    paced.receive(TURN, BASESTATION)
    paced.pass_time(10 * MS)
    assert paced.many(TURN) == 1
    paced.assert_counters_balance()


def test_commands_beside_more_bulk_than_the_budget_are_neither_late_nor_stale(paced: Rehearsing) -> None:
    bulk = large(paced, "ph_info", 15_000)
    for _ in range(20):
        paced.receive(bulk)
        for _ in range(10):
            before = paced.many(TURN)
            paced.receive(TURN, BASESTATION)
            assert paced.many(TURN) == before + 1
            paced.pass_time(50 * MS)
    assert paced.dropped("manual_drive", "far_board") == {}
    assert paced.changes == []
    assert paced.many(bulk) * len(bulk) == pytest.approx(90_000, abs=15_001)
    paced.pass_time(100 * SECOND)
    paced.assert_counters_balance()


def test_it_trips_when_all_commands_are_dropped(rehearse: Rehearse) -> None:
    """Another source's command takes the commands' part of the budget for almost three seconds."""
    simulation = rehearse(PACED.replace(", disarmed_by: [pump_info]", ""), FAR.replace("10kB/s", "5kB/s"))
    drives(simulation, SECOND)
    simulation.receive(large(simulation, "pump_info", 16_000), SENSOR_BOARD)
    drives(simulation, 2 * SECOND)

    assert simulation.changes == [("manual_drive", True)]
    assert simulation.many(BRAKE) == 16
    assert simulation.dropped("manual_drive", "far_board")["stale"] >= 36
    drives(simulation, 2 * SECOND)
    assert simulation.changes == [("manual_drive", True), ("manual_drive", False)]
    assert simulation.sent[-1] == TURN
    simulation.pass_time(SECOND)
    simulation.assert_counters_balance()


def test_one_that_takes_over_disarms_it_when_it_leaves_and_not_when_it_is_dropped(paced: Rehearsing) -> None:
    """After a large command, the next one is stale before it may leave."""
    large_turn, large_pump = (large(paced, case, 16_000) for case in ("manual_drive", "pump_info"))
    paced.receive(large_turn, BASESTATION)
    paced.receive(large(paced, "pump_info", 0))
    paced.pass_time(500 * MS)
    assert paced.dropped("pump_info", "far_board") == {"stale": 1}
    assert paced.changes == [("manual_drive", True)]

    paced.pass_time(2 * SECOND)
    paced.receive(large_pump)
    assert paced.changes == [("manual_drive", True), ("manual_drive", False)]
    paced.receive(TURN, BASESTATION)
    paced.pass_time(SECOND)
    assert paced.dropped("manual_drive", "far_board") == {"stale": 1}
    assert len(paced.changes) == 2


def test_what_is_held_back_for_a_rate_feeds_it_when_it_leaves(rehearse: Rehearse) -> None:
    simulation = rehearse(HELD)
    simulation.receive(TURN, BASESTATION)
    simulation.pass_time(100 * MS)
    simulation.receive(TURN, BASESTATION)  # held back until 167 ms
    simulation.pass_time(501 * MS)
    assert simulation.sent == [TURN, TURN]
    assert simulation.changes == []
    simulation.pass_time(67 * MS)
    assert simulation.changes == [("manual_drive", True)]


# ---- boards


def test_what_a_board_cannot_take_does_not_replace_what_is_held(rehearse: Rehearse) -> None:
    simulation = rehearse(
        "  imu_info: {source: sensor_board, destinations: [{endpoint: far_board, max_rate: 1 Hz, on_limit: latest}]}\n",
        FAR.replace("tool", "board").replace(", bandwidth: 10kB/s", ""),
    )
    first, good, bad = (enveloped(imu_info={"accel_x": value}) for value in (1, 2, float("nan")))
    for datagram in (first, good, bad):
        simulation.receive(datagram, SENSOR_BOARD)
    simulation.pass_time(2 * SECOND)
    assert simulation.sent == [first, good]
    assert simulation.dropped("imu_info", "far_board") == {"non_finite": 1}


def test_what_waits_for_a_bandwidth_has_lost_its_trailing_zeros(rehearse: Rehearse) -> None:
    """So it is charged as it is sent."""
    simulation = rehearse(
        "  ph_info: {source: sensor_board, destinations: [far_board]}\n",
        FAR.replace("10kB/s", "1kB/s, trim_trailing_zeros: true"),
    )
    datagrams = [framed(1, tag(30, LEN) + varint(size) + b"\1" + bytes(size - 1)) for size in (500, 501)]
    number = large(simulation, "ph_info", 0)[0]
    for datagram in datagrams:
        simulation.receive(bytes([number]) + datagram[1:])
    simulation.end()
    assert [len(data) < 20 for data in simulation.sent] == [True, True]


# ---- reloads

OTHER = "  gps_info: {source: sensor_board, destinations: [recorder]}\n"
PH = "  ph_info: {source: sensor_board, destinations: [far_board]}\n"
SLOW = FAR.replace("10kB/s", "1kB/s")


def numbered(number: int) -> bytes:
    return enveloped(ph_info={"ph_value": float(number)})


def test_what_waits_for_a_bandwidth_goes_along_to_the_next_program(rehearse: Rehearse, tmp_path: Path) -> None:
    simulation = rehearse(PH, SLOW)
    for number in range(1, 101):
        simulation.receive(numbered(number))
    before = len(simulation.outputs)
    for more in (OTHER, "", OTHER):
        simulation.reload(table(tmp_path, PH.replace("[far_board]}", "[far_board], priority: bulk}") + more, SLOW))
    assert len(simulation.outputs) == before < 100
    simulation.pass_time(10 * SECOND)
    assert simulation.sent == [numbered(number) for number in range(1, 101)]
    simulation.assert_counters_balance()


@pytest.mark.parametrize(
    ("routes", "far"),
    [
        (PH, SLOW.replace("1kB/s", "2kB/s")),
        (PH, SLOW.replace(", bandwidth: 1kB/s", "")),
        (PH, SLOW.replace("70:8", "71:8")),
        (PH.replace("ph_info", "pump_info"), SLOW),
        (OTHER, SLOW),
        ("  ph_info: {source: basestation, destinations: [far_board]}\n", SLOW.replace("far_board", "other_board")),
    ],
    ids=["bandwidth", "no bandwidth", "address", "another route", "no route", "no endpoint"],
)
def test_what_the_next_program_does_not_hold_leaves_before_its_own(
    rehearse: Rehearse, tmp_path: Path, routes: str, far: str
) -> None:
    simulation = rehearse(PH, SLOW)
    for number in range(1, 101):
        simulation.receive(numbered(number))
    assert len(simulation.outputs) < 100
    routes = routes.replace("far_board", "other_board") if "other_board" in far else routes
    simulation.reload(table(tmp_path, routes, far))
    assert simulation.sent == [numbered(number) for number in range(1, 101)]
    simulation.receive(numbered(101), BASESTATION if "basestation" in routes else SENSOR_BOARD)
    simulation.pass_time(SECOND)
    assert simulation.sent[:100] == [numbered(number) for number in range(1, 101)]


def test_a_command_that_is_held_in_a_reload_feeds_the_deadman_of_the_next_program(
    rehearse: Rehearse, tmp_path: Path
) -> None:
    simulation = rehearse(HELD)
    simulation.receive(TURN, BASESTATION)
    simulation.pass_time(100 * MS)
    simulation.receive(TURN, BASESTATION)  # held back until 167 ms
    simulation.reload(table(tmp_path, HELD.replace("500ms", "450ms")))
    simulation.pass_time(510 * MS)
    assert simulation.sent == [TURN, TURN]
    assert simulation.changes == []
    simulation.pass_time(10 * MS)
    assert simulation.changes == [("manual_drive", True)]


def test_what_is_held_of_a_route_that_goes_leaves_before_the_last_brake(rehearse: Rehearse, tmp_path: Path) -> None:
    simulation = rehearse(HELD)
    simulation.receive(TURN, BASESTATION)
    simulation.pass_time(100 * MS)
    simulation.receive(TURN, BASESTATION)
    simulation.reload(table(tmp_path, OTHER, FAR))
    assert simulation.sent == [TURN, TURN, BRAKE]
    simulation.pass_time(SECOND)
    assert Counter(simulation.sent) == {TURN: 2, BRAKE: 1}


def test_at_the_stop_what_waits_leaves_before_the_last_brake(paced: Rehearsing) -> None:
    bulk = large(paced, "ph_info", 15_000)
    paced.receive(TURN, BASESTATION)
    paced.receive(bulk)
    paced.end()
    assert paced.sent == [TURN, bulk, BRAKE]
