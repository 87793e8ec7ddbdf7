"""Topics are filled for those who listen, and only while they do."""

from __future__ import annotations

from collections import Counter

from tests.acceptance.conftest import Rover
from tests.acceptance.expected import expected_messages
from tests.acceptance.payloads import generated
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import FLOWS, topics_of
from tests.acceptance.site import balance, key, wait_until

SAMPLE = next(generated("imu_info"))
LISTENED_TO = "imu_data"
TYPE = topics_of("imu_info")[LISTENED_TO]


def send_one(rover: Rover) -> dict[str, tuple[int, int]]:
    """How often each topic of the route was (published, filtered) for one datagram, which is forwarded anyway."""
    before = rover.site.scrape()
    rover.site.send(FLOWS["imu_info"].source, SAMPLE.datagram)
    assert rover.site.receive("basestation") == SAMPLE.datagram
    counted = rover.site.settle(before, 1)
    return {topic: published_and_filtered(counted, topic) for topic in topics_of("imu_info")}


def published_and_filtered(counted: Counter[str], topic: str) -> tuple[int, int]:
    published = counted[key("messages_published", route="imu_info", topic=topic)]
    return published, counted[key("messages_filtered", route="imu_info", target=topic)]


def test_a_topic_is_filled_while_somebody_listens(rover: Rover) -> None:
    nobody = dict.fromkeys(topics_of("imu_info"), (0, 1))
    one_listens = {**nobody, LISTENED_TO: (1, 0)}
    assert send_one(rover) == nobody
    for _ in range(2):
        with RosPeer({LISTENED_TO: TYPE}) as peer:
            wait_until(lambda: send_one(rover) == one_listens, "the first published message")
            assert peer.receive() == (LISTENED_TO, expected_messages("imu_info", SAMPLE.payload)[LISTENED_TO])
            assert send_one(rover) == one_listens
            assert peer.receive()[0] == LISTENED_TO
            assert peer.nothing_left()
        wait_until(lambda: send_one(rover) == nobody, "the end of publishing")
    balance(rover.site.scrape())


def test_the_second_listener_may_leave_without_harm_to_the_first(rover: Rover) -> None:
    with RosPeer({LISTENED_TO: TYPE}) as first:
        with RosPeer({LISTENED_TO: TYPE}):
            wait_until(lambda: send_one(rover)[LISTENED_TO] == (1, 0), "the first published message")
        before = rover.site.scrape()
        for _ in range(10):
            assert send_one(rover)[LISTENED_TO] == (1, 0)
        assert rover.site.changes(before)[key("messages_published", route="imu_info", topic=LISTENED_TO)] == 10
        assert [first.receive()[0] for _ in range(10)] == [LISTENED_TO] * 10
