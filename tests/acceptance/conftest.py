"""A rover: the real router with `tests/rover/routes/rover.yaml`, one per test module."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.acceptance import two_networks
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import FLOWS, TOPICS
from tests.acceptance.site import RouterProcess, Site, site, total, wait_until


@dataclass(frozen=True)
class Rover:
    """A site and its running router."""

    site: Site
    router: RouterProcess
    table: Path


@pytest.fixture(name="site")
def rover_on_two_networks(tmp_path: Path) -> Iterator[two_networks.Rover]:
    with two_networks.rover_with_networks(tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    """A rover whose topics have no subscriptions except those of tests."""
    folder = tmp_path_factory.mktemp("rover")
    with site(folder) as place:
        table = place.table()
        with RouterProcess(folder, table) as router:
            yield Rover(place, router, table)


@pytest.fixture(scope="module")
def peer(rover: Rover) -> Iterator[RosPeer]:
    """A peer that subscribes to all topics of the rover. It receives everything that is published from now on."""
    with RosPeer(TOPICS) as subscribed:
        yield subscribed


@pytest.fixture(scope="module")
def watched(rover: Rover, peer: RosPeer) -> Rover:
    """The rover, once it has discovered the peer's subscriptions. The probe messages have been received."""
    at_start, sent = rover.site.scrape(), 0

    def all_published() -> bool:
        nonlocal sent
        sent += len(FLOWS)
        for case, flow in FLOWS.items():
            rover.site.send(flow.source, next(generated(case)).datagram)
        now = rover.site.changes(at_start)
        return all(total(now, "messages_published", topic=topic) for topic in TOPICS)

    wait_until(all_published, "the last match")
    for _ in range(total(rover.site.settle(at_start, sent), "messages_published")):
        peer.receive()
    rover.site.waiting()
    return rover
