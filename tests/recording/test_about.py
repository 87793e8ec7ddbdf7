"""The metadata of a recording, and the part of its name that tells which deadmen tripped."""

from __future__ import annotations

from router.compiler import check_table
from router.recording.about import LONGEST_NAMES, about, reason_of, routes_of, tripped_in
from tests.tables import ROUTES


def test_the_name_has_all_deadmen_unless_that_is_too_long() -> None:
    assert reason_of(["drive"]) == "deadman-drive"
    assert reason_of(["winch", "arm"]) == "deadman-winch-arm"
    many = [f"route_number_{number}" for number in range(20)]
    assert reason_of(many) == "deadman-route_number_0-route_number_1-route_number_2-route_number_3-and-16-more"
    assert len(reason_of(["x" * 300, "y" * 300])) < LONGEST_NAMES + 30


def test_it_has_the_routes_of_the_table_and_their_deadmen() -> None:
    table = check_table(ROUTES / "sim.yaml").table
    assert table is not None
    found = about(table, "continuous")
    assert tripped_in(found) == []
    assert tripped_in(about(table, "deadman-a", ["a", "b"])) == ["a", "b"]
    routes = routes_of(found)
    assert set(routes) == {route.name for route in table.routes if route.ignore is None}
    drive = routes["drive_motor"]
    assert (drive.case, drive.is_from_ros, [*drive.brakes]) == ("drive_motor", True, ["driving_board"])
    assert drive.timeout_ms > 0
    assert routes_of({}) == {}
