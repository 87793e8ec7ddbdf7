"""Two routers with one table in one ROS domain, told apart by `--ros-args`: a namespace, a node's name and remaps."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

import pytest
from websockets.sync.client import connect

from router.ros.topics import TopicListener
from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import ROOT, RouterProcess, Site, key, udp, wait_until
from tests.envelopes import rover_envelope
from tests.ports import free_port
from tests.repeating import repeating

SENSOR_BOARD, DRIVING_BOARD, ROUTER = "127.0.0.30", "127.0.0.31", "127.0.0.5"

TABLE = """\
version: 1
envelope: {{protos: {root}/protos, message: PBEnvelope, oneof: payload}}
node: {{diagnostics: true}}
http: {{address: "127.0.0.1:${{METRICS}}"}}
listen:
  rover: {{address: "127.0.0.5:${{LISTEN}}"}}
endpoints:
  sensor_board: {{address: "127.0.0.30:${{SENSOR_BOARD}}", kind: board}}
  driving_board: {{address: "127.0.0.31:${{DRIVING_BOARD}}", kind: board}}
routes:
  imu_info:
    source: sensor_board
    topics:
      - {{topic: imu_data, type: comms/msg/ImuSensorInformation, fields: auto}}
      - {{topic: /heading, type: std_msgs/msg/Float32, fields: {{data: accel_x}}}}
  drive_motor:
    source: {{topic: drive, type: comms/msg/DrivingBoardMotorMessage}}
    fields: auto
    destinations: [driving_board]
    deadman: {{none: a test of names alone}}
gateways:
  page:
    transport: {{websocket: "127.0.0.1:${{PAGE}}"}}
    topics: {{include: ["${{NAMESPACE}}/**", /heading]}}
    discovery_period: 200ms
    inbound: [{{topic: note, type: comms/msg/DrivingBoardMotorMessage}}]
"""

pytestmark = pytest.mark.slow

ONE = ("-r", "__ns:=/rover1", "-r", "__node:=one", "-r", "imu_data:=imu", "-r", "/heading:=/rover1/heading")
TWO = ("-r", "__ns:=/rover2", "-r", "imu_data:=imu", "-p", "use_sim_time:=true")

HEARD = {
    "/rover1/imu": "comms/msg/ImuSensorInformation",
    "/rover2/imu": "comms/msg/ImuSensorInformation",
    "/rover1/heading": "std_msgs/msg/Float32",
    "/heading": "std_msgs/msg/Float32",
    "/rover1/note": "comms/msg/DrivingBoardMotorMessage",
    "/rover2/note": "comms/msg/DrivingBoardMotorMessage",
}
"""Where messages are expected, with the remaps above."""


@dataclass(frozen=True)
class Rover:
    """One router with boards of its own."""

    site: Site
    router: RouterProcess
    page: int

    def sense(self, accel_x: float) -> None:
        self.site.send("sensor_board", enveloped(imu_info={"accel_x": accel_x}))

    def count(self, metric: str, **labels: str) -> int:
        return self.site.scrape()[key(metric, **labels)]


def enveloped(**payload: object) -> bytes:
    data: bytes = rover_envelope().message_class(**payload).SerializeToString()
    return data


def started(opening: ExitStack, folder: Path, namespace: str, ros_args: Sequence[str]) -> Rover:
    folder.mkdir()
    (folder / "table.yaml").write_text(TABLE.format(root=ROOT))
    boards = {
        name: opening.enter_context(udp(host))
        for name, host in (("sensor_board", SENSOR_BOARD), ("driving_board", DRIVING_BOARD))
    }
    site = Site(folder, boards, free_port(ROUTER), free_port(kind=socket.SOCK_STREAM))
    page = free_port(kind=socket.SOCK_STREAM)
    values: dict[str, object] = {name: board.getsockname()[1] for name, board in boards.items()}
    values |= {"listen": site.listen, "metrics": site.metrics, "page": page, "namespace": namespace}
    words = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    router = opening.enter_context(RouterProcess(folder, folder / "table.yaml", "--ros-args", *words, *ros_args))
    return Rover(site, router, page)


@pytest.fixture(scope="module")
def rovers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rover, Rover]]:
    folder = tmp_path_factory.mktemp("rovers")
    with ExitStack() as opening:
        yield (
            started(opening, folder / "one", "/rover1", ONE),
            started(opening, folder / "two", "/rover2", TWO),
        )


def test_data_arrive_on_the_topics_of_their_rover_only(rovers: tuple[Rover, Rover]) -> None:
    one, two = rovers
    with RosPeer(HEARD) as peer:

        def publishes(rover: Rover, accel_x: float, topic: str) -> bool:
            rover.sense(accel_x)
            return rover.count("messages_published", route="imu_info", topic=topic) > 0

        for rover, accel_x in ((one, 1.0), (two, 2.0)):
            for topic in ("imu_data", "/heading"):  # that somebody subscribes, the router learns a little later
                wait_until(partial(publishes, rover, accel_x, topic), topic)
        published = sum(
            rover.count("messages_published", route="imu_info", topic=topic)
            for rover in rovers
            for topic in ("imu_data", "/heading")
        )
        arrived = [peer.receive() for _ in range(published)]
    values = {(topic, message.get("accel_x", message.get("data"))) for topic, message in arrived}
    assert values == {("/rover1/imu", 1.0), ("/rover1/heading", 1.0), ("/rover2/imu", 2.0), ("/heading", 2.0)}


def test_commands_reach_the_board_of_their_rover_only(rovers: tuple[Rover, Rover]) -> None:
    command = "comms/msg/DrivingBoardMotorMessage"
    with RosPeer() as talker:
        talker.open_heard({"/rover1/drive": command, "/rover2/drive": command})
        for number, rover in enumerate(rovers, 1):
            talker.say(f"/rover{number}/drive", {"distance_to_go": float(number)})
            expected = enveloped(drive_motor={"distance_to_go": float(number)})
            assert rover.site.receive("driving_board") == expected
    for rover in rovers:
        assert (
            rover.count("messages_received", route="drive_motor", source="drive") == 1
        )  # the table's name is the label
        assert rover.site.waiting() == {}


def test_simulated_time_is_said_to_be_ignored(rovers: tuple[Rover, Rover]) -> None:
    lines = [[line for line in each.router.log() if "use_sim_time" in line["event"]] for each in rovers]
    assert [[line["level"] for line in each] for each in lines] == [[], ["warning"]]


def test_diagnostics_name_the_node_as_ros_does(rovers: tuple[Rover, Rover]) -> None:
    wanted, names = {"rover1/one: route/imu_info", "rover2/rover_router: route/imu_info"}, set[str]()
    with closing(TopicListener("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")) as listener:
        deadline = monotonic() + PATIENCE
        while not wanted <= names:
            assert monotonic() < deadline, names
            names |= {status.name for cdr, _ in listener.take(0.1) for status in listener.message(cdr).status}
    assert {name.partition(":")[0] for name in names} == {"rover1/one", "rover2/rover_router"}


def heard(rover: Rover, until: Callable[[dict[str, Any]], object], say: dict[str, Any] | None = None) -> dict[str, Any]:
    """The first document of the rover's page that `until` wants, after the page has said something."""
    with connect(f"ws://127.0.0.1:{rover.page}/", open_timeout=PATIENCE, close_timeout=1) as page:
        if say:
            page.send(json.dumps(say))
        deadline = monotonic() + PATIENCE
        while monotonic() < deadline:
            for document in map(json.loads, str(page.recv(timeout=PATIENCE)).split("\n")):
                if until(document):
                    return dict(document)
    raise AssertionError("it never came")


def test_what_clients_of_a_gateway_send_follows_the_namespace(rovers: tuple[Rover, Rover]) -> None:
    arrival: tuple[str, dict[str, Any]] | None = None
    with RosPeer(HEARD) as peer:
        for number, rover in enumerate(rovers, 1):
            values = {"distance_to_go": float(number), "turning_radius": 0.0}
            note = {"op": "publish", "topic": "/note", "data": values}
            before = arrival
            with repeating(partial(heard, rover, lambda document: document["op"] == "inbound", note)):
                while (arrival := peer.receive()) == before:
                    pass
            assert arrival == (f"/rover{number}/note", values)


def test_a_gateway_goes_by_the_names_of_the_network(rovers: tuple[Rover, Rover]) -> None:
    """The patterns match them, what its own clients send does not come back, and no name stands for another topic."""
    with RosPeer(HEARD):
        for number, rover in enumerate(rovers, 1):

            def listed(document: dict[str, Any], own: str = f"/rover{number}/imu") -> bool:
                return document["op"] == "topics" and own in {each["topic"] for each in document["topics"]}

            topics = {each["topic"] for each in heard(rover, listed)["topics"]}
            expected = {f"/rover{number}/imu"} | ({"/rover1/heading"} if number == 1 else {"/heading"})
            assert topics == expected
    [refused] = rovers[0].router.events("topic cannot be served")
    assert refused["topic"] == "/heading"
    assert "'/rover1/heading'" in refused["error"]
