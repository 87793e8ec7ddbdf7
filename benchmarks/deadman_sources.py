"""What `deadman_trials` plays against the router, each in a process of its own: command sources, load, subscribers.

    python -m benchmarks.deadman_sources udp TABLE HOST:PORT
    python -m benchmarks.deadman_sources ros TOPIC
    python -m benchmarks.deadman_sources flood TABLE HOST:PORT FROM RATE
    python -m benchmarks.deadman_sources subscriber TOPIC

A command carries the wall clock's milliseconds (modulo WRAP) at which it was made. SIGUSR1 cuts the ROS source off:
it lives on, and what it sends no longer arrives. A second one restores it.
"""

from __future__ import annotations

import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

from google.protobuf.message import Message

from router.compiler import check_table
from router.tools.udp import paced

WRAP = 1 << 22
"""ms; a float holds all numbers below exactly, and an hour is enough to tell fresh from stale."""

COMMAND_RATE = 50
_BURST = 20


def envelope_class(table: Path) -> type[Message]:
    program = check_table(table, {}).program
    if program is None:
        raise SystemExit(f"{table} has errors; see `router validate`")
    return program.envelopes.first.message_class


def stamp() -> int:
    return time.time_ns() // 1_000_000 % WRAP


def udp_commands(table: str, to: str) -> None:
    envelope = envelope_class(Path(table))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.connect(_address(to))
        _at_command_rate(lambda: opened.send(envelope(manual_drive={"forward_backward": stamp()}).SerializeToString()))


def ros_commands(topic: str) -> None:
    import rclpy  # here, because the others run without
    from comms.msg import DrivingBoardMotorMessage

    rclpy.init(args=[])
    publisher = rclpy.create_node("commander").create_publisher(DrivingBoardMotorMessage, topic, 10)
    is_cut_off = False

    def toggle(*_: object) -> None:
        nonlocal is_cut_off
        is_cut_off = not is_cut_off

    signal.signal(signal.SIGUSR1, toggle)

    def publish() -> None:
        if not is_cut_off:
            publisher.publish(DrivingBoardMotorMessage(distance_to_go=float(stamp())))

    _at_command_rate(publish)


def subscriber(topic: str) -> None:
    import rclpy
    from comms.msg import ImuSensorInformation

    rclpy.init(args=[])
    node = rclpy.create_node("subscriber")
    node.create_subscription(ImuSensorInformation, topic, lambda _: None, 10, raw=True)
    rclpy.spin(node)


def flood(table: str, to: str, source: str, rate: str) -> None:
    datagram = envelope_class(Path(table))(imu_info={"accel_x": 1.0, "gyro_z": 2.0}).SerializeToString()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind((source, 0))
        opened.connect(_address(to))
        for _ in paced(None, int(rate) / _BURST):
            for _ in range(_BURST):
                opened.send(datagram)


def _at_command_rate(act: Callable[[], object]) -> None:
    """For ever. What a pause has cost is not made up for: a joystick has no past."""
    while True:
        act()
        time.sleep(1 / COMMAND_RATE)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.partition(":")
    return host, int(port)


KINDS: dict[str, Callable[..., None]] = {
    "udp": udp_commands,
    "ros": ros_commands,
    "flood": flood,
    "subscriber": subscriber,
}

if __name__ == "__main__":
    KINDS[sys.argv[1]](*sys.argv[2:])
