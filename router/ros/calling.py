"""Calls a service once, with a node of its own."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from time import monotonic, sleep
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message

from router.errors import StartError, TransportError, listed
from router.ros.graph import servers
from router.ros.node import RCL_ERRORS, close_node, open_node
from router.ros.type_support import Definition
from router.ros.types import usable_service

_LOOK_S = 0.05
"""The time between two looks at the graph, and for which a signal may wait."""


class ServiceCaller:
    """A client of a service with a node of its own. The caller must close it."""

    def __init__(self, name: str, type_name: str, definitions: Mapping[str, Definition]) -> None:
        """Open the client. Raises StartError if the type is not installed as in `definitions`, or ROS refuses it."""
        self._type_name = type_name
        with ExitStack() as opening:
            self._type = usable_service(type_name, definitions)
            self._node = open_node("router_call")
            opening.callback(close_node, self._node)
            try:
                self._client = self._node.create_client(self._type, name)
                self._executor = SingleThreadedExecutor(context=self._node.context)
                opening.callback(self._executor.shutdown)
                self._executor.add_node(self._node)
            except RCL_ERRORS as error:
                raise StartError(f"service '{name}' cannot be called: {error}") from error
            self.name = self._client.service_name
            self._open = opening.pop_all()

    def wait(self, patience: float) -> None:
        """Wait up to `patience` seconds for a server. Raises TransportError if there is none of this type."""
        until = monotonic() + patience
        while True:
            types = {server.type_name for server in servers(self._node, self.name)}
            if (self._type_name in types or not types) and self._client.service_is_ready():
                return  # without types if the middleware is not DDS
            if monotonic() >= until:
                break
            sleep(_LOOK_S)
        if others := sorted(types - {self._type_name}):
            raise TransportError(f"the server of {self.name} has the type {listed(others)}, not {self._type_name}")
        hint = f"`ros2 service list` lists the services of this ROS domain; is the server of {self.name} running?"
        raise TransportError(f"no server of {self.name} within {patience:g} s", hint)

    def call(self, request: bytes, patience: float) -> tuple[Any, float]:
        """Send a request, CDR bytes. Return the response, rclpy's object, and how long it took, in seconds.

        Raises TransportError if there is no response within `patience` seconds.
        """
        message = deserialize_message(request, self._type.Request)
        begun = monotonic()
        future = self._client.call_async(message)
        while not future.done():
            left = begun + patience - monotonic()
            if left <= 0:
                raise TransportError(f"{self.name} did not respond within {patience:g} s")
            self._executor.spin_until_future_complete(future, min(left, _LOOK_S))
        return future.result(), monotonic() - begun

    def close(self) -> None:
        self._open.close()
