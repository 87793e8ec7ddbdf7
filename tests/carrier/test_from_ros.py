"""The threads for messages from ROS: what becomes of each message, reloads, stops, a middleware that is stuck."""

from __future__ import annotations

import ctypes
import errno
import math
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep

import pytest

from router.carrier.ros_routes import RosRoutes
from router.clock import boottime_ns, wall_ns
from router.compiler.metrics import HISTOGRAM_CELLS
from router.threads import StuckError
from tests.carrier.building import MEMORY, RACES, clocked_library, run_program
from tests.carrier.serving_ros import ServingRos, Subscription, middleware
from tests.carrier.simulated import START, Simulated
from tests.small_tables import program

ROUTES = """\
  drive_motor:
    source: {topic: drive, type: comms/msg/DrivingBoardMotorMessage}
    fields: auto
    destinations: [driving_board, {endpoint: recorder, max_rate: 0.001 Hz}]
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], repeat: 100ms,
              disarmed_by: [arm_target]}
  arm_target:
    source: {topic: arm, type: comms/msg/ArmBoardTargetMovement}
    fields: auto
    destinations: [driving_board]
    deadman: {none: a target is sent once}
  arm_ctrl:
    source: {topic: arm, type: comms/msg/ArmBoardTargetMovement}
    fields: {control_base: target_x}
    destinations: [driving_board]
    deadman: {none: for tests}
"""
STAMPED = """\
  drive_motor:
    source: {topic: drive, type: geometry_msgs/msg/TwistStamped}
    fields: {distance_to_go: float32(twist.linear.x), turning_radius: float32(twist.angular.z)}
    destinations: [driving_board]
    ttl: 200ms
    deadman: {timeout: 500ms, send: {manual_brake: {brake: true}}, to: [driving_board], repeat: 100ms}
"""
CALCULATED = """\
  drive_motor:
    source: {topic: drive, type: comms/msg/DrivingBoardMotorMessage, when: turning_radius < 100}
    fields: {distance_to_go: "float32(round(clamp(100 / (distance_to_go - turning_radius), -100, 100)))"}
    destinations:
      - {endpoint: driving_board, when: 1 / turning_radius > -1}
      - {endpoint: recorder, fields: {turning_radius: turning_radius}}
    ttl: 200ms
    deadman: {none: for tests}
"""
EACH = """\
  arm_ctrl:
    source: {topic: poses, type: geometry_msgs/msg/PoseArray, when: item.position.y < 1 or index > 0}
    for_each: poses
    fields: {control_base: float32(item.position.x + 100 * index + 1000 * count)}
    destinations:
      - driving_board
      - {endpoint: recorder, when: index == count - 1, fields: {control_base: float32(1 / item.position.x)}}
    ttl: 200ms
    deadman: {none: for tests}
  arm_target:
    source: {topic: arm, type: comms/msg/ArmBoardTargetMovement}
    for_each: "[target_x, 1 / target_x, target_y]"
    fields: {target_x: float32(item), target_y: float32(index)}
    destinations: [driving_board]
    deadman: {none: for tests}
"""
SECOND = 1_000_000_000


@pytest.fixture(scope="session")
def functions(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return middleware(tmp_path_factory.mktemp("middleware") / "middleware.so")


Open = Callable[..., ServingRos]


@pytest.fixture
def opened(library: ctypes.CDLL, functions: ctypes.CDLL, tmp_path: Path) -> Iterator[Open]:
    """Opens a table of these routes, and serves it."""
    with ExitStack() as stack:

        def made(routes: str = ROUTES) -> ServingRos:
            serving = ServingRos(library, functions, program(tmp_path, routes), stack)
            serving.serve()
            return serving

        yield made


def wait_until(condition: Callable[[], object]) -> None:
    deadline = monotonic() + 20
    while not condition():
        assert monotonic() < deadline, "it never happened"
        sleep(0.002)


def drive(distance: float, radius: float = 0.0) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ff", distance, radius)


def arm(x: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ffffB3xf", x, 0, 0, 0, 1, 0)


def twist(x: float, stamp: int) -> bytes:
    seconds, nanoseconds = divmod(stamp, SECOND)
    head = struct.pack("<iII4x", seconds, nanoseconds, 1)
    return b"\0\1\0\0" + head + struct.pack("<6d", x, 0, 0, 0, 0, -0.0)


def poses(*points: tuple[float, float], stamp: int = 0) -> bytes:
    head = b"\0\1\0\0" + struct.pack("<iIIB3xI4x", *divmod(stamp, SECOND), 1, 0, len(points))
    return head + b"".join(struct.pack("<7d", *point, 0, 0, 0, 0, 1) for point in points)


def of(datagram: bytes) -> float:
    """The distance of a drive command that is not zero, behind the heads of envelope and field."""
    distance: float = struct.unpack_from("<f", datagram, 3)[0]
    return distance


# ---- beside the simulation

Messages = Mapping[str, list[tuple[Callable[[int], bytes], int]]]
"""By topic: messages made with the wall clock, and how long ago (ns) they were sent."""


def compare(serving: ServingRos, messages: Messages) -> None:
    """The threads count and send what the simulation does."""
    staged = Simulated(serving.program)
    for topic, sent in messages.items():
        for make, age in sent:
            now = wall_ns()
            serving.subscriptions[topic].put(make(now), now - age)
            staged.simulation.message(topic, make(START), START - age)
            last = staged.ledger().total("messages_received")
        wait_until(lambda: serving.ledger().total("messages_received") == last)  # noqa: B023 - at once
    counted = ("messages_", "datagrams_", "sent_")
    assert serving.ledger().counted(*counted) == staged.ledger().counted(*counted)
    for endpoint, board in serving.boards.items():
        assert board.received() == staged.to(endpoint)
    assert list(serving.ledger().imbalances()) == []
    assert [(route, target) for route, target, *_ in serving.losses()] == staged.losses
    topics_of: dict[str, set[str]] = {}
    for topic, plans in serving.program.outbound.items():
        for plan in plans:
            topics_of.setdefault(plan.route, set()).add(topic)
    for route, topics in topics_of.items():
        timed = sum(
            serving.thread.counters(1 << 16)[serving.program.counters.index("route_duration_seconds", route) + part]
            for part in range(HISTOGRAM_CELLS - 1)
        )
        assert timed == sum(len(sent) for topic, sent in messages.items() if topic in topics)
        last = serving.count("route_silence_seconds", route)
        assert abs(boottime_ns() - last) < 60 * SECOND if timed else last == 0


def test_messages_come_to_what_they_come_to_on_the_stage(opened: Open) -> None:
    compare(
        opened(),
        {
            "drive": [
                (lambda _: drive(1.5, -2), 0),
                (lambda _: drive(2.5), SECOND),  # stale
                (lambda _: drive(0.0, -0.0), 0),  # its second destination is limited
                (lambda _: drive(3)[:9], 0),  # cut
                (lambda _: b"\0\0" + drive(3)[2:], 0),  # big-endian
                (lambda _: b"", 0),
                (lambda _: drive(4) + b"more", 0),
            ],
            "arm": [(lambda _: arm(7), 100 * SECOND), (lambda _: arm(8)[:8], 0)],
        },
    )


def test_the_age_counts_from_the_stamp_where_there_is_one(opened: Open) -> None:
    compare(
        opened(STAMPED),
        {
            "drive": [
                (lambda now: twist(1, now), 0),
                (lambda now: twist(2, now - SECOND), 0),  # stale by its stamp
                (lambda now: twist(3, now), SECOND),  # stale as it was sent long ago
                (lambda _: twist(4, 0), 0),  # without a stamp
                (lambda now: twist(5, now + SECOND), 0),  # by a clock that is ahead
                (lambda now: twist(1e39, now), 0),  # no float32
            ]
        },
    )


def test_fields_are_calculated_and_conditions_evaluated(opened: Open) -> None:
    compare(
        opened(CALCULATED),
        {
            "drive": [
                (lambda _: drive(1.5, -2), 0),
                (lambda _: drive(2, 2), 0),  # divided by zero
                (lambda _: drive(2, 200), 0),  # filtered for both
                (lambda _: drive(2, -0.5), 0),  # filtered for the board
                (lambda _: drive(2, 0), 0),  # whose condition divides by zero
                (lambda _: drive(math.nan, 1), 0),
                (lambda _: drive(5, 1), SECOND),  # stale
                (lambda _: drive(3)[:9], 0),  # cut
            ],
        },
    )


def test_a_refusal_names_its_place(opened: Open) -> None:
    serving = opened(CALCULATED)
    (feed,) = serving.program.lowered.from_ros["drive"]
    for message in (drive(2, 2), drive(2, 0)):
        serving.subscriptions["drive"].put(message, wall_ns())
    wait_until(lambda: serving.ledger().total("messages_received") == 2)
    found = [(feed.targets[target].places[place], reason) for _, target, reason, _, place in serving.refusals()]
    (board,) = (place for place, _ in found if "when" in place)
    fields = [place for place, _ in found if place != board]
    assert {reason for _, reason in found} == {0}
    assert len(fields) == 1
    assert all("distance_to_go" in place for place in fields)


def test_a_message_that_cannot_be_read_names_its_topic(opened: Open) -> None:
    serving = opened(CALCULATED)
    (feed,) = serving.program.lowered.from_ros["drive"]
    serving.subscriptions["drive"].put(drive(2, 2)[:7], wall_ns())
    wait_until(lambda: serving.ledger().total("messages_received") == 1)
    places = [feed.targets[target].places[place] for _, target, _, _, place in serving.refusals()]
    assert places
    assert all(place.endswith(": a malformed message") for place in places)


def test_each_element_is_a_message(opened: Open) -> None:
    serving = opened(EACH)
    compare(
        serving,
        {
            "poses": [
                (lambda now: poses((1, 0), (2, 0), (3, 0), stamp=now), 0),
                (lambda _: poses((1, 5), (0, 0)), 0),  # one is filtered, and one has no inverse
                (lambda _: poses(), 0),
                (lambda now: poses((1, 0), stamp=now - SECOND), 0),  # stale
                (lambda _: poses((1, 0), (2, 0))[:100], 0),  # cut
                (lambda _: poses(*[(number, 0) for number in range(1, 60)]), 0),
            ],
            "arm": [(lambda _: arm(4), 0), (lambda _: arm(0), 0), (lambda _: arm(2)[:7], 0)],
        },
    )
    assert serving.count("messages_received", "arm_ctrl", "poses") == 3 + 2 + 0 + 1 + 1 + 59
    assert serving.count("messages_received", "arm_target", "arm") == 3 + 1 + 1
    assert serving.count("messages_dropped", "arm_target", "driving_board", "mapping_error") == 2


def test_a_list_that_is_refused_is_reported_with_its_place(opened: Open) -> None:
    serving = opened(EACH)
    serving.subscriptions["arm"].put(arm(0), wall_ns())
    wait_until(lambda: serving.ledger().total("messages_received") == 1)
    ((route, target, _, topic, place),) = serving.refusals()
    (feed,) = serving.program.lowered.from_ros[topic]
    assert "for_each" in feed.targets[target].places[place]
    assert (route, target) == ("arm_target", "driving_board")


def test_a_message_without_times_is_as_old_as_its_receipt(opened: Open) -> None:
    serving = opened()
    serving.subscriptions["drive"].put(drive(1), 0, 0)
    serving.subscriptions["drive"].put(drive(2), 0, wall_ns() - SECOND)
    serving.subscriptions["drive"].put(drive(3), wall_ns(), wall_ns() - SECOND)
    serving.subscriptions["drive"].put(drive(4), wall_ns() + SECOND, wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 4)
    assert [of(each) for each in serving.boards["driving_board"].received()] == [1, 4]


def test_what_cannot_be_sent_is_counted_and_reported(opened: Open) -> None:
    serving = opened()
    serving.boards["driving_board"].break_down()
    serving.subscriptions["drive"].put(drive(1), wall_ns())
    wait_until(lambda: serving.count("messages_dropped", "drive_motor", "driving_board", "send_error"))
    assert serving.losses() == [("drive_motor", "driving_board", 6, errno.ENOTSOCK)]
    assert len(serving.boards["recorder"].received()) == 1


# ---- order


def test_commands_leave_in_the_order_in_which_they_came(opened: Open) -> None:
    serving = opened()
    for number in range(1, 101):  # more than one turn
        serving.subscriptions["drive"].put(drive(number), wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 100)
    sent = [of(each) for each in serving.boards["driving_board"].received()]
    assert sent == sorted(sent)
    assert sent[-1] == 100


def test_a_brake_leaves_behind_the_last_command_and_commands_of_others_disarm_it(opened: Open) -> None:
    serving = opened()
    deadmen = serving.deadmen.address
    board = serving.boards["driving_board"]
    serving.subscriptions["drive"].put(drive(1), wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive"))
    serving.library.timers_serve(deadmen, boottime_ns() + SECOND)
    command, brake = board.received()
    assert of(command) == 1
    assert (brake,) == serving.program.deadmen[0].datagrams[0][1]
    serving.subscriptions["arm"].put(arm(1), wall_ns())
    wait_until(lambda: serving.count("messages_received", "arm_ctrl", "arm"))
    assert len(board.received()) == 2
    serving.library.timers_serve(deadmen, boottime_ns() + 10 * SECOND)
    assert board.received() == []


def test_a_stale_command_feeds_no_deadman(opened: Open) -> None:
    serving = opened()
    serving.subscriptions["drive"].put(drive(1), wall_ns() - SECOND)
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive"))
    serving.library.timers_serve(serving.deadmen.address, boottime_ns() + SECOND)
    assert serving.boards["driving_board"].received() == []


# ---- reloads and the stop


def test_a_subscription_that_is_left_is_emptied_before_and_not_used_afterwards(
    opened: Open, functions: ctypes.CDLL
) -> None:
    serving = opened()
    earlier = serving.subscriptions["drive"]
    later = Subscription(functions)
    later.put(drive(1), wall_ns())  # which the earlier one has got as well, and served
    earlier.announce_to(None)
    earlier.put(drive(2), wall_ns())
    serving.serve({**serving.subscriptions, "drive": later})
    assert [of(each) for each in serving.boards["driving_board"].received()] == [2]
    earlier.put(drive(3), wall_ns())
    later.put(drive(4), wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 2)
    assert [of(each) for each in serving.boards["driving_board"].received()] == [4]


def test_what_came_before_a_topic_is_served_is_served_then(opened: Open) -> None:
    serving = opened()
    serving.thread.serve(RosRoutes())
    serving.subscriptions["drive"].put(drive(1), wall_ns())
    assert serving.count("messages_received", "drive_motor", "drive") == 0
    serving.serve()
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive"))
    assert len(serving.boards["driving_board"].received()) == 1


def test_a_reload_while_messages_come_loses_none(opened: Open) -> None:
    serving = opened()
    for number in range(1, 501):
        serving.subscriptions["drive"].put(drive(number), wall_ns())
        if number % 10 == 0:
            serving.serve()
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 500)


def test_stopping_serves_what_has_arrived(opened: Open) -> None:
    serving = opened()
    for subscription in serving.subscriptions.values():
        subscription.announce_to(None)
    serving.subscriptions["drive"].put(drive(1), wall_ns())
    serving.subscriptions["arm"].put(arm(1), wall_ns())
    assert serving.thread.stop()
    assert serving.count("messages_received", "drive_motor", "drive") == 1
    assert serving.count("messages_received", "arm_target", "arm") == 1


# ---- a middleware that is stuck, and one that refuses


def test_a_reload_does_not_wait_for_the_middleware(opened: Open, functions: ctypes.CDLL) -> None:
    serving = opened()
    subscription = serving.subscriptions["drive"]
    subscription.set(is_stuck=True)
    subscription.put(drive(1), wall_ns())
    wait_until(lambda: subscription.is_taken_from)
    with pytest.raises(StuckError):
        serving.serve({**serving.subscriptions, "drive": Subscription(functions)})
    subscription.set(is_stuck=False)
    subscription.put(drive(2), wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 2)
    assert of(serving.boards["driving_board"].received()[-1]) == 2


def test_a_thread_that_is_stuck_is_left_and_sends_nothing_any_more(opened: Open) -> None:
    serving = opened()
    subscription = serving.subscriptions["drive"]
    subscription.set(is_stuck=True)
    subscription.put(drive(1), wall_ns())
    wait_until(lambda: subscription.is_taken_from)
    assert not serving.thread.stop()
    subscription.set(is_stuck=False)
    wait_until(lambda: not subscription.is_taken_from)
    assert serving.count("messages_received", "drive_motor", "drive") == 0
    assert serving.boards["driving_board"].received() == []


def test_a_middleware_that_refuses_is_counted(opened: Open) -> None:
    serving = opened()
    subscription = serving.subscriptions["drive"]
    subscription.set(refuses=True)
    subscription.put(drive(1), wall_ns())
    wait_until(lambda: serving.thread.failures)
    subscription.set(refuses=False)
    subscription.put(drive(2), wall_ns())
    wait_until(lambda: serving.count("messages_received", "drive_motor", "drive") == 2)


@pytest.mark.parametrize(
    "sanitizers",
    ["", pytest.param(RACES, marks=pytest.mark.slow), pytest.param(MEMORY, marks=pytest.mark.slow)],
)
def test_programs_change_while_commands_come(tmp_path: Path, sanitizers: str) -> None:
    run_program("from_ros", tmp_path, sanitizers=sanitizers)


@pytest.mark.slow  # as its sanitizer cannot run below the one of `make test-all`
def test_a_set_that_was_taken_back_is_not_used(tmp_path: Path) -> None:
    run_program("refused_set", tmp_path, sanitizers=MEMORY)


# ---- who serves what


@pytest.mark.parametrize(
    ("earlier", "later"),
    [
        ("BoardMotorMessage}", "BoardMotorMessage, when: turning_radius > 0}"),
        ("[driving_board, {", "[{endpoint: driving_board, when: turning_radius > 0}, {"),
        ("{control_base: target_x}", "{control_base: target_x * 2}"),
    ],
)
def test_conditions_and_calculations_are_the_carriers(tmp_path: Path, earlier: str, later: str) -> None:
    made = program(tmp_path, ROUTES.replace(earlier, later))
    assert list(made.lowered.from_ros) == ["drive", "arm"]


def test_messages_without_freshness_are_not_urgent(tmp_path: Path) -> None:
    routes = """\
  rover_localization:
    source: {topic: where, type: comms/msg/BasestationRoverLocalization}
    fields: auto
    destinations: [basestation]
"""
    made = program(tmp_path, ROUTES + routes)
    urgent = {topic: [feed.is_urgent for feed in feeds] for topic, feeds in made.lowered.from_ros.items()}
    assert urgent == {"drive": [True], "arm": [True, False], "where": [False]}


class Clocks:
    """Those of a library with clocks that are set. Waits of its threads end at once when they would by the real one."""

    def __init__(self, clocked: ctypes.CDLL) -> None:
        self._boot, self._wall = (ctypes.c_int64.in_dll(clocked, name) for name in ("seam_boottime", "seam_wall"))
        self.now, self.ahead = boottime_ns() + 10**15, wall_ns()
        self.pass_time(0)

    def pass_time(self, ns: int) -> None:
        self.now += ns
        self._boot.value, self._wall.value = self.now, self.wall

    @property
    def wall(self) -> int:
        return self.now + self.ahead


@pytest.fixture(scope="module")
def clocked(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return clocked_library(tmp_path_factory.mktemp("clocked") / "clocked.so")


@pytest.fixture
def timed(clocked: ctypes.CDLL, functions: ctypes.CDLL, tmp_path: Path) -> Iterator[tuple[ServingRos, Clocks]]:
    with ExitStack() as stack:
        clocks = Clocks(clocked)
        serving = ServingRos(clocked, functions, program(tmp_path, ROUTES), stack)
        serving.serve()
        yield serving, clocks


def settle(serving: ServingRos, messages: int) -> None:
    wait_until(lambda: serving.ledger().total("messages_received", "drive_motor") == messages)


def test_a_publisher_that_goes_on_is_obeyed_at_once_after_its_clock_was_set_back(
    timed: tuple[ServingRos, Clocks],
) -> None:
    serving, clocks = timed
    board, obeyed = serving.boards["driving_board"], 0
    for number in range(1, 301):
        clocks.pass_time(SECOND // 50)
        if number == 200:
            clocks.ahead -= 3 * SECOND
        clocks.pass_time(0)
        serving.subscriptions["drive"].put(drive(number), clocks.wall)
        settle(serving, number)
        obeyed += len(board.received())
    assert obeyed == 300


def test_commands_of_a_stall_stay_stale_whatever_was_done_to_the_clock(timed: tuple[ServingRos, Clocks]) -> None:
    serving, clocks = timed
    serving.subscriptions["drive"].put(drive(1), clocks.wall)
    settle(serving, 1)
    clocks.pass_time(5 * SECOND)
    stamps = [clocks.wall + age * SECOND // 10 for age in range(20)]
    clocks.ahead -= 3 * SECOND
    clocks.pass_time(3 * SECOND)
    for number, stamp in enumerate(stamps, 2):
        serving.subscriptions["drive"].put(drive(number), stamp)
        settle(serving, number)
    assert len(serving.boards["driving_board"].received()) == 1
