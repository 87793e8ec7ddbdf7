"""States in a whole router: a datagram decides which commands from ROS pass, also after reloads; changes are logged."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import closing

import pytest
from structlog.testing import capture_logs

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.app import Router
from router.clock import boottime_ns
from router.observe.snapshot import Counts
from router.observe.states import state_readings
from tests.app.conftest import Site
from tests.repeating import repeating
from tests.ros.peers import Publisher, wait_until

TYPE = "comms/msg/DrivingBoardMotorMessage"
MANUAL, AUTO = bytes.fromhex("820100"), bytes.fromhex("8201020801")
TRUE, FALSE = b"\0\1\0\0\1", b"\0\1\0\0\0"
PASSES = "state.mode == MODE_AUTO"


def table(when: str = PASSES, valid_for: str = "60s") -> str:
    """The route is in one of two threads: with a `ttl` in the urgent one."""
    return f"""\
  control_mode: {{source: sensor_board}}
  drive_motor:
    source: {{topic: drive_motor, type: {TYPE}, queue_depth: 1000}}
    fields: auto
    destinations: [{{endpoint: basestation, when: "{when}"}}]
    ttl: 30s
    deadman: {{none: for this test}}
state:
  mode: {{case: control_mode, source: sensor_board, value: mode, initial: MODE_MANUAL, valid_for: {valid_for}}}
"""


def command(number: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ff", number, 1)


def number_of(datagram: bytes) -> float:
    return float(struct.unpack_from("<f", datagram, 3)[0])


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with closing(Publisher("drive_motor", TYPE)) as made:
        yield made


def test_a_datagram_lets_commands_from_ros_pass(site: Site, publisher: Publisher) -> None:
    with capture_logs() as logs, site.router(table()) as router:
        assert publisher.line() == "matched"
        publisher.publish([command(1)])
        wait_until(lambda: router.total("messages_filtered") == 1)
        site.send(AUTO)
        wait_until(lambda: router.total("state_changes") == 1)
        publisher.publish([command(2)])
        assert number_of(site.basestation.recv(1000)) == 2
        site.write(table(f"{PASSES} and turning_radius > 0"))
        assert router.reload().ok
        publisher.publish([command(3)])
        assert number_of(site.basestation.recv(1000)) == 3  # the reload has kept the state
        site.send(MANUAL)
        wait_until(lambda: router.total("state_changes") == 2)
        publisher.publish([command(4)])
        wait_until(lambda: router.total("messages_filtered") == 2)
    told = [(log["before"], log["after"], log["source"]) for log in logs if log["event"] == "state changed"]
    assert told == [("MODE_MANUAL", "MODE_AUTO", "sensor_board"), ("MODE_AUTO", "MODE_MANUAL", "sensor_board")]


def test_a_state_that_expires_is_logged(site: Site) -> None:
    with capture_logs() as logs, site.router(table(valid_for="200ms")) as router:
        site.send(AUTO)
        wait_until(lambda: router.total("state_changes") == 2)
    [told] = [log for log in logs if log["event"] == "state is back at its initial value"]
    assert (told["state"], told["before"], told["after"]) == ("mode", "MODE_AUTO", "MODE_MANUAL")
    assert told["log_level"] == "warning"


def test_a_change_by_a_datagram_that_waited_for_the_start_is_logged_in_words(site: Site) -> None:
    with capture_logs() as logs, repeating(lambda: site.send(AUTO)), site.router(table()) as router:
        wait_until(lambda: router.total("state_changes") == 1)
    [told] = [log for log in logs if log["event"] == "state changed"]
    assert (told["before"], told["after"]) == ("MODE_MANUAL", "MODE_AUTO")


def test_a_text_lets_commands_from_ros_pass(site: Site, publisher: Publisher) -> None:
    of_text = table("state.driver == 'left'").replace(
        "state:\n", "state:\n  driver: {topic: driver, type: std_msgs/msg/String, value: data, initial: \"'nobody'\"}\n"
    )
    named = closing(Publisher("driver", "std_msgs/msg/String"))
    with capture_logs() as logs, named as names, site.router(of_text) as router:
        assert publisher.line() == names.line() == "matched"
        publisher.publish([command(1)])
        wait_until(lambda: router.total("messages_filtered") == 1)
        assert texts(router) == {("driver", "nobody"): 1}
        names.publish([b"\0\1\0\0\5\0\0\0left\0"])
        wait_until(lambda: router.total("state_changes") == 1)
        assert texts(router) == {("driver", "left"): 1}
        [driver, _] = state_readings(router.program, router.read(boottime_ns()))
        assert (driver.value, driver.setter) == ("'left'", "driver")
        publisher.publish([command(2)])
        assert number_of(site.basestation.recv(1000)) == 2
    [told] = [log for log in logs if log["event"] == "state changed"]
    assert (told["before"], told["after"]) == ("'nobody'", "'left'")


def texts(router: Router) -> Counts:
    return router.read(boottime_ns()).counts("state_text")


def test_a_topic_lets_commands_from_ros_pass(site: Site, publisher: Publisher) -> None:
    of_topic = table("state.may_drive").replace(
        "state:\n", "state:\n  may_drive: {topic: may_drive, type: std_msgs/msg/Bool, value: data, initial: false}\n"
    )
    with closing(Publisher("may_drive", "std_msgs/msg/Bool")) as allowing, site.router(of_topic) as router:
        assert publisher.line() == allowing.line() == "matched"
        publisher.publish([command(1)])
        wait_until(lambda: router.total("messages_filtered") == 1)
        allowing.publish([TRUE])
        wait_until(lambda: router.total("state_changes") == 1)
        publisher.publish([command(2)])
        assert number_of(site.basestation.recv(1000)) == 2
        allowing.publish([FALSE])
        wait_until(lambda: router.total("state_changes") == 2)
        publisher.publish([command(3)])
        wait_until(lambda: router.total("messages_filtered") == 2)
