"""The tables that other tests rely on: the targets of each payload case, and SI units in standard messages."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import NavSatFix, NavSatStatus

from router.compiler import check_table
from router.compiler.compiled_table import CompiledTable
from router.rehearsal.rehearsal import Dropped, Published, Rehearsal
from router.table.model import RouteTable
from router.table.model.gateways import Transport
from router.table.model.routes import Route
from tests.small_tables import SENSOR_BOARD
from tests.tables import ROUTES

Publish = Callable[..., dict[str, bytes]]
EPHEMERAL = 32_768
"""First ephemeral port of Linux."""

# As in the system's list of payload cases: H is a hardware board, R is ROS on the rover, B is the basestation.
DIRECTIONS = """
    ph_info H to R (and B) sensor
    arm_ctrl R to H arm
    arm_diag H to R (and B) arm
    arm_feedback H to R arm
    arm_pos H to R (and B) arm
    arm_target R to H arm
    arm_obstructions H to R arm
    drive_diag H to R (and B) driving
    drive_motor R to H driving
    drive_progress H to R driving
    sensor_diag H to R (and B) sensor
    gps_info H to R (and B) sensor
    imu_info H to R (and B) sensor
    load_cell_info H to R (and B) sensor
    pressure_info H to R (and B) sensor
    control_mode B to R
    detected_object R to B
    object_selection B to R
    rock_measure_request B to R
    rock_measure_result R to B
    rover_localization R to B
    flow_sensor_info H to R (and B) sensor
    pump_info H to R (and B) sensor
    manual_drive B to H (and R) driving
    manual_brake B to H (and R) driving
    manual_arm B to H (and R) arm
"""
EXISTING_TOPICS = {
    "imu_data": ("comms/msg/ImuSensorInformation", 10),
    "gps_data": ("comms/msg/SensorBoardGPSInfo", 10),
    "ph_data": ("comms/msg/SensorBoardPHInfo", 10),
    "sensor_board_diagnostics": ("comms/msg/SensorBoardDiagnostics", 10),
}


def program_of(name: str) -> CompiledTable:
    checked = check_table(ROUTES / name, environ={})
    assert [str(finding) for finding in checked.diagnostics] == []
    assert checked.program is not None
    return checked.program


@pytest.fixture(scope="module")
def rover() -> CompiledTable:
    return program_of("rover.yaml")


def depths(table: RouteTable) -> dict[str, tuple[str, int | None]]:
    return {
        topic.topic.value: (topic.type_name, topic.queue_depth.value if topic.queue_depth else None)
        for route in table.routes
        for topic in route.all_topics
    }


def flow(route: Route) -> tuple[set[str], set[str], bool]:
    """The sources and destinations of a payload case, and whether it is published to ROS."""
    return (
        {source.value for source in route.sources} or {"ros"},
        {destination.endpoint.value for destination in route.destinations},
        bool(route.topics),
    )


@pytest.mark.parametrize("line", DIRECTIONS.strip().splitlines())
def test_rover_table_follows_the_list_of_directions(rover: CompiledTable, line: str) -> None:
    case, source, _, target, *rest = line.split()
    ends = {"H": f"{rest[-1] if rest else ''}_board", "B": "basestation", "R": "ros"}
    also = {ends[rest[1][0]]} if "(and" in rest else set()
    targets = {ends[target]} | also

    route = next(route for route in rover.table.routes if route.case.value == case)
    assert flow(route) == ({ends[source]}, targets - {"ros"}, "ros" in targets)


def test_rover_table_keeps_the_existing_topics_and_names_the_others_after_their_case(rover: CompiledTable) -> None:
    topics = depths(rover.table)
    assert topics.items() >= EXISTING_TOPICS.items()
    for route in rover.table.routes:
        plain = [topic.topic.value for topic in route.all_topics if topic.type_name.startswith("comms/")]
        assert len(plain) == 1
        named = route.case.value + "s" * (route.for_each is not None)
        assert plain[0] == named or plain[0] in EXISTING_TOPICS


def test_commands_that_move_the_rover_go_stale_and_have_a_deadman(rover: CompiledTable) -> None:
    brakes = ["manual_brake {brake: true}"]
    stops = {
        "drive_motor": (brakes, ("driving_board",), ["manual_drive"]),
        "manual_drive": (brakes, ("driving_board",), ["drive_motor"]),
        "manual_arm": (["manual_arm"], ("arm_board",), ["arm_ctrl", "arm_target"]),
    }
    routes = {route.name: route for route in rover.table.routes}
    assert {name for name, route in routes.items() if route.deadman} == set(stops)
    for name, (sent, to, others) in stops.items():
        deadman, ttl = routes[name].deadman, routes[name].ttl
        assert deadman is not None
        assert [*map(str, deadman.payloads)] == sent
        assert tuple(endpoint.value for endpoint in deadman.to) == to
        assert [other.value for other in deadman.disarmed_by or ()] == others
        assert ttl is not None
        assert ttl.value < deadman.timeout.value
    moving = {*stops, "arm_ctrl", "arm_target"}
    assert {name for name, route in routes.items() if route.ttl} == moving


def test_simulation_table_is_the_rover_on_loopback_addresses_of_its_own(rover: CompiledTable) -> None:
    table = program_of("sim.yaml").table
    addresses = [endpoint.address.value for endpoint in table.endpoints.values()]
    addresses += [listener.address.value for listener in table.listeners.values()]
    assert all(address.host.startswith("127.") for address in addresses)
    assert len({address.host for address in addresses}) == len(addresses)
    assert list(map(flow, table.routes)) == list(map(flow, rover.table.routes))
    assert depths(table) == depths(rover.table)


def test_a_browser_finds_the_rover_and_can_only_move_a_simulated_one(rover: CompiledTable) -> None:
    (watched,), (tried,) = ([*table.gateways.values()] for table in (rover.table, program_of("sim.yaml").table))
    assert (watched.transport.value, watched.inbound) == (Transport.WEBSOCKET, ())
    assert watched.address is not None
    assert watched.address.value.host == "0.0.0.0"
    assert tried.address is not None
    assert tried.address.value.host == "127.0.0.1"
    assert tried.address.value.port < EPHEMERAL
    commanded = {topic.topic.value for route in rover.table.routes for topic in route.source_topics}
    for inbound in tried.inbound:
        assert inbound.topic.topic.value in commanded
        assert inbound.ttl is not None


def test_legacy_table_sends_everything_to_both_and_publishes_four_topics(rover: CompiledTable) -> None:
    table = program_of("legacy.yaml").table
    assert {route.case.value for route in table.routes} == {route.case.value for route in rover.table.routes}
    assert all(flow(route)[:2] == ({"any"}, {"dst_a", "dst_b"}) for route in table.routes)
    assert depths(table) == EXISTING_TOPICS


@pytest.fixture
def published(rover: CompiledTable) -> Publish:
    """A function that routes one payload and returns the published messages: CDR bytes by topic."""

    def route(case: str, **values: object) -> dict[str, bytes]:
        rehearsal = Rehearsal(rover)
        envelope = rover.envelopes.first.message_class(**{case: values})
        rehearsal.datagram("rover", SENSOR_BOARD, envelope.SerializeToString())
        assert not any(isinstance(event, Dropped) for event in rehearsal.events)
        return {event.target: event.data for event in rehearsal.events if isinstance(event, Published)}

    return route


def test_gps_position_is_published_with_its_uncertainty(published: Publish) -> None:
    topics = published("gps_info", latitude=48.5, longitude=-9.25, altitude=321.5, hdop=0.5, vdop=2, fix_quality=1)

    fix = deserialize_message(topics["gps/fix"], NavSatFix)
    assert (fix.latitude, fix.longitude, fix.altitude) == (48.5, -9.25, 321.5)
    assert fix.header.frame_id == "gps_link"
    assert fix.status.service == NavSatStatus.SERVICE_GPS
    assert list(fix.position_covariance) == [4, 0, 0, 0, 4, 0, 0, 0, 64]
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_APPROXIMATED


def test_gps_position_of_unknown_quality_is_not_published_as_certain(published: Publish) -> None:
    fix = deserialize_message(published("gps_info", fix_quality=1)["gps/fix"], NavSatFix)
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN


@pytest.mark.parametrize(
    ("fix_quality", "status"),
    [
        ("NO_FIX", NavSatStatus.STATUS_NO_FIX),
        ("GPS_FIX", NavSatStatus.STATUS_FIX),
        ("DGPS_FIX", NavSatStatus.STATUS_SBAS_FIX),
        ("PPS_FIX", NavSatStatus.STATUS_FIX),
        ("RTK_FIX", NavSatStatus.STATUS_GBAS_FIX),
        ("RTK_FLOAT", NavSatStatus.STATUS_GBAS_FIX),
        (99, NavSatStatus.STATUS_NO_FIX),
    ],
)
def test_gps_status_follows_the_fix_quality(published: Publish, fix_quality: str | int, status: int) -> None:
    fix = deserialize_message(published("gps_info", fix_quality=fix_quality)["gps/fix"], NavSatFix)
    assert fix.status.status == status
