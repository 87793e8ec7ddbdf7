"""What the gateway's benchmark makes of datagrams and arrivals."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from benchmarks.gateway.measuring import metrics
from benchmarks.gateway.receiver import Arrival, Receiver
from benchmarks.gateway.topics import KINDS, Kind, Topic, many
from router.gateway.packets import Packet, compress, pack
from tests.ports import free_port

FLOAT = KINDS[2]
TEXT = b'{"data":[12.5]}'
SCHEMA = b'{"fields":[],"name":"Float64","namespace":"std_msgs::msg"}'
PATIENCE = 20


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with Receiver(free_port()) as made:
        yield made


def arrivals(receiver: Receiver, *sent: bytes) -> list[Arrival]:
    """What the receiver makes of these datagrams."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in sent:
            sender.sendto(datagram, ("127.0.0.1", receiver.port))
    deadline = time.monotonic() + PATIENCE
    while receiver.bytes() < sum(map(len, sent)) and time.monotonic() < deadline:
        time.sleep(0.01)
    return [*receiver.arrivals({"/a": FLOAT})]


def packet(payload: bytes, is_compressed: bool = False) -> bytes:
    return pack(Packet(13.0, is_compressed, "/a", FLOAT.type_name, payload))


def test_plain_and_compressed_packets_are_data_and_schemas_are_not(receiver: Receiver) -> None:
    short = packet(compress(TEXT, 3), is_compressed=True)
    found = arrivals(receiver, packet(SCHEMA), packet(TEXT), short)
    assert [(one.topic, one.published, one.sent) for one in found] == [("/a", 12.5, 13.0)] * 2
    assert all(abs(one.received - time.time()) < PATIENCE for one in found)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.type_name)
def test_every_type_has_one_place_for_the_time(kind: Kind) -> None:
    name, type_name, qos, hertz, stamp, offset, cdr = Topic("/a", kind, "reliable", 50).line().split()
    assert (name, type_name, qos, hertz, stamp) == ("/a", kind.type_name, "reliable", "50", kind.stamp)
    assert 4 <= int(offset) < len(bytes.fromhex(cdr))


def test_values_that_come_again_are_counted_and_have_no_age() -> None:
    topics = many(3, 50, ["reliable"])
    first, second, _ = (topic.name for topic in topics)
    came = [
        Arrival(first, 1.0, 1.01, 1.02), Arrival(first, 1.0, 1.51, 1.52), Arrival(first, 2.0, 2.01, 2.02),
        Arrival(first, 2.0, 2.51, 2.52), Arrival(second, 2.0, 2.01, 2.02),
    ]  # fmt: skip
    found = metrics(topics, came, seconds=2)
    assert (found["topics"], found["served"], found["at_rate"]) == (3, 2, 1)
    assert found["packets_per_s"] == 2.5
    assert found["repeated"] == pytest.approx(0.4)
    assert found["arrival_ms_max"] == pytest.approx(20)
    assert found["age_ms_max"] == pytest.approx(10)
