"""Commands from real publishers, in processes of their own, to real sockets."""

from __future__ import annotations

import ctypes
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.carrier.conftest import SANITIZED

pytest.importorskip("rclpy", reason="needs ROS 2")
if SANITIZED in os.environ:
    pytest.skip("ROS does not start with sanitizers", allow_module_level=True)

from rclpy.node import Node

from router.carrier.deadmen import Deadmen
from router.carrier.from_ros import FromRosThread
from router.carrier.loading import LoadedImage
from router.carrier.ring import Ring
from router.carrier.ros_routes import RosRoutes
from router.carrier.sender import NativeSender
from router.compiler.compiled_table import CompiledTable
from router.image.writer import write_image
from router.net.udp import open_sending
from router.ros.node import close_node, open_node
from router.ros.qos import qos_profile
from router.ros.receiving import RESET, TAKE, RawSubscription
from router.ros.types import installed_class
from tests.ros.peers import Publisher, wait_until
from tests.small_tables import program

HEAD = """version: 1
envelope: {protos: PROTOS, message: PBEnvelope, oneof: payload}
listen: {here: {address: 127.0.0.1:5000}}
endpoints: {driving_board: {address: 127.0.0.1:PORT, kind: board}}
routes:
"""
ROUTES = """\
  drive_motor:
    source: {topic: drive_motor, type: comms/msg/DrivingBoardMotorMessage, queue_depth: 1000}
    fields: auto
    destinations: [driving_board]
    ttl: 30s
    deadman: {timeout: 30s, send: {manual_brake: {brake: true}}, to: [driving_board], repeat: 100ms}
"""
TYPE = "comms/msg/DrivingBoardMotorMessage"


@dataclass
class Router:
    """The thread between a node of ours and a board."""

    program: CompiledTable
    library: ctypes.CDLL
    thread: FromRosThread
    deadmen: Deadmen
    board: socket.socket

    def received(self, count: int) -> list[float]:
        """The distances of the next commands."""
        return [struct.unpack_from("<f", self.board.recv(1000), 3)[0] for _ in range(count)]

    def total(self, metric: str) -> int:
        counts = self.thread.counters(1 << 12)
        return sum(counts[index] for series, index in self.program.counters.series() if series.metric == metric)


@pytest.fixture
def node() -> Iterator[Node]:
    made = open_node("from_ros_test")
    yield made
    close_node(made)


@pytest.fixture
def router(library: ctypes.CDLL, node: Node, tmp_path: Path) -> Iterator[Router]:
    with ExitStack() as stack:
        board = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        board.bind(("127.0.0.1", 0))
        board.settimeout(20)
        made = program(tmp_path, ROUTES, HEAD.replace("PORT", str(board.getsockname()[1])))
        senders = {to.name: NativeSender(library, to.address.value, open_sending(to)) for to in made.senders}
        for sender in senders.values():
            stack.callback(sender.close)
        counters = (ctypes.c_int64 * (1 << 12))()
        deadmen = Deadmen(library, (ctypes.c_int64 * (1 << 12))(), Ring(library, 1 << 12))
        image = LoadedImage(library, write_image(made), senders, deadmen.address, 1)
        (plan,) = made.subscriptions
        subscription = RawSubscription(node, installed_class(TYPE), plan.topic, qos_profile(plan.qos))
        stack.callback(subscription.close)
        thread = FromRosThread(library, deadmen.address, counters, Ring(library, 1 << 12))
        thread.start(TAKE, RESET)
        stack.callback(thread.stop)
        thread.serve(RosRoutes.of(image, {plan.label: subscription}))
        yield Router(made, library, thread, deadmen, board)


def drive(distance: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<ff", distance, 1)


def test_commands_arrive_in_order_with_their_values_and_the_brake_behind_them(router: Router) -> None:
    distances = [0.5 * number for number in range(1, 201)]
    with closing(Publisher("drive_motor", TYPE)) as publisher:
        assert publisher.line() == "matched"
        publisher.publish(map(drive, distances))
        assert router.received(len(distances)) == distances
    wait_until(lambda: router.total("messages_received") == len(distances))
    assert router.total("datagrams_sent") == len(distances)
    assert router.total("messages_dropped") == 0
    assert router.thread.failures == 0
    router.library.timers_serve(router.deadmen.address, 1 << 62)
    assert (router.board.recv(1000),) == router.program.deadmen[0].datagrams[0][1]


def test_what_has_arrived_is_sent_before_the_stop(router: Router) -> None:
    with closing(Publisher("drive_motor", TYPE)) as publisher:
        assert publisher.line() == "matched"
        publisher.publish([drive(7)] * 50)
        publisher.await_receipt()
        assert router.thread.stop()
        assert router.received(50) == [7] * 50
