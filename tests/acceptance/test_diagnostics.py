"""/diagnostics of a router in a process of its own, as a ROS node reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from time import monotonic
from typing import Any

from router.ros.topics import TopicListener
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import PATIENCE
from tests.acceptance.rover_map import FLOWS
from tests.acceptance.site import ROVER, RouterProcess, Site, site

TABLE = (
    ROVER
    + """
node:
  diagnostics: true
"""
)
OK, WARN, _, STALE = (bytes([level]) for level in range(4))
TYPE = "diagnostic_msgs/msg/DiagnosticArray"


Reported = Mapping[str, Any]
"""The newest status of everything, by name without the node's."""


class Monitor:
    """Listens to /diagnostics, and to nothing else."""

    def __init__(self, listener: TopicListener) -> None:
        self._listener = listener
        self.stamps: list[float] = []

    def until(self, condition: Callable[[Reported], bool], meanwhile: Callable[[], None] = lambda: None) -> Reported:
        """What was reported when it became true."""
        deadline = monotonic() + PATIENCE
        reported: Reported = {}
        while monotonic() < deadline:
            meanwhile()
            for cdr, _ in self._listener.take(0.1):
                message = self._listener.message(cdr)
                self.stamps.append(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)
                reported = {status.name.removeprefix("rover_router: "): status for status in message.status}
                if condition(reported):
                    return reported
        raise AssertionError(str(reported))


@contextmanager
def monitored(folder: Path) -> Iterator[tuple[Site, Monitor]]:
    """The rover with boards that are stale after a second."""
    with site(folder) as place:
        table = place.table(TABLE)
        table.write_text(table.read_text().replace("kind: board}", "kind: board, stale_after: 1s}"))
        with RouterProcess(folder, table), closing(TopicListener("/diagnostics", TYPE)) as listener:
            yield place, Monitor(listener)


def levels(*expected: bytes) -> Callable[[Reported], bool]:
    """Of the sensor board, and of a route from it."""
    return lambda reported: (reported["endpoint/sensor_board"].level, reported["route/imu_info"].level) == expected


def test_a_monitor_sees_boards_come_and_go_and_what_is_refused(tmp_path: Path) -> None:
    with monitored(tmp_path) as (place, monitor):

        def send() -> None:
            place.send(FLOWS["imu_info"].source, next(generated("imu_info")).datagram)

        reported = monitor.until(levels(OK, OK), send)
        assert reported["router"].level == OK
        reported = monitor.until(levels(STALE, STALE))
        assert "sensor_board is silent: last heard" in reported["route/imu_info"].message
        monitor.until(levels(OK, OK), send)

        place.send("sensor_board", b"\xff" * 30)
        reported = monitor.until(lambda reported: reported["listener/rover"].level == WARN)
        assert "rover rejects datagrams: malformed, 1 in" in reported["listener/rover"].message

        place.endpoints["basestation"].close()
        reported = monitor.until(levels(OK, WARN), send)
        assert "messages for basestation are dropped: send_error" in reported["route/imu_info"].message
        assert "messages for basestation are dropped: send_error" in reported["endpoint/basestation"].message
        assert all(later > earlier for earlier, later in pairwise(monitor.stamps))
