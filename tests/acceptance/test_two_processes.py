"""A router and its gateways in two processes, as the services of deploy/ run them: what reaches the boards."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed

from tests.acceptance.gateway_clients import Dashboard
from tests.acceptance.payloads import WIRE
from tests.acceptance.site import BARE, RouterProcess, Site, site, wait_until
from tests.ports import free_port
from tests.repeating import repeating

BOARDS = {"driving_board": "127.0.0.222", "arm_board": "127.0.0.40"}
ROUTES = """
defaults: {{package: comms}}
routes:
  drive_motor:
    source: {{topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage}}
    destinations: driving_board
    ttl: 2s
    deadman: {{timeout: 500ms, send: {{manual_brake: {{brake: true}}}}}}
  arm_ctrl:
    source: {{topic: arm_ctrl, type: comms/msg/ArmBoardControlSignals}}
    destinations: arm_board
    ttl: 2s
    deadman: {{none: the gateway's deadman sends what holds the arm}}
"""
GATEWAYS = """\
version: 1
node: {name: rover_gateways}
http: {address: 127.0.0.1:METRICS}
gateways:
  operator:
    transport: {websocket: 127.0.0.5:PORT}
    inbound:
      - {topic: /drive_motor, type: comms/msg/DrivingBoardMotorMessage, ttl: 2s}
      - {topic: /arm_ctrl, type: comms/msg/ArmBoardControlSignals, ttl: 2s,
         deadman: {timeout: 500ms, send: {control_base: 7}, at_start: silent, because: the test awaits it later}}
"""
DRIVE = ("/drive_motor", "comms/msg/DrivingBoardMotorMessage", {"distance_to_go": 5.0, "turning_radius": 0.0})
SIGNALS = dict.fromkeys(("control_gripper_rotation", "control_gripper_pitch", "control_base", "control_jaw"), 1.0)
STEPPERS = dict.fromkeys(("stepper_top_ena", "stepper_top_rev", "stepper_bottom_ena", "stepper_bottom_rev"), False)
ARM = ("/arm_ctrl", "comms/msg/ArmBoardControlSignals", {**SIGNALS, **STEPPERS})


@dataclass
class Rover:
    site: Site
    router: RouterProcess
    gateways: RouterProcess
    client: Dashboard
    metrics: int
    """The HTTP port of the gateways."""

    def publish(self, topic: str, type_name: str, data: object) -> None:
        with suppress(ConnectionClosed):  # the test ends the gateways
            self.client.ask(op="publish", topic=topic, type=type_name, data=data, time=time.time())

    def await_sent(self, board: str, case: str, holds: Callable[[Any], bool] = lambda _: True) -> None:
        """Wait for a payload of this case that a board receives."""

        def has_come() -> bool:
            envelope = WIRE.decode(self.site.receive(board))
            return envelope.case.name == case and holds(envelope.message)

        wait_until(has_come, f"{case} at {board}")


@pytest.fixture
def rover(tmp_path: Path) -> Iterator[Rover]:
    folders = [tmp_path / name for name in ("router", "gateways")]
    for folder in folders:
        folder.mkdir()
    metrics = free_port(kind=socket.SOCK_STREAM)
    port = free_port("127.0.0.5", kind=socket.SOCK_STREAM)
    table = folders[1] / "table.yaml"
    table.write_text(GATEWAYS.replace("METRICS", str(metrics)).replace("PORT", str(port)))
    with (
        site(folders[0], BOARDS) as place,
        RouterProcess(folders[0], place.table(BARE + ROUTES)) as router,
        RouterProcess(folders[1], table) as gateways,
        Dashboard(port) as client,
    ):
        yield Rover(place, router, gateways, client, metrics)


@contextmanager
def commanded(rover: Rover, board: str, command: tuple[str, str, object]) -> Iterator[None]:
    """A client of the gateway repeats a command, and the board receives it."""
    with repeating(partial(rover.publish, *command)):
        rover.await_sent(board, command[0].removeprefix("/"))
        yield


def test_the_routes_deadman_brakes_when_the_gateways_are_killed(rover: Rover) -> None:
    with commanded(rover, "driving_board", DRIVE):
        rover.gateways.process.kill()
        rover.await_sent("driving_board", "manual_brake", lambda payload: payload.brake)
    rover.gateways.wait()
    assert rover.router.process.poll() is None


@pytest.mark.parametrize("how", ["the client falls silent", "the gateways are stopped"])
def test_a_gateways_deadman_reaches_the_board_through_the_router(rover: Rover, how: str) -> None:
    with commanded(rover, "arm_board", ARM):
        if how == "the gateways are stopped":
            assert rover.gateways.stop(signal.SIGTERM) == 0
            rover.await_sent("arm_board", "arm_ctrl", lambda payload: payload.control_base == 7)
            return
    rover.await_sent("arm_board", "arm_ctrl", lambda payload: payload.control_base == 7)


def test_neither_is_reported_as_another_router(rover: Rover) -> None:
    with commanded(rover, "driving_board", DRIVE):
        time.sleep(2.5)  # each looks around once a second
        for place in (rover.site, Site(rover.site.folder, {}, 0, rover.metrics)):
            samples = place.samples()
            assert samples
            assert not [
                name for name in samples if name.startswith(("other_routers", "node_namesakes")) and samples[name]
            ]
