"""The programs around the routers: boards of all rovers, and an operator. Each records what it sends and receives.

Orders come over a pipe, each is answered. Times are ns of the monotonic clock, which all processes share.
"""

from __future__ import annotations

import json
import selectors
import socket
import struct
import threading
import time
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import zenoh

IMU = struct.Struct("<BB Bf Bf Bf Bf")
DRIVE = struct.Struct("<Bd")
TAG_DRIVE, TAG_BRAKE = 0x12, 0x1A
"""First bytes of envelopes with these payload cases."""

Record = tuple[int, int, int]
"""Rover, sequence number, time."""


class Address(NamedTuple):
    """IP addresses of a rover's router and boards."""

    rover: int
    router: str
    sensor_board: str
    driving_board: str


class Told(NamedTuple):
    """What an actor sent and received. `brakes` have the number 0."""

    sent: list[Record]
    received: list[Record]
    brakes: list[Record]


class Recorder:
    def __init__(self) -> None:
        self.told = Told([], [], [])

    def take(self) -> Told:
        taken, self.told = self.told, Told([], [], [])
        return taken


def imu(number: int) -> bytes:
    """An envelope whose payload case `imu` has this number in its first field."""
    return IMU.pack(0x0A, 20, 0x0D, number, 0x15, 1.5, 0x1D, 2.5, 0x25, 3.5)


class Boards(Recorder):
    """The boards of all rovers in one thread; the rovers' messages are spread over the period."""

    def __init__(self, addresses: list[Address], rate: float) -> None:
        super().__init__()
        self._period = round(1e9 / rate)
        self._routers = {address.rover: (address.router, 5000) for address in addresses}
        self._sensors = {address.rover: udp(address.sensor_board) for address in addresses}
        self._numbers = dict.fromkeys(self._sensors, 0)
        self._due: dict[int, int] = {}
        self._selector = selectors.DefaultSelector()
        for address in addresses:
            self._selector.register(udp(address.driving_board), selectors.EVENT_READ, address.rover)

    def run(self, pipe: Connection) -> None:
        self._selector.register(pipe, selectors.EVENT_READ, 0)
        pipe.send(None)
        while True:
            now = time.monotonic_ns()
            for rover in [rover for rover, due in self._due.items() if due <= now]:
                self._send(rover)
            wait = min(self._due.values(), default=now + 100_000_000) - time.monotonic_ns()
            for key, _ in self._selector.select(max(0, wait) / 1e9):
                if key.data:
                    self._receive(key.fileobj, key.data)
                elif not self._obey(pipe):
                    return

    def _obey(self, pipe: Connection) -> bool:
        try:
            order, values = pipe.recv()
        except EOFError:
            return False
        if order == "send":
            now, [rovers] = time.monotonic_ns(), values
            self._due = {rover: now + self._period * place // len(rovers) for place, rover in enumerate(rovers)}
        pipe.send(self.take() if order == "take" else None)
        return True

    def _send(self, rover: int) -> None:
        self._due[rover] += self._period
        self._numbers[rover] = number = self._numbers[rover] + 1
        self.told.sent.append((rover, number, time.monotonic_ns()))
        self._sensors[rover].sendto(imu(number), self._routers[rover])

    def _receive(self, opened: Any, rover: int) -> None:
        data, now = opened.recv(2048), time.monotonic_ns()
        if data[0] == TAG_BRAKE:
            self.told.brakes.append((rover, 0, now))
        elif data[0] == TAG_DRIVE:
            _, number = DRIVE.unpack_from(data.ljust(11, b"\0"), 2)
            self.told.received.append((rover, int(number), now))


def udp(host: str) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((host, 8))
    return opened


class Operator(Recorder):
    """Receives the topics of its rovers. Sends commands to those that it is told to drive."""

    def __init__(self, config: str, rovers: list[int], rate: float) -> None:
        super().__init__()
        self._period = round(1e9 / rate)
        self._numbers = dict.fromkeys(rovers, 0)
        self._driven: list[int] = []
        self._session = zenoh.open(zenoh.Config.from_json5(config))
        for rover in rovers:
            self._session.declare_subscriber(f"rovers/rover_{rover}/data/**", self._hears(rover))

    def _hears(self, rover: int) -> Any:
        def on_sample(sample: zenoh.Sample) -> None:
            now = time.monotonic_ns()
            data = json.loads(sample.payload.to_bytes())["data"]
            self.told.received.append((rover, int(data["linear_acceleration"]["x"]), now))

        return on_sample

    def run(self, pipe: Connection) -> None:
        threading.Thread(target=self._drive, daemon=True).start()
        pipe.send(None)
        while True:
            try:
                order, values = pipe.recv()
            except EOFError:
                return
            if order == "send":
                [self._driven] = values
            pipe.send(self.take() if order == "take" else None)

    def _drive(self) -> None:
        due = time.monotonic_ns()
        while True:
            for rover in self._driven:
                self._put(rover)
            due = max(due + self._period, time.monotonic_ns() - self._period)
            time.sleep(max(0, due - time.monotonic_ns()) / 1e9)

    def _put(self, rover: int) -> None:
        self._numbers[rover] = number = self._numbers[rover] + 1
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        data = {"linear": {**zero, "x": float(number)}, "angular": zero}
        request = {"op": "publish", "topic": "/drive", "time": time.time(), "data": data}
        self.told.sent.append((rover, number, time.monotonic_ns()))
        self._session.put(f"rovers/rover_{rover}/inbound/drive", json.dumps(request))


def play_boards(pipe: Connection, addresses: list[Address], rate: float) -> None:
    """The main function of a process."""
    Boards(addresses, rate).run(pipe)


def play_operator(pipe: Connection, config: str, rovers: list[int], rate: float) -> None:
    """The main function of a process."""
    Operator(config, rovers, rate).run(pipe)
