"""States outlast reloads, but not restarts; threads that read one get a value that belongs to its time."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from router.carrier.events import CountedReport, StateChange
from router.carrier.simulation import Simulation
from router.compiler.compiled_table import CompiledTable
from router.library import library
from tests.carrier.building import RACES, run_program
from tests.small_tables import BASESTATION, HEAD, MS, SECOND, enveloped, program

ROUTE = "  control_mode: {source: basestation}\n"
NO_ROUTE = "  control_mode: {ignore: only topics set states here}\n"
MODE = "mode: {case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL, valid_for: 5s}"
MANUAL, AUTO = 0, 1


class States:
    """A run of a table with one state; `changes` are those since the last call of `run`."""

    def __init__(self, folder: Path, state: str = MODE, route: str = ROUTE) -> None:
        self.folder, self.route = folder, route
        self.compiled = self._program(state)
        self.simulation = Simulation(library(), 10**12)
        self.simulation.adopt(self.compiled)

    def _program(self, state: str) -> CompiledTable:
        return program(self.folder, f"{self.route}state:\n  {state}\n", HEAD)

    def set(self, mode: int) -> None:
        data = enveloped(control_mode={"mode": mode})
        self.simulation.datagram("exact", BASESTATION, data, self.simulation.now)

    def reload(self, state: str) -> None:
        self.compiled = self._program(state)
        self.simulation.adopt(self.compiled)

    def changes(self, after: int = 0) -> list[StateChange]:
        self.simulation.advance(self.simulation.now + after)
        return [each for each in self.simulation.records() if isinstance(each, StateChange)]

    def count(self, metric: str, *labels: str) -> int:
        index = self.compiled.counters.index(metric, "mode", *labels)
        return self.simulation.counters(index + 1)[index]


def test_changes_are_reported_and_counted(tmp_path: Path) -> None:
    states = States(tmp_path)
    assert states.count("state") == MANUAL
    states.set(AUTO)
    states.set(AUTO)
    assert states.changes() == [StateChange("mode", MANUAL, AUTO, "basestation")]
    assert states.count("state") == AUTO
    assert states.count("state_set_seconds", "basestation") == states.simulation.now
    assert states.changes(5 * SECOND) == []
    assert states.changes(1) == [StateChange("mode", AUTO, MANUAL, None)]
    assert states.count("state") == MANUAL
    assert states.count("state_changes") == 2


def test_a_message_without_a_value_is_reported_with_its_place(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.set(7)
    [report] = [each.report for each in states.simulation.records() if isinstance(each, CountedReport)]
    assert (report.place, report.target, report.reason) == ("control_mode", "state.mode", "mapping_error")
    assert report.detail.endswith(": state: the enum has no value 7")
    assert f"{tmp_path / 'table.yaml'}:" in report.detail


def test_a_reload_keeps_a_state_by_name_and_type(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.set(AUTO)
    states.changes(SECOND)
    states.reload(MODE.replace("MODE_MANUAL", "MODE_AUTO").replace("5s", "3s"))
    assert states.changes() == []
    assert states.count("state") == AUTO
    states.reload(MODE.replace("5s", "2s"))
    assert states.changes(SECOND) == []
    assert states.changes(1) == [StateChange("mode", AUTO, MANUAL, None)]  # with the time of the running table


def test_a_reload_applies_another_initial_value(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.reload(MODE.replace("MODE_MANUAL", "MODE_AUTO"))
    assert states.changes() == [StateChange("mode", MANUAL, AUTO, None)]


def test_a_state_of_another_type_begins_anew(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.set(AUTO)
    states.reload("mode: {case: control_mode, source: basestation, value: int(mode), initial: 5, valid_for: 5s}")
    assert states.count("state") == 5
    states.reload(MODE)
    assert states.count("state") == MANUAL


def test_a_reload_can_remove_a_state_that_would_expire(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.set(AUTO)
    states.changes()
    states.reload("other: {case: control_mode, source: basestation, value: mode, initial: MODE_MANUAL}")
    states.reload("other: {case: control_mode, source: basestation, value: mode, initial: MODE_AUTO}")
    assert states.changes(10 * SECOND) == [StateChange("other", MANUAL, AUTO, None)]


def test_a_restart_begins_with_the_initial_value(tmp_path: Path) -> None:
    states = States(tmp_path)
    states.set(AUTO)
    states.changes()
    states.simulation.restart(10**12)
    assert states.changes(6 * SECOND) == []
    assert states.count("state") == MANUAL


def test_a_value_that_never_expires_stays(tmp_path: Path) -> None:
    states = States(tmp_path, MODE.replace("5s", "never"))
    states.set(AUTO)
    states.changes()
    assert states.changes(10**6 * SECOND) == []
    assert states.count("state") == AUTO


def test_a_negative_value_is_counted_as_such(tmp_path: Path) -> None:
    states = States(tmp_path, "mode: {case: control_mode, source: basestation, value: -int(mode), initial: -3}")
    assert states.count("state") == -3
    states.set(AUTO)
    assert states.changes(MS) == [StateChange("mode", -3, -1, "basestation")]
    assert states.count("state") == -1


@pytest.mark.parametrize("sanitizers", ["", pytest.param(RACES, marks=pytest.mark.slow)])
def test_readers_get_a_value_with_its_own_time(tmp_path: Path, sanitizers: str) -> None:
    run_program("states", tmp_path, 20_000 if sanitizers else 200_000, sanitizers=sanitizers)


def test_messages_of_a_topic_set_a_state(tmp_path: Path) -> None:
    mode = "mode: {topic: mode/set, type: std_msgs/msg/Int8, value: data, initial: -1, valid_for: 5s}"
    states = States(tmp_path, mode, NO_ROUTE)
    states.simulation.message("mode/set", b"\0\1\0\0\3", states.simulation.now)
    assert states.changes() == [StateChange("mode", -1, 3, "mode/set")]
    assert states.count("state_set_seconds", "mode/set") == states.simulation.now
    states.simulation.message("mode/set", b"\0\1\0\0", states.simulation.now)
    [report] = [each.report for each in states.simulation.records() if isinstance(each, CountedReport)]
    assert (report.place, report.target, report.reason) == ("state.mode", "state.mode", "mapping_error")
    assert states.changes(5 * SECOND) == []
    assert states.changes(1) == [StateChange("mode", 3, -1, None)]


DRIVER = "mode: {topic: driver, type: std_msgs/msg/String, value: data, initial: \"'nobody'\", valid_for: 5s}"


def named(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def test_a_reload_keeps_a_text_by_name_and_type(tmp_path: Path) -> None:
    states = States(tmp_path, DRIVER, NO_ROUTE)
    states.simulation.message("driver", named("the operator on the second floor"), states.simulation.now)
    assert states.changes(SECOND) == [StateChange("mode", "nobody", "the operator on the second floor", "driver")]
    states.reload(DRIVER.replace("nobody", "autopilot").replace("5s", "2s"))
    assert states.changes(SECOND) == []
    assert states.changes(1) == [StateChange("mode", "the operator on the second floor", "autopilot", None)]
    states.reload(DRIVER)
    assert states.changes() == [StateChange("mode", "autopilot", "the operator on the second floor", None)]
    states.reload(DRIVER.replace("value: data", "value: -len(data)").replace("\"'nobody'\"", "-1"))
    assert states.count("state") == -1
    states.reload(DRIVER)
    assert states.changes() == []


def test_a_text_that_is_too_long_is_reported_with_its_place(tmp_path: Path) -> None:
    states = States(tmp_path, DRIVER, NO_ROUTE)
    states.simulation.message("driver", named("the operator on the second floor!"), states.simulation.now)
    [report] = [each.report for each in states.simulation.records() if isinstance(each, CountedReport)]
    assert (report.target, report.reason) == ("state.mode", "mapping_error")
    assert report.detail.endswith(": state: 33 bytes, but at most 32 fit")


def test_a_message_of_a_topic_counts_from_its_stamp(tmp_path: Path) -> None:
    mode = "mode: {topic: at, type: geometry_msgs/msg/PointStamped, value: trunc(point.x), initial: -1, valid_for: 5s}"
    states = States(tmp_path, mode, NO_ROUTE)
    header = struct.pack("<iII4x", states.simulation.now // SECOND - 3, 0, 1)
    states.simulation.message("at", b"\0\1\0\0" + header + struct.pack("<3d", 8, 0, 0), states.simulation.now)
    assert states.changes(2 * SECOND) == [StateChange("mode", -1, 8, "at")]
    assert states.changes(1) == [StateChange("mode", 8, -1, None)]
