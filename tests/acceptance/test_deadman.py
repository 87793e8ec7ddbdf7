"""Commands that stop coming, late commands, and the end of the router: what the rover's boards get then."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import sleep
from typing import Any, NamedTuple

import pytest

from tests.acceptance.expected import from_board_units
from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import HOSTS, OUTFLOWS, ROUTER, TOPICS_FROM_ROS
from tests.acceptance.site import IMPATIENT_ROVER, ROOT, RouterProcess, Site, balance, key, site, total, wait_until
from tests.compiler.ros_objects import serialized
from tests.ros.peers import Publisher
from tests.ros_child import ForkedProcess

TRIPPED = "no commands arrive; the deadman sends in their place"
TRIPPED_BY_OLD = "commands arrive but are dropped; the deadman sends in their place"
"""In place of TRIPPED if the last commands were older than their `ttl`, as on a busy computer."""
RELEASED = "commands arrive again; the deadman has stopped sending"

LATE = 5
"""Commands that wait while the router is stopped: no more than its queues hold."""

PAUSE = 0.6
"""Seconds. A command is stale after 0.2."""


class Command(NamedTuple):
    """A command's values, the board it is for, and what that board gets when commands stop coming."""

    values: dict[str, Any]
    board: str
    halt: bytes


def _envelope(case: str, **values: Any) -> bytes:
    return sample(case, WIRE.envelopes.first.cases[case].message_class(**values)).datagram


BRAKE = _envelope("manual_brake", brake=True)
COMMANDS = {
    "manual_drive": Command({"forward_backward": 50, "turn": -3}, "driving_board", BRAKE),
    "manual_arm": Command({"delta_x": 7, "speed": 1}, "arm_board", _envelope("manual_arm")),
    "drive_motor": Command({"distance_to_go": 1.5, "turning_radius": 0.25}, "driving_board", BRAKE),
}
BOARDS = {command.board for command in COMMANDS.values()}


class Driver:
    """Gives one kind of command to a running router, and is the board that it is for."""

    def __init__(self, route: str, place: Site, router: RouterProcess, talker: RosPeer | None) -> None:
        self.route, self.place, self.router = route, place, router
        self.command = COMMANDS[route]
        self.datagram = from_board_units(route, self.command.values).datagram
        self._talker = talker
        counts = place.scrape()
        self.sent_by_others = total(counts, "deadman_datagrams_sent")
        self.sent_by_others -= total(counts, "deadman_datagrams_sent", route=route)
        self._given = 0

    def give(self) -> None:
        self._given += 1
        if self._talker:
            self._talker.say(self.route, self.command.values)
        else:
            self.place.send("basestation", self.datagram)

    def drive(self) -> None:
        """Gives commands until the board gets them and not what the deadman sends.

        Those that the talker publishes before it is discovered come seconds later, and are stale. When this returns,
        none is on its way: the talker may be slow.
        """
        before, taken, given = self.sent(), self.taken(), self._given

        def driven() -> bool:
            self.give()
            return self.sent() > before and not self.is_active()

        wait_until(driven, "the release")
        wait_until(lambda: self.taken() - taken >= self._given - given, "the last command")
        for _ in range(int(self.sent() - before)):
            self.await_next(self.datagram)

    def await_next(self, datagram: bytes) -> None:
        """Whatever came before it."""
        while self.place.receive(self.command.board) != datagram:
            pass

    def await_halt(self) -> None:
        """The board gets nothing else from here on."""
        self.await_next(self.command.halt)
        assert [self.place.receive(self.command.board) for _ in range(3)] == [self.command.halt] * 3
        assert self.is_active()

    def all_taken(self) -> bool:
        """Whether the router has taken all commands that were given."""
        return self.taken() == self._given

    def taken(self) -> float:
        return total(self.place.scrape(), "messages_received", route=self.route)

    def sent(self) -> float:
        return total(self.place.scrape(), "datagrams_sent", route=self.route)

    def is_active(self) -> bool:
        return bool(self.place.samples()[key("deadman_active", route=self.route)])

    def await_lines(self) -> None:
        """One warning each way, while the deadman is active."""
        trips = total(self.place.scrape(), "deadman_trips", route=self.route)

        def told() -> bool:
            lines = [line for line in self.router.log() if line["event"] in (TRIPPED, TRIPPED_BY_OLD, RELEASED)]
            assert {(line["level"], line["route"]) for line in lines} == {("warning", self.route)}
            returned = [line["event"] == RELEASED for line in lines]
            return returned == [False, *[True, False] * (trips - 1)]

        wait_until(told, "the last line")


def hear_boards(place: Site) -> None:
    """Have each board say something: the brakes of the start are sent once more, within a second, and end."""
    for board in BOARDS:
        place.send(board, _envelope("control_mode"))
    sleep(2.5)


@pytest.fixture(
    scope="module", params=["manual_drive", pytest.param("manual_arm", marks=pytest.mark.slow), "drive_motor"]
)
def driver(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driver]:
    """Of a router of its own, which ends with the last of these tests."""
    folder = tmp_path_factory.mktemp(request.param)
    with ExitStack() as stack:
        place = stack.enter_context(site(folder))
        router = stack.enter_context(RouterProcess(folder, place.table(IMPATIENT_ROVER)))
        hear_boards(place)
        topics = {topic: kind for topic, kind in TOPICS_FROM_ROS.items() if topic == request.param}
        talker = stack.enter_context(RosPeer()) if topics else None
        if talker:
            talker.open_heard(topics)
        yield Driver(request.param, place, router, talker)


def test_it_trips_repeats_and_is_released(driver: Driver) -> None:
    for _ in range(2):
        driver.drive()
        driver.await_halt()
        driver.await_lines()
    counts = driver.place.scrape()
    assert total(counts, "deadman_trips") == total(counts, "deadman_trips", route=driver.route) >= 2
    sent = total(counts, "deadman_datagrams_sent", route=driver.route, destination=driver.command.board)
    assert total(counts, "deadman_datagrams_sent") - driver.sent_by_others == sent >= 9
    balance(counts)


def test_commands_that_waited_too_long_are_not_sent(driver: Driver) -> None:
    driver.drive()
    wait_until(driver.all_taken, "the last command")
    stale = key("messages_dropped", route=driver.route, target=driver.command.board, reason="stale")
    before = driver.place.scrape()[stale]
    with driver.router.standing_still():
        driver.place.waiting()
        for _ in range(LATE):
            driver.give()
        sleep(PAUSE)
    wait_until(driver.all_taken, "the last late command")
    assert driver.place.scrape()[stale] - before == LATE
    assert driver.place.receive(driver.command.board) == driver.command.halt
    driver.await_halt()
    driver.drive()


@contextmanager
def steady(driver: Driver) -> Iterator[subprocess.Popen[Any] | ForkedProcess]:
    """A process that gives commands all the time, and does not end well."""
    if driver.route in OUTFLOWS:
        kind = TOPICS_FROM_ROS[driver.route]
        publisher = Publisher(driver.route, kind, "--flood")
        publisher.publish([serialized(kind, driver.command.values)])
        try:
            yield publisher.process
        finally:
            publisher.kill()
        return
    words = [f"{name}={value}" for name, value in driver.command.values.items()]
    addresses = ["--to", f"{ROUTER}:{driver.place.listen}", "--from", HOSTS["basestation"]]
    command = [sys.executable, "-m", "router", "send", driver.route, *words, *addresses, "--rate", "50Hz"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
def test_a_source_that_is_stopped_or_killed_is_replaced(driver: Driver) -> None:
    driver.place.waiting()
    with steady(driver) as source:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            driver.await_next(driver.datagram)
            source.send_signal(number)
            driver.await_halt()
            driver.await_lines()
            source.send_signal(signal.SIGCONT)


def test_what_was_driven_is_halted_when_the_router_ends(driver: Driver) -> None:
    """Last of a driver's tests."""
    driver.place.waiting()  # what was sent at the start, if no other test ran before this one
    driver.drive()
    assert driver.router.stop(signal.SIGTERM) == 0
    arrived = driver.place.waiting()
    assert arrived.pop(driver.command.board)[-1] == driver.command.halt
    assert arrived == {}


def test_what_was_never_driven_is_halted_at_the_start_and_not_at_the_end(tmp_path: Path) -> None:
    with site(tmp_path) as place, RouterProcess(tmp_path, place.table(IMPATIENT_ROVER)) as router:
        halts = {name: sorted({each.halt for each in COMMANDS.values() if each.board == name}) for name in BOARDS}
        hear_boards(place)
        assert {board: sorted(set(datagrams)) for board, datagrams in place.waiting().items()} == halts
        before = place.scrape()
        place.send("basestation", _envelope("control_mode"))
        place.settle(before, 1)
        assert router.stop(signal.SIGTERM) == 0
        assert place.waiting() == {}
