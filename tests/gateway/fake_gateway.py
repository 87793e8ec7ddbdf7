"""The WebSocket side of a gateway without ROS: serves the page, sends a test's messages, and records requests."""

from __future__ import annotations

import contextlib
import http
import json
import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

import router.gateway
from router.gateway.transport.websocket import Page

PAGE = Path(router.gateway.__file__).with_name("page.html")


class FakeGateway:
    """Lists its topics every half second, so that the page considers it alive."""

    def __init__(self) -> None:
        self.clients: set[ServerConnection] = set()
        self._page = Page(PAGE.read_bytes())
        self.reset()
        self._server: Server = serve(self._serve, "127.0.0.1", 0, process_request=self._answer, compression=None)
        self.port = int(self._server.socket.getsockname()[1])
        self._closed = threading.Event()
        self._threads = [threading.Thread(target=work) for work in (self._server.serve_forever, self._list)]
        for thread in self._threads:
            thread.start()

    def reset(self) -> None:
        """Reset everything except the port."""
        self.received: queue.Queue[dict[str, Any]] = queue.Queue()
        self.rows: list[dict[str, Any]] = []
        self.inbound: list[dict[str, Any]] = [TWIST, MIXED]
        self.clock_error = 0.0
        self.is_down = False

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer as the real gateway does, with the page's Content-Security-Policy."""
        if self.is_down and request.headers.get("Upgrade"):
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "")
        return self._page.answer(cast("Any", connection), request)

    def _serve(self, connection: ServerConnection) -> None:
        connection.send(json.dumps({"op": "inbound", "topics": self.inbound}))
        connection.send(self._listing())
        self.clients.add(connection)
        try:
            for text in connection:
                for line in str(text).split("\n"):
                    self.received.put(json.loads(line))
        finally:
            self.clients.discard(connection)

    def _list(self) -> None:
        while not self._closed.wait(0.5):
            self.say(self._listing())

    def _listing(self) -> str:
        return json.dumps({"op": "topics", "time": time.time() + self.clock_error, "topics": self.rows})

    def say(self, *documents: str | dict[str, Any]) -> None:
        """Send this to all clients in one message."""
        texts = [text if isinstance(text, str) else json.dumps(text, separators=(",", ":")) for text in documents]
        for client in list(self.clients):
            with contextlib.suppress(ConnectionClosed):
                client.send("\n".join(texts))

    def data(self, topic: str, data: object, type_name: str = "sensor_msgs/msg/Imu") -> None:
        self.say(data_document(topic, data, type_name))

    def list_topics(self, names: Sequence[str], type_name: str = "sensor_msgs/msg/Imu", rate: float = 50.0) -> None:
        self.rows = [{"topic": name, "type": type_name, "rate": rate} for name in names]
        self.say(self._listing())

    def go_down(self) -> None:
        """Close all connections and accept no new ones."""
        self.is_down = True
        for client in list(self.clients):
            client.close()

    def close(self) -> None:
        self._closed.set()
        self._server.shutdown()
        for thread in self._threads:
            thread.join()


def data_document(topic: str, data: object, type_name: str = "sensor_msgs/msg/Imu") -> dict[str, Any]:
    return {"op": "data", "topic": topic, "type": type_name, "time": time.time(), "data": data}


def field(name: str, kind: str | dict[str, Any], is_array: bool = False) -> dict[str, Any]:
    """One field of a schema. If `kind` is a schema, the field is a nested message."""
    nested = isinstance(kind, dict)
    return {
        "name": name,
        "is_array": is_array,
        "type": "message" if nested else kind,
        "subtype": kind if nested else "primitive",
    }


def schema(name: str, *fields: dict[str, Any], package: str = "geometry_msgs") -> dict[str, Any]:
    return {"name": name, "namespace": f"{package}::msg", "fields": list(fields)}


VECTOR = schema("Vector3", *(field(axis, "float64") for axis in "xyz"))
TWIST = {
    "topic": "/cmd_vel",
    "type": "geometry_msgs/msg/Twist",
    "schema": schema("Twist", field("linear", VECTOR), field("angular", VECTOR)),
    "example": {part: {"x": 0.0, "y": 0.0, "z": 0.0} for part in ("linear", "angular")},
}
MIXED = {
    "topic": "/mode",
    "type": "rover_msgs/msg/Mode",
    "schema": schema(
        "Mode",
        field("is_armed", "bool"),
        field("name", "string"),
        field("level", "uint8"),
        field("id", "uint64"),
        field("gains", "float32", is_array=True),
        package="rover_msgs",
    ),
    "example": {"is_armed": False, "name": "", "level": 0, "id": 0, "gains": [0.0, 0.0]},
}
