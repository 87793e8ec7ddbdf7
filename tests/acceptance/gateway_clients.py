"""Clients of gateways, and a router with gateways and a ROS process that publishes."""

from __future__ import annotations

import json
import socket
import struct
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backports import zstd
from websockets.sync.client import connect

from tests.acceptance.ros_peer import PATIENCE, RosPeer
from tests.acceptance.site import ROVER, RouterProcess, Site, key, site, wait_until
from tests.ports import free_port

HEAD = ROVER + "gateways:\n"


def packet(data: bytes) -> tuple[float, int, str, str, bytes]:
    """Parse a packet as the existing clients do."""
    stamp, kind = struct.unpack_from("<dB", data)
    topic, type_name, payload = data[9:].split(b"\0", 2)
    return stamp, kind, topic.decode(), type_name.decode(), payload


def head(topic: str, type_name: str, kind: int = 0, stamp: float | None = None) -> bytes:
    """The beginning of a packet for the router."""
    names = f"{topic}\0{type_name}\0".encode()
    return struct.pack("<dB", time.time() if stamp is None else stamp, kind) + names


def twist(x: float) -> dict[str, Any]:
    return {"linear": {"x": x, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}


class Headset:
    """A client with the expectations of the existing VR client: it drops data that arrives before its type's schema."""

    def __init__(self, opened: socket.socket) -> None:
        self._opened = opened
        self.schemas: dict[str, Any] = {}
        self.early: list[str] = []

    def next(self) -> tuple[str, Any]:
        """Topic and data, or topic and None for a schema."""
        data = self._opened.recv(65535)
        assert len(data) >= 13
        stamp, kind, topic, type_name, payload = packet(data)
        assert abs(stamp - time.time()) < PATIENCE
        text = zstd.decompress(payload) if kind else payload
        value = json.loads(text)
        if {"name", "namespace", "fields"} <= value.keys():
            assert not kind
            self.schemas[type_name] = value
            return topic, None
        if type_name not in self.schemas:
            self.early.append(topic)
        return topic, value

    def wait_for(self, topic: str, meanwhile: Callable[[], None] = lambda: None, value: Any = None) -> Any:
        """Wait for the next value of a topic, or for this value, and call `meanwhile` repeatedly."""
        deadline = time.monotonic() + PATIENCE
        self._opened.settimeout(0.1)
        while time.monotonic() < deadline:
            meanwhile()
            with suppress(TimeoutError):
                came, data = self.next()
                if came == topic and data is not None and value in (None, data):
                    return data
        raise AssertionError("it never came")

    def catch_up(self) -> None:
        """Take what has arrived and was not read."""
        self._opened.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                self.next()

    def wait_for_silence(self, topic: str, seconds: float) -> None:
        """Wait until no value of `topic` has arrived for this time."""
        deadline = time.monotonic() + PATIENCE
        quiet_since = time.monotonic()
        self._opened.settimeout(seconds)
        while time.monotonic() - quiet_since < seconds:
            assert time.monotonic() < deadline, "it never fell silent"
            with suppress(TimeoutError):
                if self.next()[0] == topic:
                    quiet_since = time.monotonic()


class Dashboard:
    """A client of a websocket gateway."""

    def __init__(self, port: int) -> None:
        self._connecting = connect(f"ws://127.0.0.5:{port}/", open_timeout=PATIENCE, close_timeout=1, max_size=None)
        self._documents = self.documents()

    def __enter__(self) -> Dashboard:
        self._connection = self._connecting.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._connecting.__exit__(None, None, None)

    def documents(self) -> Generator[dict[str, Any], None, None]:
        while True:
            text = self._connection.recv(timeout=PATIENCE)
            assert isinstance(text, str)
            yield from map(json.loads, text.split("\n"))

    def next(self, op: str, **others: object) -> dict[str, Any]:
        """Wait for the next document of this kind with these members."""
        wanted = {"op": op, **others}.items()
        return next(document for document in self._documents if all(document.get(k) == v for k, v in wanted))

    def ask(self, **document: object) -> None:
        self._connection.send(json.dumps(document))


def lines(opened: socket.socket) -> Generator[dict[str, Any], None, None]:
    """The lines that a gateway with the format `json_lines` sends."""
    with opened.makefile("r", encoding="utf-8") as text:
        yield from map(json.loads, text)


@dataclass
class Scene:
    """A router with gateways, and a ROS process. `ports` are the ports in the table, by placeholder."""

    site: Site
    router: RouterProcess
    peer: RosPeer
    ports: Mapping[str, int]

    def connect(self, word: str) -> socket.socket:
        return socket.create_connection(("127.0.0.5", self.ports[word]), PATIENCE)

    def count(self, metric: str, **labels: str) -> int:
        return self.site.scrape()[key(metric, **labels)]

    def await_clients(self, gateway: str, number: int) -> None:
        series = key("gateway_clients", route=gateway)
        wait_until(lambda: self.site.samples()[series] == number, f"{number} clients")

    def keep(self, topic: str, type_name: str, **fields: Any) -> None:
        """A topic with one message, which late subscribers also receive."""
        self.peer.open(topic, type_name, keeps=True)
        self.peer.say(topic, fields)

    def await_subscription(self, *topics: str) -> None:
        wait_until(lambda: all(map(self.peer.heard_by, topics)), "the subscription")


@contextmanager
def scene(
    folder: Path, gateways: str, tcp: str = "PORT", udp: str = "RECEIVE", heard: Mapping[str, str] | None = None
) -> Iterator[Scene]:
    """Replace the words `tcp` and `udp` in `gateways` by free ports. The ROS process subscribes to `heard`."""
    ports = {word: free_port("127.0.0.5", kind=socket.SOCK_STREAM) for word in tcp.split()}
    ports |= {word: free_port("127.0.0.5") for word in udp.split()}
    for word, port in ports.items():
        gateways = gateways.replace(f":{word}", f":{port}")
    with site(folder) as place:
        table = place.table(HEAD + gateways.replace("{", "{{").replace("}", "}}"))
        with RouterProcess(folder, table) as router, RosPeer(heard) as peer:
            yield Scene(place, router, peer, ports)
