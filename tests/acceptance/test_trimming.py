"""`trim_trailing_zeros`: what those get whose decoders expect it, from UDP, from ROS and from a deadman."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from tests.acceptance.expected import from_board_units, in_board_units
from tests.acceptance.payloads import WIRE, generated, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import FLOWS, OUTFLOWS, TOPICS_FROM_ROS
from tests.acceptance.site import RouterProcess, Site, site

TRIMMED = """\
version: 1
extends: table.yaml
endpoints:
  driving_board: {trim_trailing_zeros: true}
  arm_board: {trim_trailing_zeros: true}
  basestation: {trim_trailing_zeros: true}
"""
Running = tuple[Site, RouterProcess]


@pytest.fixture(scope="module")
def trimming(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """All endpoints that anything is sent to have their zeros trimmed."""
    folder = tmp_path_factory.mktemp("trimming")
    table = folder / "trimmed.yaml"
    with site(folder) as place:
        place.table()
        table.write_text(TRIMMED)
        with RouterProcess(folder, table) as router:
            yield place, router


def test_what_is_forwarded_and_what_comes_from_ros_is_trimmed(trimming: Running) -> None:
    place, _ = trimming
    trimmed = 0
    for case, flow in FLOWS.items():
        for sent in generated(case):
            place.send(flow.source, sent.datagram)
            for destination in flow.destinations:
                assert place.receive(destination) == sent.datagram.rstrip(b"\0")
    with RosPeer() as talker:
        talker.open_heard(TOPICS_FROM_ROS)
        for case, outflow in OUTFLOWS.items():
            for said in generated(case):
                message = in_board_units(said.payload)
                whole = from_board_units(case, message).datagram
                talker.say(case, message)
                arrived = place.receive(outflow.destination)
                assert arrived == whole.rstrip(b"\0")
                trimmed += arrived != whole
    assert trimmed
    assert place.waiting() == {}


def test_what_a_deadman_sends_is_trimmed(trimming: Running) -> None:
    """Last in this module."""
    place, router = trimming
    place.send("basestation", next(generated("manual_arm")).datagram)
    place.receive("arm_board")
    assert router.stop(signal.SIGTERM) == 0
    halt = sample("manual_arm", WIRE.envelope.cases["manual_arm"].message_class()).datagram
    assert place.waiting()["arm_board"] == [halt.rstrip(b"\0")] != [halt]
