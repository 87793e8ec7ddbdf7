"""What a router does by itself is mirrored, whatever thread does it: commands from ROS, brakes, losses, trips."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Sequence
from contextlib import closing

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.app import Router
from router.recording.mirror import Acted, Action
from tests.app.conftest import BRAKE, DRIVE, Site, udp
from tests.app.test_client_deadmen import COMMAND, gateway
from tests.app.test_from_ros import TYPE, UNHURRIED, command, drive
from tests.ports import free_port
from tests.ros.peers import Publisher, wait_until

MANUAL = """\
  manual_drive:
    source: sensor_board
    destinations: [basestation]
    deadman: {timeout: 150ms, send: {manual_brake: {brake: true}}, to: [basestation], repeat: 1h}
"""
FORWARDED = "  ph_info: {source: sensor_board, destinations: [basestation]}\n"
PH = bytes.fromhex("0a00")
DIVIDED = drive(fields='{distance_to_go: "float32(100 // round(distance_to_go))"}')


def watched(router: Router) -> list[Action]:
    """The actions from now on, without their times, and without brakes of the start."""
    seen: list[Action] = []

    def see(actions: Sequence[Acted]) -> None:
        assert [at for at, *_ in actions] == sorted(at for at, *_ in actions)
        found = (Action._make(each)._replace(at=0) for each in actions)
        seen.extend(each for each in found if seen or each.what != "braked")

    router.mirror.attach(lambda _: None, see)
    return seen


def published(publisher: Publisher, number: int) -> bool:
    publisher.publish([command(number)])
    return True


def test_commands_that_feed_a_deadman_are_actions_and_all_that_it_does(site: Site) -> None:
    """The other datagrams are only forwarded: the mirror has them as received."""
    with site.router(MANUAL + FORWARDED) as router:
        seen = watched(router)
        site.send(PH, DRIVE, PH)
        wait_until(lambda: len(seen) >= 3)
        site.send(DRIVE)
        wait_until(lambda: len(seen) >= 5)
    braked = Action(0, "braked", "manual_drive", "basestation", data=BRAKE)
    sent = braked._replace(what="sent", data=DRIVE)
    tripped, released = Action(0, "tripped", "manual_drive"), Action(0, "released", "manual_drive")
    assert seen[:5] == [sent, tripped, braked, released, sent]
    assert seen[5:] in ([braked], [tripped, braked, braked])  # at the end, which may be later than the timeout


def test_a_client_who_feeds_his_deadman_is_an_action(site: Site) -> None:
    port = free_port(kind=socket.SOCK_STREAM)
    with site.router(FORWARDED + gateway(port, timeout="150ms")) as router:
        seen = watched(router)
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(COMMAND)
            wait_until(lambda: len(seen) >= 2)
    assert seen[:2] == [Action(0, "fed", "operator:/drive"), Action(0, "tripped", "operator:/drive")]


def test_the_end_of_a_silence_is_an_action(site: Site) -> None:
    endpoints = "  arm_board: {address: 127.0.0.40:8, kind: tool, stale_after: 250ms}\n"
    route = FORWARDED.replace("sensor_board", "[sensor_board, arm_board]")
    with udp("127.0.0.40") as board, Router(site.program(route, endpoints)) as router:
        seen = watched(router)

        def is_back() -> bool:
            """Send for a while, and again after a silence."""
            for pause in [0.005] * 60 + [0.2, 0.1]:
                board.sendto(PH, ("127.0.0.1", site.listen))
                time.sleep(pause)
            return bool(seen)

        wait_until(is_back)
    assert (seen[0].what, seen[0].target, seen[0].route) == ("returned", "arm_board", "")
    assert re.fullmatch(r"0\.[1-9] s", seen[0].detail)


@pytest.mark.parametrize("table", [drive(), UNHURRIED], ids=["urgent", "unhurried"])
def test_commands_from_ros_are_actions(site: Site, table: str) -> None:
    with closing(Publisher("drive_motor", TYPE)) as publisher, site.router(table) as router:
        seen = watched(router)
        wait_until(lambda: published(publisher, 7) and seen)
    assert seen[0]._replace(data=b"") == Action(0, "sent", "drive_motor", "basestation", "drive_motor")
    while (arrived := site.basestation.recv(1000)) == BRAKE:  # of the start
        pass
    assert arrived == seen[0].data


def test_commands_that_are_lost_are_actions_with_the_reason(site: Site) -> None:
    with closing(Publisher("drive_motor", TYPE)) as publisher, site.router(DIVIDED) as router:
        seen = watched(router)
        wait_until(lambda: published(publisher, 0) and seen)
    lost = Action(0, "lost", "drive_motor", "basestation", "drive_motor", "mapping_error", "division by zero")
    assert {each for each in seen if each.what != "braked"} == {lost}


def test_what_the_full_mirror_drops_is_counted_and_delays_no_brake(site: Site) -> None:
    with site.router(MANUAL) as router:
        router._runtime.plane.observe(is_observed=True)  # and nobody takes
        for _ in range(14_000):
            site.send(DRIVE)
            assert site.basestation.recv(1000) in (DRIVE, BRAKE)
        wait_until(lambda: router.total("mirror_dropped") > 0)
        wait_until(lambda: router.total("deadman_trips") > 0)
