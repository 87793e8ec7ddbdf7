"""What boards get when the router starts, above all after it was killed while it drove: first what stops them."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from time import sleep

import pytest

from tests.acceptance.payloads import WIRE, sample
from tests.acceptance.site import BARE, RouterProcess, Site, key, site, total, udp, wait_until
from tests.ports import free_port
from tests.repeating import repeating

TABLE = (
    BARE
    + """\
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: 1h
    deadman: {{timeout: 1h, send: {{manual_brake: {{brake: true}}}}, to: [driving_board]}}
  manual_arm:
    source: basestation
    destinations: [arm_board]
    deadman: {{timeout: 1h, send: {{manual_arm: {{}}}}, to: [arm_board], at_start: silent}}   # for these tests
"""
)
GATEWAY = """\
gateways:
  operator:
    transport: {{{{tcp: 127.0.0.1:{port}}}}}
    format: json_lines
    topics: {{{{exclude: ["/**"]}}}}
    inbound:
      - topic: word
        type: std_msgs/msg/Int32
        qos: {{{{reliability: {qos}}}}}
        deadman: {{{{timeout: 1h, send: {{{{data: 7}}}}}}}}
"""
HOSTS = {"driving_board": "127.0.0.222", "arm_board": "127.0.0.40", "basestation": "127.0.0.10"}
ALONE = ("/usr/bin/unshare", "-n")
SENT = "the deadman has sent its payload at startup"


def envelope(case: str, **values: object) -> bytes:
    return sample(case, WIRE.envelopes.first.cases[case].message_class(**values)).datagram


DRIVE, BRAKE, ARM = envelope("manual_drive", turn=5), envelope("manual_brake", brake=True), envelope("manual_arm")


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Site]:
    with site(tmp_path, HOSTS) as opened:
        yield opened


def commands_that_flow(place: Site) -> AbstractContextManager[None]:
    return repeating(partial(place.send, "basestation", DRIVE), 0.005)


def kill(place: Site, router: RouterProcess) -> None:
    """While it drives; nothing waits at the boards afterwards."""
    with commands_that_flow(place):
        while place.receive("driving_board") != DRIVE:
            pass
        assert router.stop(signal.SIGKILL) == -signal.SIGKILL
    place.waiting()


def test_after_a_kill_while_driving_the_brake_is_the_first_that_the_board_gets(place: Site) -> None:
    table = place.table(TABLE)
    kill(place, RouterProcess(place.folder, table))
    with RouterProcess(place.folder, table) as router:
        assert place.receive("driving_board") == BRAKE
        samples, counts = place.samples(), place.scrape()
        wait_until(lambda: bool(router.events(SENT)), "the report")
        told = [line for line in router.log() if "deadman" in line["event"]]
        assert [(line["event"], line["level"], line["route"], line["to"]) for line in told] == [
            (SENT, "info", "manual_drive", ["driving_board"])
        ]
        labels = {"route": "manual_drive", "destination": "driving_board"}
        # Once, or more often where a second has passed: the board says nothing.
        assert counts[key("deadman_datagrams_sent", **labels)] == total(counts, "deadman_datagrams_sent") >= 1
        assert counts[key("deadman_send_errors", **labels)] == total(counts, "deadman_trips") == 0
        assert samples[key("deadman_active", route="manual_drive")] == 0
        kill(place, router)
    with commands_that_flow(place), RouterProcess(place.folder, table):
        assert [place.receive("driving_board") for _ in range(3)] == [BRAKE, DRIVE, DRIVE]


def brakes(place: Site, seconds: float) -> int:
    """How many datagrams, all of them brakes, come within this time."""
    sleep(seconds)
    waiting = place.waiting()
    assert waiting.keys() <= {"driving_board"}
    found = waiting.get("driving_board", [])
    assert set(found) <= {BRAKE}
    return len(found)


AGAIN = 1.0
"""Seconds until the brake of the start is repeated."""


def test_a_board_that_is_never_heard_is_braked_until_it_is_commanded(place: Site) -> None:
    with RouterProcess(place.folder, place.table(TABLE)):
        assert [place.receive("driving_board") for _ in range(4)] == [BRAKE] * 4
        place.send("basestation", DRIVE)
        while place.receive("driving_board") != DRIVE:
            pass
        assert brakes(place, 2.5 * AGAIN) == 0


def test_a_board_is_braked_once_more_after_it_was_heard(place: Site) -> None:
    with RouterProcess(place.folder, place.table(TABLE)):
        assert place.receive("driving_board") == BRAKE
        place.waiting()
        place.send("driving_board", ARM)  # a payload that nobody takes from it
        assert brakes(place, 3.5 * AGAIN) == 1


def test_a_reload_continues_the_brakes_of_the_start(place: Site) -> None:
    table = place.table(TABLE)
    with RouterProcess(place.folder, table) as router:
        assert place.receive("driving_board") == BRAKE
        place.waiting()
        table.write_text(table.read_text().replace("timeout: 1h", "timeout: 2h"))
        router.process.send_signal(signal.SIGHUP)
        wait_until(lambda: bool(router.events("table reloaded")), "the reload")
        assert [place.receive("driving_board") for _ in range(2)] == [BRAKE] * 2
        place.waiting()
        place.send("driving_board", ARM)
        assert brakes(place, 3.5 * AGAIN) == 1


def test_a_router_that_stops_before_the_first_command_sends_nothing_more(place: Site) -> None:
    with RouterProcess(place.folder, place.table(TABLE)) as router:
        assert place.receive("driving_board") == BRAKE
        assert router.stop(signal.SIGTERM) == 0
        place.waiting()
        assert brakes(place, 1.5 * AGAIN) == 0


def test_a_router_that_cannot_reach_the_board_starts_all_the_same(tmp_path: Path) -> None:
    """In a network namespace without any network."""
    if subprocess.run([*ALONE, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs a network namespace")
    endpoints = (
        "  driving_board: {address: 192.0.2.1:8, kind: board}\n  arm_board: {address: 192.0.2.2:8, kind: board}\n"
    )
    endpoints += "  basestation: {address: 192.0.2.3:8, kind: basestation}"
    ports = {"metrics": free_port(kind=socket.SOCK_STREAM), "listen": free_port()}
    text = TABLE.format(root=Path(__file__).parents[2], endpoints=endpoints, **ports)
    table = tmp_path / "table.yaml"
    table.write_text(text.replace("127.0.0.1:", "0.0.0.0:").replace("127.0.0.5:", "0.0.0.0:"))
    router = RouterProcess(tmp_path, table, within=ALONE)
    with router:
        wait_until(lambda: bool(router.events("deadman could not send")), "the report")
        [lost] = router.events("deadman could not send")
        assert (lost["route"], lost["target"], lost["reason"]) == ("manual_drive", "driving_board", "send_error")
        assert router.events(SENT) == []


def test_that_nobody_listens_yet_is_no_loss_of_the_first_command(place: Site) -> None:
    table = place.table(TABLE)
    address = place.endpoints["driving_board"].getsockname()
    place.endpoints["driving_board"].close()
    with RouterProcess(place.folder, table) as router, udp(*address) as board:
        wait_until(lambda: bool(router.events("deadman could not send")), "the report")
        [lost] = router.events("deadman could not send")
        assert (lost["route"], lost["target"]) == ("manual_drive", "driving_board")
        place.send("basestation", DRIVE)
        received = iter(lambda: board.recv(1000), None)
        assert next(each for each in received if each != BRAKE) == DRIVE
        counts = place.scrape()
        assert total(counts, "deadman_send_errors") >= 1
        assert total(counts, "datagrams_sent") == 1
        assert total(counts, "messages_dropped") == 0


@pytest.mark.slow
@pytest.mark.parametrize("qos", ["reliable", "best_effort"])
def test_who_listens_to_a_topic_with_a_deadman_is_stopped_when_it_is_met(place: Site, qos: str) -> None:
    """Until a client has sent something."""
    pytest.importorskip("rclpy", reason="needs ROS 2")
    from tests.ros.peers import Subscriber

    def subscriber() -> closing[Subscriber]:
        return closing(Subscriber("word", "std_msgs/msg/Int32", *["--best-effort"] * (qos == "best_effort")))

    def heard(by: Subscriber) -> int:
        return int.from_bytes(bytes.fromhex(by.line())[4:8], "little")

    port = free_port(kind=socket.SOCK_STREAM)
    table = place.table(TABLE + GATEWAY.format(port=port, qos=qos))
    sent = key("deadman_datagrams_sent", route="operator:/word", destination="/word")
    with subscriber() as first, RouterProcess(place.folder, table):
        assert first.line() == "matched"
        assert heard(first) == 7
        with subscriber() as second:
            assert second.line() == "matched"
            assert heard(second) == 7
            with socket.create_connection(("127.0.0.1", port)) as client:
                request = {"op": "publish", "topic": "/word", "type": "std_msgs/msg/Int32", "data": {"data": 1}}
                client.sendall(json.dumps(request).encode() + b"\n")
                while (number := heard(second)) != 1:
                    assert number == 7
            before = place.scrape()[sent]
            with subscriber() as third:
                assert third.line() == "matched"
                counts = place.scrape()
    assert counts[sent] == before
    assert total(counts, "deadman_trips") == 0
