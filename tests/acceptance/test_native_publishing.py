"""What a running router publishes on topics, for ROS software in other processes."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from itertools import count
from pathlib import Path
from time import sleep, time

import pytest

from tests import ros_child
from tests.acceptance.gateway_clients import Dashboard
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import BARE, RouterProcess, Site, balance, site, total, wait_until
from tests.ports import free_port
from tests.readable import readable
from tests.ros import peers
from tests.ros.peers import Subscriber

FLOAT = "std_msgs/msg/Float32"
_FLOAT = f"type: {FLOAT}, fields: {{{{data: accel_x}}}}"
PROBE, LAST_PROBE = -1e9, -2e9
LATEST = "max_rate: 1000000000 Hz, on_limit: latest"
"""Holds nothing back: no two messages come within 1 ns."""


def imu(number: float) -> bytes:
    case = WIRE.case("imu_info")
    return WIRE.encode(case, case.message_class(accel_x=number))


def gps(number: float) -> bytes:
    case = WIRE.case("gps_info")
    return WIRE.encode(case, case.message_class(hdop=number))


def next_of(subscriber: Subscriber) -> float:
    """The next message."""
    (found,) = struct.unpack("<xxxxf", bytes.fromhex(subscriber.line()))
    return float(found)


def taken(subscriber: Subscriber, many: int) -> list[float]:
    """The next messages."""
    return [next_of(subscriber) for _ in range(many)]


@contextmanager
def hearing(place: Site, *topics: str) -> Iterator[list[Subscriber]]:
    """A subscriber of each topic, which is fed by `imu_info`. The router has discovered them all by then."""
    with ExitStack() as stack:
        opened = [Subscriber(topic, FLOAT) for topic in topics]
        for each in opened:
            stack.callback(each.close)
        for topic, each in zip(topics, opened, strict=True):
            for _ in range(_PUBLISHERS.get(topic, 1)):
                assert each.line() == "matched"
        before, sent = place.scrape(), 1
        for each in opened:
            while not readable(each.process.stdout.fileno(), 0.02):
                place.send("sensor_board", imu(PROBE))
                sent += 1
        place.send("sensor_board", imu(LAST_PROBE))
        place.settle(before, sent)
        for each in opened:
            while next_of(each) != LAST_PROBE:
                pass
        place.waiting()
        yield opened


_PUBLISHERS = {"beside_a": 2}
"""Of the route and of the gateway. What one publishes before the subscriber knows it is lost."""


@contextmanager
def running(folder: Path, routes: str) -> Iterator[tuple[Site, RouterProcess]]:
    with site(folder) as place, RouterProcess(folder, place.table(BARE + routes)) as router:
        yield place, router


@contextmanager
def sending(place: Site, *makers: Callable[[float], bytes], period: float = 0.002) -> Iterator[list[int]]:
    """Datagrams flow meanwhile, by each maker with the same numbers from 0. Yields how many numbers it was so far."""
    sent, has_ended = [0], threading.Event()

    def send() -> None:
        for each in count():
            for make in makers:
                place.send("sensor_board", make(float(each)))
            sent[0] = each + 1
            if has_ended.wait(period):
                return

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield sent
    finally:
        has_ended.set()
        thread.join()


BESIDE = f"""\
routes:
  imu_info:
    source: any
    topics:
      - {{{{topic: beside_a, {_FLOAT}, queue_depth: 1000}}}}
      - {{{{topic: beside_b, {_FLOAT}, queue_depth: 1000, {LATEST}}}}}
      - {{{{topic: beside_latest, {_FLOAT}, on_limit: latest, max_rate: 1000 Hz}}}}
      - {{{{topic: beside_shared, {_FLOAT}, queue_depth: 1000}}}}
      - {{{{topic: beside_kept, {_FLOAT}, qos: {{{{durability: transient_local, depth: 5}}}}}}}}
  gps_info:
    source: any
    topics:
      - {{{{topic: beside_shared, type: {FLOAT}, fields: {{{{data: hdop}}}}, queue_depth: 1000, {LATEST}}}}}
gateways:
  dashboard:
    transport: {{{{websocket: 127.0.0.5:DASHBOARD}}}}
    topics: {{{{include: [/none]}}}}
    inbound: [{{{{topic: beside_a, type: {FLOAT}, queue_depth: 1000}}}}]
"""
"""Publishers keep what a busy subscriber has not taken. Braces are doubled once for `Site.table`."""


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Site, int]]:
    """A router with topics of all kinds, and the port of its gateway."""
    port = free_port(kind=socket.SOCK_STREAM)
    with running(tmp_path_factory.mktemp("beside"), BESIDE.replace("DASHBOARD", str(port))) as (place, _):
        yield place, port


def test_topics_get_all_values_in_order_or_the_latest(beside: tuple[Site, int]) -> None:
    place, _ = beside
    with hearing(place, "beside_a", "beside_b", "beside_latest") as (first, second, latest):
        before = place.scrape()
        for each in range(300):
            place.send("sensor_board", imu(each))
            if each % 10 == 0:
                sleep(0.01)
        assert taken(first, 300) == taken(second, 300) == list(range(300))
        values = [0.0]
        while values[-1] != 299:
            values += taken(latest, 1)
        assert values == sorted(values)
        balance(place.settle(before, 300), ())


def test_a_topic_of_two_routes_is_in_order(beside: tuple[Site, int]) -> None:
    place, _ = beside
    with hearing(place, "beside_shared") as (shared,):
        for each in range(0, 200, 2):
            place.send("sensor_board", imu(each), gps(each + 1))
            sleep(0.001)
        assert taken(shared, 200) == list(range(200))


def test_who_joins_late_gets_the_last_values(beside: tuple[Site, int]) -> None:
    place, _ = beside
    before = place.scrape()
    place.send("sensor_board", *(imu(1000.0 + each) for each in range(20)))
    place.settle(before, 20)
    with closing(Subscriber("beside_kept", FLOAT, "--transient-local")) as late:
        assert late.line() == "matched"
        assert taken(late, 5) == [1015.0, 1016.0, 1017.0, 1018.0, 1019.0]


def test_a_gateway_publishes_on_the_topic_of_a_route_at_the_same_time(beside: tuple[Site, int]) -> None:
    place, port = beside
    with hearing(place, "beside_a") as (both,), Dashboard(port) as client:
        before = place.scrape()
        with sending(place, imu) as sent:
            for each in range(200):
                client.ask(op="publish", topic="/beside_a", data={"data": -1.0 - each}, time=time())
            published = 0
            while published < 200:
                published = total(place.changes(before), "messages_published", route="dashboard")
        found = taken(both, 200 + sent[0])
        assert [value for value in found if value < 0] == [-1.0 - each for each in range(200)]
        assert [value for value in found if value >= 0] == list(range(sent[0]))


@pytest.mark.parametrize("options", [("--best-effort",), ()])
def test_a_subscriber_with_a_shared_memory_of_its_own(beside: tuple[Site, int], options: Sequence[str]) -> None:
    """As one in a container: the middleware takes it for one on this computer, but cannot reach it by shared memory."""
    place, _ = beside
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root can have a /dev/shm of its own, by unshare")
    peer = [sys.executable, str(peers.__file__), "subscribe", "beside_a", FLOAT, *options]
    command = ["unshare", "-m", "sh", "-c", 'mount -t tmpfs tmpfs /dev/shm && exec "$@"', "sh", *peer]
    environment = {
        **os.environ,
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(ros_child.__file__).with_suffix(".xml")),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    with (
        hearing(place, "beside_a") as (near,),
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as apart,
    ):
        assert apart.stdout is not None
        assert apart.stdin is not None
        assert apart.stdout.readline() == "matched\n"
        with sending(place, imu) as sent:
            wait_until(lambda: sent[0] >= 300)
        assert taken(near, sent[0]) == list(range(sent[0]))
        apart.stdin.close()
        apart.stdout.read()
        assert apart.wait(60) == 0


# ---- subscribers that go


def test_subscribers_are_killed_while_datagrams_flow(tmp_path: Path) -> None:
    """With a deep queue: in one of 10, the middleware may overwrite what a reader has to be sent again."""
    routes = f"""\
routes:
  imu_info:
    source: any
    destinations: [basestation]
    topics: [{{{{topic: killed_a, {_FLOAT}, queue_depth: 1000}}}}, {{{{topic: killed_b, {_FLOAT}, {LATEST}}}}}]
"""
    with running(tmp_path, routes) as (place, router), hearing(place, "killed_a") as (stays,):
        before = place.scrape()
        with sending(place, imu, period=0.01) as sent:
            for _ in range(3):
                killed = [Subscriber(topic, FLOAT, *how) for topic in ("killed_a", "killed_b") for how in _RELIABILITY]
                for each in killed:
                    assert each.line() == "matched"
                    assert next_of(each) >= 0
                for each in killed:
                    each.kill()
        assert [place.receive("basestation") for _ in range(sent[0])] == [imu(each) for each in range(sent[0])]
        counts = place.settle(before, sent[0])
        balance(counts, ())
        lost = total(counts, "messages_dropped", target="killed_a")
        lost += total(counts, "messages_filtered", target="killed_a")
        values = taken(stays, sent[0] - lost)
        assert values == sorted(set(values))
        assert router.stop(signal.SIGTERM) == 0


_RELIABILITY: Sequence[Sequence[str]] = ((), ("--best-effort",))


# ---- reloads


def test_topics_change_how_they_are_limited_in_reloads_while_datagrams_flow(tmp_path: Path) -> None:
    """Each reload has one topic keep the latest, and the other one no longer."""
    routes = f"""\
routes:
  imu_info:
    source: any
    topics: [{{{{topic: moved_a, {_FLOAT}, FIRST}}}}, {{{{topic: moved_b, {_FLOAT}, SECOND}}}}]
"""
    when = "when: accel_y < 5", LATEST
    tables = [routes.replace("FIRST", first).replace("SECOND", second) for first, second in (when, when[::-1])]
    with running(tmp_path, tables[0]) as (place, router), hearing(place, "moved_a", "moved_b") as (first, second):
        before = place.scrape()
        with sending(place, imu) as sent:
            for turn in range(1, 9):
                place.table(BARE + tables[turn % 2])
                router.process.send_signal(signal.SIGHUP)
                wait_until(lambda: len(router.events("table reloaded")) == turn, "the reload")  # noqa: B023 - at once
        counts = place.settle(before, sent[0])
        assert total(counts, "messages_published") == 2 * sent[0]
        assert taken(first, sent[0]) == list(range(sent[0]))
        assert taken(second, sent[0]) == list(range(sent[0]))
        assert not [line for line in router.log() if line["level"] in {"error", "critical"}]
