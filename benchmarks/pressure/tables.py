"""The tables that are run, each written for one process: a rover's own, on the loopback interface alone."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path

from benchmarks.versus.contenders import TABLES
from tests.ports import free_port

TTL_MS, TIMEOUT_MS, REPEAT_MS = 200, 500, 100
"""Of commands and their deadmen, as on the rover."""

SENSOR_BOARD, BASESTATION = "127.0.0.30", "127.0.0.10"
DRIVING_BOARD, ARM_BOARD = "127.0.0.222", "127.0.0.40"
"""Endpoints are told apart by their address. Over UDP the first board is commanded, from ROS the second."""

COMMAND_TOPIC = "drive_motor"
IMAGE_TOPIC = "/camera/image_raw"

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - Fast DDS has it there

TABLE = """\
version: 1
extends: {base}
networks: [127.0.0.0/8]
http: {{address: "127.0.0.1:{metrics}"}}
foxglove: {{address: "127.0.0.1:{foxglove}"}}
record: {{directory: "{recordings}"}}
listen:
  rover: {{address: "127.0.0.1:{listen}"}}
{listener}endpoints:
  basestation: {{address: "{basestation}:{first}"}}
  driving_board: {{address: "{driving_board}"}}
  arm_board: {{address: "{arm_board}"}}
routes:
  manual_drive:
    source: basestation
    destinations: [driving_board]
    ttl: {ttl}ms
    deadman: {{{deadman}, to: [driving_board]}}
  drive_motor:
    source: {{topic: {command_topic}, type: comms/msg/DrivingBoardMotorMessage, queue_depth: 10}}
    fields: auto
    destinations: [arm_board]
    ttl: {ttl}ms
    deadman: {{{deadman}, to: [arm_board], because: the arm board stands for a second driving board here}}
  manual_arm: {{deadman: {{because: the arm board stands for a second driving board here}}}}
"""

GATEWAY = """\
gateways:
  camera:
    transport: {{websocket: "127.0.0.1:{websocket}"}}
    topics: {{include: ["{topic}"]}}
    publish_period: 100ms
    discovery_period: 500ms
"""

DEADMAN = f"timeout: {TIMEOUT_MS}ms, repeat: {REPEAT_MS}ms, send: {{manual_brake: {{brake: true}}}}, disarmed_by: []"

LISTENER = """\
  spare: {{address: "127.0.0.1:{spare}"}}
"""
ROUTE = """\
  pressure_info:
    source: sensor_board
    destinations: [basestation]
    topics: [{topic: spare, type: comms/msg/SensorBoardPressureInfo, queue_depth: 10, fields: auto}]
"""
"""What each other reload adds: a listener, and at the end of the routes one that is another, with another topic."""


@dataclass(frozen=True)
class Place:
    """A folder, and ports for one process under test."""

    folder: Path
    listen: int
    spare: int
    first: int
    second: int
    driving_board: int
    arm_board: int
    metrics: int
    foxglove: int
    websocket: int

    @staticmethod
    def free(folder: Path) -> Place:
        folder.mkdir()
        tcp = socket.SOCK_STREAM
        return Place(
            folder,
            listen=free_port(),
            spare=free_port(),
            first=free_port(BASESTATION),
            second=free_port(),
            driving_board=free_port(DRIVING_BOARD),
            arm_board=free_port(ARM_BOARD),
            metrics=free_port(kind=tcp),
            foxglove=free_port(kind=tcp),
            websocket=free_port(kind=tcp),
        )

    @property
    def table(self) -> Path:
        return self.folder / "table.yaml"

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    def destinations(self) -> list[str]:
        """Where the process under test sends to."""
        boards = [f"{DRIVING_BOARD}:{self.driving_board}", f"{ARM_BOARD}:{self.arm_board}"]
        return [f"{BASESTATION}:{self.first}", *boards, f"127.0.0.1:{self.second}"]


def table(place: Place, pressure: str = "", is_changed: bool = False) -> str:
    """The table for a pressure; `is_changed` is what it is reloaded to."""
    text = TABLE.format(
        base=TABLES / "rover.yaml",
        metrics=place.metrics,
        foxglove=place.foxglove,
        recordings=place.recordings,
        listen=place.listen,
        listener=LISTENER.format(spare=place.spare) if is_changed else "",
        basestation=BASESTATION,
        first=place.first,
        driving_board=f"{DRIVING_BOARD}:{place.driving_board}",
        arm_board=f"{ARM_BOARD}:{place.arm_board}",
        command_topic=COMMAND_TOPIC,
        ttl=TTL_MS,
        deadman=DEADMAN,
    )
    if is_changed:
        text += ROUTE
    if pressure == "images":
        text += GATEWAY.format(websocket=place.websocket, topic=IMAGE_TOPIC)
    return text
