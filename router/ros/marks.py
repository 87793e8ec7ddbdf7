"""Marks by which routers notice each other: hidden topics on which nothing is ever published.

The name of a node does not tell a router from another node, and a subscription does not tell a router from a recorder.
So a router opens a publisher under the name of its node, and one under each topic that it takes messages from:
`/drive_motor/_router/HOST/pPROCESS_PLACE`. Discovery carries the name to every process of the domain.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

from rcl_interfaces.msg import ParameterEvent  # type: ignore[import-untyped]
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

from router.log import logger
from router.ros.node import RCL_ERRORS

_MARK = re.compile(r"(?P<name>/.+)/_router/_(?P<host>\w+)/p(?P<process>\d+)_(?P<place>[0-9a-f]{8})", re.ASCII)
_LONGEST_HOST = 32


class Router(NamedTuple):
    """A router's process. Process numbers are unique in a `place`: a booted computer, or a container on it."""

    host: str
    process: int
    place: str

    @property
    def has_ended(self) -> bool:
        """Whether it is known to have ended: DDS keeps the topics of a killed process for up to 20 s."""
        if self.place != this_router().place:
            return False
        try:
            os.kill(self.process, 0)
        except ProcessLookupError:
            return True
        except PermissionError:  # another user's
            pass
        return False


@cache
def this_router() -> Router:
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
    place = sha256(f"{boot} {Path('/proc/self/ns/pid').readlink()}".encode()).hexdigest()[:8]
    host = re.sub(r"\W", "_", os.uname().nodename, flags=re.ASCII)[:_LONGEST_HOST]
    return Router(host, os.getpid(), place)


class Mark:
    """A mark under an absolute `name`. Nothing else depends on it, so a failure is logged."""

    def __init__(self, node: Node, name: str) -> None:
        router = this_router()
        topic = f"{name}/_router/_{router.host}/p{router.process}_{router.place}"
        self._publisher = None
        try:
            with node.handle:
                self._publisher = rclpy_implementation.Publisher(  # without rclpy's event handlers
                    node.handle, ParameterEvent, topic, QoSProfile(depth=1).get_c_qos_profile()
                )
        except RCL_ERRORS as error:
            logger.warning("another router will not notice this one", name=name, problem=str(error))

    def close(self) -> None:
        if self._publisher is not None:
            self._publisher.destroy_when_not_in_use()


def marks(topics: Iterable[str]) -> Iterator[tuple[str, Router]]:
    """Yield the marked names among discovered topics, each with the router that has marked it."""
    for topic in topics:
        if mark := _MARK.fullmatch(topic):
            yield mark["name"], Router(mark["host"], int(mark["process"]), mark["place"])
