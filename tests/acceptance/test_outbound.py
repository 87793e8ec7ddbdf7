"""Every route from ROS through the running router: bytes at UDP receivers as the protobuf library would send them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import pytest

from tests.acceptance.conftest import Rover
from tests.acceptance.expected import Values, from_board_units, in_board_units, same_datagram
from tests.acceptance.payloads import arbitrary, generated
from tests.acceptance.ros_talker import RosTalker
from tests.acceptance.rover_map import ARRAY_ROUTE, ARRAYS, OUTFLOWS, TOPICS_FROM_ROS
from tests.acceptance.site import balance, key, total

AT_ONCE = 8
"""Messages that may be on their way: the router's queues hold ten, of which the newest remain."""

RANDOM = 200
LENGTHS = (0, 1, 2, 500, 0, 3)


@pytest.fixture(scope="module")
def talker(rover: Rover) -> Iterator[RosTalker]:
    """Publishes on all topics that the rover listens to."""
    with RosTalker(TOPICS_FROM_ROS) as matched:
        yield matched


def in_turns(messages: Sequence[Values]) -> Iterator[Sequence[Values]]:
    for start in range(0, len(messages), AT_ONCE):
        yield messages[start : start + AT_ONCE]


def said(case: str) -> list[Values]:
    """ROS messages of a payload case: ordinary and extreme values, NaN, infinities, enum numbers without a name."""
    return [in_board_units(made.payload) for made in (*generated(case), *islice(arbitrary(case), RANDOM))]


@pytest.mark.parametrize("case", OUTFLOWS)
def test_messages_become_datagrams_byte_for_byte_and_in_order(rover: Rover, talker: RosTalker, case: str) -> None:
    flow, place = OUTFLOWS[case], rover.site
    before, messages, size = place.scrape(), said(case), 0
    for turn in in_turns(messages):
        talker.publish(case, *turn)
        for message in turn:
            datagram = place.receive(flow.destination)
            assert same_datagram(datagram, from_board_units(case, message).datagram), message
            size += len(datagram)
    assert place.settle(before, 0, len(messages)) == {
        key("messages_received", route=flow.route, source=case): len(messages),
        key("datagrams_sent", route=flow.route, destination=flow.destination): len(messages),
        key("sent_bytes", route=flow.route, destination=flow.destination): size,
    }
    assert place.waiting() == {}


def elements(frame: int, length: int) -> list[Values]:
    """What they say of their frame is not to be believed."""
    return [in_board_units(made.payload) for made in islice(arbitrary("detected_object", seed=frame), length)]


def test_each_element_of_an_array_becomes_a_datagram(rover: Rover, talker: RosTalker) -> None:
    place = rover.site
    before = place.scrape()
    for number, length in enumerate(LENGTHS):
        frame, objects = 2**32 - 1 - number, elements(number, length)
        talker.publish(ARRAYS, {"frame_id": frame, "detections": objects})
        for index, element in enumerate(objects):
            expected = {**element, "frame_id": frame, "total_count": length, "index": index}
            assert same_datagram(place.receive("basestation"), from_board_units("detected_object", expected).datagram)
    counted = place.settle(before, 0, len(LENGTHS))
    assert counted[key("messages_received", route=ARRAY_ROUTE, source=ARRAYS)] == sum(LENGTHS)
    assert total(counted, "messages_received") == total(counted, "datagrams_sent") == sum(LENGTHS)
    assert place.waiting() == {}


def test_the_books_balance(rover: Rover, talker: RosTalker) -> None:
    """Last in this module."""
    counts = rover.site.scrape()
    balance(counts)
    assert total(counts, "messages_dropped") == total(counts, "messages_filtered") == 0
    assert all(total(counts, "messages_received", source=topic) for topic in TOPICS_FROM_ROS)
