"""What the status page is told: the numbers of the counters, the map of the table, and last values while it looks."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import pytest

from router.clock import boottime_ns
from router.compiler import check_table
from router.compiler.metrics import METRICS
from router.observe import last_values
from router.observe.responses import PAGE
from router.observe.status import IF_ANY, PATHS, Status
from router.observe.watch import Health
from tests.acceptance.site import wait_until
from tests.observe.fake_running import FakeHealth, FakeRunning, sim_program
from tests.tables import PROTOS

PROGRAM = sim_program()
BOARD, STRANGER = ("127.0.0.30", 25008), ("127.0.0.99", 1)


@pytest.fixture
def running() -> Iterator[FakeRunning]:
    opened = FakeRunning(PROGRAM)
    yield opened
    opened.mirror.close()
    assert opened.failures == []


@pytest.fixture
def shown(running: FakeRunning) -> Iterator[Status]:
    with closing(Status(running, cast("Health", FakeHealth(running)))) as opened:
        yield opened


def value(shown: Status, case: str) -> Any:
    """As soon as there is one."""
    wait_until(lambda: case in shown.numbers()["values"])
    return shown.numbers()["values"][case]


def imu(**fields: Any) -> bytes:
    return PROGRAM.envelopes.first.message_class(imu_info=fields).SerializeToString()


@pytest.mark.parametrize(
    "shared",
    [
        r"^const \$ = [^\n]*$",
        *(rf"^function {name}\(.*?^}}$" for name in ("make", "setText", "rulerOf", "sharedStart", "shortened")),
    ],
    ids=["$", "make", "setText", "rulerOf", "sharedStart", "shortened"],
)
def test_what_both_pages_have_is_the_same_in_both(shared: str) -> None:
    """Each page is one file, so that it needs nothing else; what they share must not drift apart."""
    pages = [file.read_text(encoding="utf-8") for file in (PAGE, PAGE.parents[1] / "gateway" / "page.html")]
    [status_page], [gateway_page] = (re.findall(shared, page, re.DOTALL | re.MULTILINE) for page in pages)
    assert status_page == gateway_page


def test_what_is_counted_is_found_by_route_and_target_and_endpoint(running: FakeRunning, shown: Status) -> None:
    running.count("messages_received", "imu_info", "sensor_board", to=9)
    running.count("datagrams_sent", "imu_info", "basestation", to=7)
    running.count("messages_dropped", "imu_info", "basestation", "send_error", to=2)
    running.count("messages_filtered", "imu_info", "imu_data", to=9)
    running.count("messages_split", "imu_info", "imu_data", to=4)
    running.count("route_silence_seconds", "imu_info", to=boottime_ns() - 3 * 10**9)
    running.count("endpoint_silence_seconds", "sensor_board", to=boottime_ns() - 2 * 10**9)
    found = shown.numbers()
    route = found["routes"]["imu_info"]
    assert route["sources"] == {"sensor_board": 9}
    assert route["targets"]["basestation"] == {"delivered": 7, "dropped": {"send_error": 2}}
    assert route["targets"]["imu_data"] == {"delivered": 0, "dropped": {}, "filtered": 9, "split": 4}
    assert (route["silence"], route["buckets"][-1]) == (pytest.approx(3, abs=1), ["+Inf", 0])
    assert found["endpoints"]["sensor_board"] == {"silence": pytest.approx(2, abs=1), "stale_after": 5}


def test_every_series_that_the_page_knows_exists() -> None:
    """A renamed metric would be a number that never moves."""
    assert PATHS.keys() <= {metric.name for metric in METRICS}
    assert PATHS.keys() >= IF_ANY


def test_every_line_of_the_map_has_its_numbers(shown: Status) -> None:
    drawn, said = (json.loads(json.dumps(each, allow_nan=False)) for each in (shown.map(), shown.numbers()))
    columns = {node["key"]: node["column"] for node in drawn["nodes"]}
    assert drawn["map"] == said["map"]
    for link in drawn["links"]:
        side = "sources" if columns[link["end"]] == 1 else "targets"
        assert link["label"] in said["routes"][link["route"]][side], link


def test_the_map_says_what_the_page_leads_to_and_what_endpoints_are(shown: Status) -> None:
    drawn = shown.map()
    assert (drawn["name"], drawn["node"], drawn["keeps"]) == ("sim.yaml", "rover_router", None)
    assert drawn["pages"] == {"dashboard": ["127.0.0.1", 28765]}
    [drive] = [each for each in drawn["deadmen"] if each["route"] == "manual_drive"]
    assert (drive["start"], drive["end"], drive["label"]) == ("case:manual_drive", "to:@driving_board", "driving_board")
    assert drive["about"] == "the deadman sends manual_brake"
    board = next(node for node in drawn["nodes"] if node["key"] == "from:@sensor_board")
    assert (board["address"], board["role"]) == ("127.0.0.30:25008", "board")


ALSO_HALTED = f"""\
version: 1
envelope: {{protos: {PROTOS}, message: PBEnvelope, oneof: payload}}
listen: {{here: {{address: 127.0.0.1:25000}}}}
endpoints:
  basestation: {{address: 127.0.0.10:9, kind: tool}}
  driving_board: {{address: 127.0.0.20:9, kind: board}}
  arm_board: {{address: 127.0.0.30:9, kind: board}}
routes:
  manual_drive:
    source: basestation
    destinations: driving_board
    ttl: 200ms
    deadman: {{timeout: 1s, send: {{manual_brake: {{brake: true}}}}, to: [driving_board, arm_board]}}
"""


def test_the_map_has_a_board_that_only_a_deadman_sends_to(tmp_path: Path) -> None:
    table = tmp_path / "table.yaml"
    table.write_text(ALSO_HALTED)
    program = check_table(table).program
    assert program is not None
    running = FakeRunning(program)
    with closing(Status(running, cast("Health", FakeHealth(running)))) as shown:
        drawn = shown.map()
    running.mirror.close()
    assert [each["end"] for each in drawn["deadmen"]] == ["to:@driving_board", "to:@arm_board"]
    assert [node["key"] for node in drawn["nodes"] if node["column"] == 2] == ["to:@driving_board", "to:@arm_board"]


def test_the_numbers_of_the_last_seconds_have_what_the_page_compares(running: FakeRunning, shown: Status) -> None:
    running.count("messages_received", "imu_info", "sensor_board", to=9)
    running.count("messages_filtered", "imu_info", "imu_data", to=3)
    running.count("deadman_datagrams_sent", "manual_drive", "driving_board", to=2)
    found, after = shown.recent()["numbers"], shown.numbers()
    assert [each["at"] for each in found] == sorted(each["at"] for each in found)
    assert found[-1]["at"] == pytest.approx(after["at"], abs=1)
    assert found[0]["routes"]["imu_info"]["sources"] == {"sensor_board": 0}
    newest = found[-1]["routes"]
    assert newest["imu_info"]["sources"] == {"sensor_board": 9}
    assert newest["imu_info"]["targets"] == after["routes"]["imu_info"]["targets"]
    assert newest["manual_drive"]["deadman_sent"] == {"driving_board": 2}


def test_the_map_says_how_much_can_be_saved(running: FakeRunning) -> None:
    with closing(Status(running, cast("Health", FakeHealth(running)), can_save=True)) as shown:
        assert shown.map()["keeps"] == 60.0


def test_a_last_value_comes_from_what_is_received_while_somebody_looks(running: FakeRunning, shown: Status) -> None:
    running.receive(imu(accel_x=1.0), BOARD)
    assert shown.numbers()["values"] == {}  # nobody was looking
    running.receive(imu(accel_x=1.5), BOARD)
    found = value(shown, "imu_info")
    assert (found["source"], found["fields"]["accel_x"], found["fields"]["accel_y"]) == ("sensor_board", 1.5, 0.0)


def test_what_no_route_took_is_no_last_value(running: FakeRunning, shown: Status) -> None:
    shown.numbers()
    running.receive(imu(accel_x=1.5), BOARD)
    running.receive(imu(accel_x=66.0), STRANGER, reason="source_mismatch")
    found = value(shown, "imu_info")
    running.receive(imu(accel_x=66.0), STRANGER, reason="source_mismatch")
    wait_until(lambda: not running.waiting)
    assert [found, value(shown, "imu_info")] == [found] * 2
    assert (found["source"], found["fields"]["accel_x"]) == ("sensor_board", 1.5)


def test_a_strangers_value_is_shown_with_where_it_is_from_and_a_trimmed_one_as_the_router_reads_it(
    running: FakeRunning, shown: Status
) -> None:
    shown.numbers()
    running.receive(b"junk", STRANGER, reason="malformed")
    running.receive(imu(accel_x=2.0).rstrip(b"\0"), STRANGER)
    found = value(shown, "imu_info")
    assert (found["source"], found["fields"]["accel_x"]) == ("127.0.0.99:1", 2.0)


def test_long_values_are_cut() -> None:
    kept = last_values.shortened({"a": list(range(100)), "b": "x" * 1000, "c": {"d": [{"e": 1}]}})
    assert kept["a"][-1] == "and 76 more"
    assert kept["b"].endswith("… (1000 characters)")
    assert kept["c"] == {"d": [{"e": 1}]}


def test_the_mirror_is_left_alone_when_nobody_looks_any_more(
    running: FakeRunning, shown: Status, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(last_values, "LOOKED_AT_SECONDS", 0.1)
    shown.numbers()
    wait_until(lambda: not running.mirror.is_observed, "the end of the look")
    monkeypatch.setattr(last_values, "LOOKED_AT_SECONDS", 3600)
    shown.numbers()
    assert running.mirror.is_observed
