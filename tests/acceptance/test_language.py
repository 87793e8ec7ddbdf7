"""Lists, calculations and conditions through a router: sockets on one side, ROS on the other."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from time import sleep
from typing import Any, NamedTuple

import pytest
from google.protobuf.message import Message

from router.errors import Located, SourceSpan
from router.types.protobuf import Envelope, find_envelope, load_protos
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import RouterProcess
from tests.ports import free_port

PROTO = """\
syntax = "proto3";

message Scan { float start = 1; repeated uint32 ranges_cm = 2; string from = 3; }
message Drive { sint32 left = 1; sint32 right = 2; }
message Waypoint { float x = 1; float y = 2; uint32 place = 3; string text = 4; }

message Envelope {
  oneof payload {
    Scan scan = 1;
    Drive drive = 2;
    Waypoint waypoint = 3;
  }
}
"""
TABLE = """\
version: 1
envelope: {{protos: protos, message: Envelope, oneof: payload}}
listen: {{lidar: {{address: "127.0.0.5:{listen}"}}}}
endpoints:
  scanner: {{address: "127.0.0.41:{port}", kind: tool}}
  brake: {{address: "127.0.0.42:{port}", kind: tool}}
  wheels: {{address: "127.0.0.43:{port}", kind: tool}}
routes:
  scan:
    source: scanner
    destinations: {{endpoint: brake, when: min(ranges_cm / 100) < 0.5}}
    topics:
      topic: scan
      type: sensor_msgs/msg/LaserScan
      fields:
        header.frame_id: from + '_' + text(start, 1)
        angle_min: radians(start)
        ranges: ranges_cm / 100
        intensities: float32(max(ranges_cm) - ranges_cm)
  drive:
    source: {{topic: cmd_vel, type: geometry_msgs/msg/Twist}}
    destinations: {{endpoint: wheels, when: linear.x == linear.x}}
    fields:
      left: round(clamp(100 * (linear.x - angular.z), -100, 100))
      right: round(clamp(100 * (linear.x + angular.z), -100, 100))
    deadman: {{none: only a test}}
  waypoint:
    source: {{topic: path, type: geometry_msgs/msg/PoseArray}}
    for_each: poses
    fields:
      x: float32(item.position.x)
      y: float32(item.position.y / 10)
      place: index
      text: header.frame_id + ' ' + str(index + 1) + '/' + str(count)
    destinations: {{endpoint: wheels, when: item.position.z >= 0}}
    deadman: {{none: only a test}}
"""
SPAN = SourceSpan("table.yaml", 1, 1, 1)


class Lidar(NamedTuple):
    """A running router with its boards and a ROS node."""

    peer: RosPeer
    boards: dict[str, socket.socket]
    router: tuple[str, int]
    envelope: Envelope

    def send(self, **fields: Any) -> None:
        scan = self.envelope.cases["scan"].message_class(**fields)
        made = self.envelope.message_class(scan=scan)
        self.boards["scanner"].sendto(made.SerializeToString(), self.router)

    def received_by(self, board: str) -> Message:
        return self.envelope.message_class.FromString(self.boards[board].recv(65535))

    def made(self, **payload: dict[str, Any]) -> Message:
        return self.envelope.message_class(**payload)


@pytest.fixture(scope="module")
def lidar(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lidar]:
    tmp_path = tmp_path_factory.mktemp("lidar")
    (tmp_path / "protos").mkdir()
    (tmp_path / "protos" / "lidar.proto").write_text(PROTO)
    port, listen = free_port(), free_port()
    table = tmp_path / "table.yaml"
    table.write_text(TABLE.format(listen=listen, port=port))
    schema = load_protos(Located(tmp_path / "protos", SPAN), Located("Envelope", SPAN))
    boards = {}
    for name, host in (("scanner", 41), ("brake", 42), ("wheels", 43)):
        boards[name] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        boards[name].bind((f"127.0.0.{host}", port))
        boards[name].settimeout(PATIENCE)
    with (
        RouterProcess(tmp_path, table),
        RosPeer({"scan": "sensor_msgs/msg/LaserScan"}) as peer,
    ):
        peer.open_heard({"cmd_vel": "geometry_msgs/msg/Twist", "path": "geometry_msgs/msg/PoseArray"})
        yield Lidar(peer, boards, ("127.0.0.5", listen), find_envelope(schema, Located("payload", SPAN)))
    for board in boards.values():
        board.close()


def single(x: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", x))[0])


def test_a_lidar_in_centimetres_becomes_a_laser_scan_and_brakes_when_something_is_near(lidar: Lidar) -> None:
    while lidar.peer.nothing_left():  # until the router knows of the subscriber
        lidar.send(ranges_cm=[1000])
        sleep(0.05)
    lidar.send(start=-90.0, ranges_cm=[150, 275, 1200], **{"from": "mast"})
    while (scan := lidar.peer.receive_on("scan"))["ranges"] == [10.0]:
        pass
    assert scan["header"]["frame_id"] == "mast_-90.0"
    assert scan["angle_min"] == single(-1.5707963267948966)
    assert scan["ranges"] == [1.5, 2.75, 12.0]
    assert scan["intensities"] == [1050.0, 925.0, 0.0]
    lidar.send(ranges_cm=[150, 49])
    assert lidar.peer.receive_on("scan")["ranges"] == [1.5, single(0.49)]
    assert lidar.received_by("brake") == lidar.made(scan={"ranges_cm": [150, 49]})
    lidar.send(ranges_cm=[])  # of which there is no min()
    assert lidar.peer.receive_on("scan")["ranges"] == []
    lidar.send(ranges_cm=[7])
    assert lidar.peer.receive_on("scan")["ranges"] == [single(0.07)]
    assert lidar.received_by("brake") == lidar.made(scan={"ranges_cm": [7]})


def test_a_twist_becomes_two_wheels(lidar: Lidar) -> None:
    def twist(x: float, z: float) -> dict[str, Any]:
        return {"linear": {"x": x}, "angular": {"z": z}}

    lidar.peer.say(
        "cmd_vel", twist(0.5, 0.25), twist(float("nan"), 0.0), twist(0.005, float("nan")), twist(3.0, -0.016)
    )
    assert lidar.received_by("wheels") == lidar.made(drive={"left": 25, "right": 75})
    assert lidar.received_by("wheels") == lidar.made(drive={"left": 100, "right": 100})


def test_each_pose_of_a_path_is_a_datagram(lidar: Lidar) -> None:
    places = [(1.0, 20.0, 0.0), (2.0, 5.0, -1.0), (3.5, 0.0, 2.0)]
    poses = [{"position": {"x": x, "y": y, "z": z}} for x, y, z in places]
    lidar.peer.say("path", {"header": {"frame_id": "map"}, "poses": poses}, {"poses": []}, {"poses": poses[2:]})
    expected = [
        {"x": 1.0, "y": 2.0, "place": 0, "text": "map 1/3"},
        {"x": 3.5, "y": 0.0, "place": 2, "text": "map 3/3"},
        {"x": 3.5, "y": 0.0, "place": 0, "text": " 1/1"},
    ]
    for waypoint in expected:
        assert lidar.received_by("wheels") == lidar.made(waypoint=waypoint)
