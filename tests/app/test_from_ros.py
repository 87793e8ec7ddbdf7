"""Commands from ROS through a whole router: by the carrier where it can, through reloads, and whatever Python does."""

from __future__ import annotations

import ctypes
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from time import sleep

import pytest
from structlog.testing import capture_logs

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.carrier.from_ros import FromRosThread
from router.threads import StuckError
from tests.app.conftest import BRAKE, Site
from tests.repeating import repeating
from tests.ros.peers import Publisher, wait_until
from tests.tasks import thread_names

TYPE = "comms/msg/DrivingBoardMotorMessage"
TIMEVAL = struct.Struct("@ll")
COUNT = 400


def drive(
    *, timeout: str = "30s", fields: str = "auto", more: str = "", depth: int = 1000, send: str = "brake: true"
) -> str:
    return f"""\
  drive_motor:
    source: {{topic: drive_motor, type: {TYPE}, queue_depth: {depth}}}
    fields: {fields}
    destinations: [{{endpoint: basestation{more}}}]
    ttl: 30s
    deadman: {{timeout: {timeout}, send: {{manual_brake: {{{send}}}}}, to: [basestation], repeat: 100ms}}
"""


HELD = drive(more=", max_rate: 1000000000 Hz, on_limit: latest")
CALCULATED = drive(
    fields='{distance_to_go: "float32(round(clamp(100 * distance_to_go, -700, 700)) // 100)"}',
    more=", when: turning_radius > 0.5",
)
UNHURRIED = f"""\
  drive_motor:
    source: {{topic: drive_motor, type: {TYPE}, queue_depth: 1000}}
    fields: auto
    destinations: [basestation]
    deadman: {{none: for this test}}
"""
"""Served by the other thread."""

NOBODY = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"


def command(number: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ff", number, 1)


def numbers(site: Site, until: int) -> list[int]:
    """The numbers of the commands that the board gets, up to this one."""
    got: list[int] = []
    while not got or got[-1] != until:
        datagram = site.basestation.recv(1000)
        if not datagram.startswith(BRAKE[:2]):
            got.append(int(struct.unpack_from("<f", datagram, 3)[0]))
    return got


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with closing(Publisher("drive_motor", TYPE)) as made:
        yield made


@pytest.mark.parametrize("table", [drive(), CALCULATED], ids=["copied", "calculated"])
def test_a_command_is_sent_while_python_is_held(site: Site, publisher: Publisher, table: str) -> None:
    python, process = ctypes.PyDLL(None), publisher.process  # calls through PyDLL keep the interpreter lock
    buffer, at_start = ctypes.create_string_buffer(1000), len(BRAKE)
    with site.router(table) as router:
        assert "ros urgent" in thread_names()
        assert publisher.line() == "matched"
        assert len(site.basestation.recv(1000)) == at_start
        site.basestation.settimeout(None)
        patience = TIMEVAL.pack(20, 0)
        site.basestation.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, patience)
        process.send_signal(signal.SIGSTOP)
        publisher.publish([command(7)])
        python.kill(process.pid, signal.SIGCONT)
        while (size := python.recv(site.basestation.fileno(), buffer, len(buffer), 0)) == at_start:
            pass  # the brake of the start is repeated
        assert struct.unpack_from("<f", buffer.raw[:size], 3) == (7,)
        wait_until(lambda: router.total("datagrams_sent") == 1)
        assert router.total("messages_received") == 1
        site.basestation.settimeout(10)
    assert site.basestation.recv(1000) == BRAKE  # the last word


def test_commands_stay_whole_and_in_order_while_tables_change(site: Site, publisher: Publisher) -> None:
    tables = [
        drive(),
        HELD,
        drive(more=", max_rate: 1000000 Hz"),
        drive(timeout="40s"),
        HELD.replace("30s", "20s"),
        drive(),
    ]
    with site.router(drive()) as router:
        assert publisher.line() == "matched"
        sent = 0
        for table in tables:
            publisher.publish(map(command, range(sent + 1, sent + COUNT + 1)))
            sent += COUNT
            site.write(table)
            result = router.reload()
            assert result.ok, result
        assert numbers(site, sent) == list(range(1, sent + 1))
        wait_until(lambda: router.total("datagrams_sent") == sent)
        assert router.total("messages_received") == sent
        assert router.total("messages_dropped") == 0
        assert router.total("deadman_trips") == 0


def test_a_topic_of_two_names_feeds_the_routes_of_both(site: Site, publisher: Publisher) -> None:
    both = (
        UNHURRIED
        + f"""\
  manual_drive:
    source: {{topic: /drive_motor, type: {TYPE}, queue_depth: 1000}}
    fields: {{turn: 7}}
    destinations: [basestation]
    deadman: {{none: for this test}}
"""
    )
    with site.router(both) as router:
        assert [publisher.line(), publisher.line()] == ["matched", "matched"]
        publisher.publish(map(command, range(100)))
        wait_until(lambda: router.total("datagrams_sent") == 200)
        assert router.total("messages_received") == 200


@contextmanager
def commands_coming(publisher: Publisher) -> Iterator[list[int]]:
    """Commands with their numbers come all the time; yields those that were published."""
    sent = list[int]()

    def publish() -> None:
        sent.append(len(sent) + 1)
        publisher.publish([command(sent[-1])])

    with repeating(publish, 0.001):
        yield sent


def test_each_is_sent_once_and_in_order_while_subscriptions_take_over(site: Site, publisher: Publisher) -> None:
    """Both subscriptions receive what comes meanwhile."""
    with site.router(drive()) as router:
        assert publisher.line() == "matched"
        with commands_coming(publisher) as sent:
            for table in (drive(depth=900), UNHURRIED, drive(depth=900), UNHURRIED, drive()):
                site.write(table)
                assert router.reload().ok
        assert numbers(site, sent[-1]) == sent


def test_a_deadman_that_goes_while_commands_come_has_the_last_word_and_then_none(
    site: Site, publisher: Publisher
) -> None:
    with site.router(drive(timeout="500ms") + NOBODY) as router:
        assert publisher.line() == "matched"
        with commands_coming(publisher):
            for turn in range(2):
                assert site.basestation.recv(1000)
                site.write(NOBODY)
                assert router.reload().ok
                site.basestation.settimeout(0.7)  # longer than a deadman waits that was fed once more
                got = list(iter(lambda: _received(site), None))
                site.basestation.settimeout(10)
                assert got[-1] == BRAKE, turn
                assert got[:-1].count(BRAKE) <= (turn == 0)  # that of the start
                site.write(drive(timeout="500ms") + NOBODY)
                assert router.reload().ok
        assert router.total("deadman_trips") == 0


def _received(site: Site) -> bytes | None:
    try:
        return site.basestation.recv(1000)
    except TimeoutError:
        return None


def test_a_reload_is_refused_while_the_middleware_holds_the_thread(
    site: Site, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve, is_stuck = FromRosThread.serve, True

    def stuck_once(self: FromRosThread, *arguments: object) -> None:
        nonlocal is_stuck
        if is_stuck:
            is_stuck = False
            raise StuckError("the thread for commands from ROS is stuck in the middleware: try again")
        serve(self, *arguments)  # type: ignore[arg-type]  # those of the router

    with site.router(drive()) as router:
        assert publisher.line() == "matched"
        monkeypatch.setattr(FromRosThread, "serve", stuck_once)
        site.write(HELD)
        result = router.reload()
        assert not result.ok
        assert result.text.endswith("try again")
        publisher.publish([command(1)])
        assert numbers(site, 1) == [1]
        assert router.reload().ok


def test_a_thread_that_is_stuck_at_the_end_is_left_with_its_subscriptions(
    site: Site, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    with site.router(drive()) as router, capture_logs() as logs:
        ros = router._runtime.topics.node
        assert ros is not None
        stop = FromRosThread.stop
        monkeypatch.setattr(FromRosThread, "stop", lambda thread: stop(thread) and False)
        router.__exit__(None, None, None)
        assert (
            len([line for line in logs if "thread did not stop in time; the router exits without it" in line["event"]])
            == 1
        )
        assert [each.raw.take() for each in ros._subscriptions.values()] == [None]  # it is open


LATCHED = f"""\
  drive_motor:
    source: {{topic: drive_motor, type: {TYPE}, qos: {{durability: transient_local}}}}
    fields: auto
    destinations: [basestation]
    ttl: TTL
    deadman: {{none: for this test}}
"""


@pytest.mark.parametrize(("ttl", "sent"), [("1s", 0), ("{none: it is a setting}", 1)])
def test_a_latched_command_from_before_the_start_is_sent_only_without_ttl(site: Site, ttl: str, sent: int) -> None:
    with closing(Publisher("drive_motor", TYPE, "--transient-local", "--depth", "1")) as publisher:
        publisher.publish([command(7)])
        publisher.await_receipt()
        sleep(1.2)
        with site.router(LATCHED.replace("TTL", ttl)) as router:
            wait_until(lambda: router.totals()["messages_received"] == 1)
        totals = router.totals()
    assert (totals["datagrams_sent"], totals["messages_dropped"]) == (sent, 1 - sent)
