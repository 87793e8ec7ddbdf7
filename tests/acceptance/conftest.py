"""A rover: the real router on `routes/rover.yaml`, with and without a ROS peer, one for each module that asks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import TOPICS
from tests.acceptance.site import RouterProcess, Site, site


@dataclass(frozen=True)
class Rover:
    """A site and the router that runs in it."""

    site: Site
    router: RouterProcess
    table: Path


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    """Nobody subscribes to its topics unless a test does."""
    folder = tmp_path_factory.mktemp("rover")
    with site(folder) as place:
        table = place.table()
        with RouterProcess(folder, table) as router:
            yield Rover(place, router, table)


@pytest.fixture(scope="module")
def peer(rover: Rover) -> Iterator[RosPeer]:
    """Subscribes to all topics of the rover. What has not been sent yet will reach it."""
    with RosPeer(TOPICS) as subscribed:
        yield subscribed
