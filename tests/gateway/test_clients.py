"""A client that is behind gets the newest frame of each topic."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from router.gateway.clients import ClientQueue
from router.gateway.latched import MOST_LATCHED_BYTES
from router.gateway.transport.base import HIGH_WATER, Frame

MS = 1_000_000


def data(topic: str, text: bytes, type_name: str = "T") -> Frame:
    return Frame(text, topic, type_name, is_schema=False)


def schema(type_name: str, topic: str = "") -> Frame:
    return Frame(b"schema", topic, type_name, is_schema=True)


class Client:
    """Takes what it is given, and says that so much of it is on its way."""

    label = "10.0.0.5:1234"

    def __init__(self, backlog: int = 0) -> None:
        self.level = backlog
        self.got: list[Frame] = []
        self.takes = 1 << 40

    def write(self, frames: Sequence[Frame]) -> None:
        self.got += frames
        self.takes -= sum(len(frame.data) for frame in frames)
        if self.takes <= 0:
            self.level = HIGH_WATER

    def backlog(self) -> int:
        return self.level

    def close(self) -> None:
        raise AssertionError("nobody closes it here")


def new_queue(client: Client) -> ClientQueue:
    return ClientQueue(client, 0, lambda frames: frames)


def put(one: ClientQueue, *frames: Frame, now: int = 0) -> int:
    return one.put(
        {(each.topic, each.type_name): each for each in frames if each.is_schema},
        {each.topic: each for each in frames if not each.is_schema},
        len(frames),
        now,
    )


def test_who_keeps_up_gets_frames_at_once() -> None:
    client = Client(HIGH_WATER - 1)
    one = new_queue(client)
    assert one.keeps_up
    one.write([data("/a", b"1"), data("/a", b"2")])
    assert [frame.data for frame in client.got] == [b"1", b"2"]
    assert (one.sent, one.dropped, one.waiting, one.lag(5 * MS)) == (2, 0, 0, 0)
    client.level = HIGH_WATER
    assert not one.keeps_up


def test_who_was_behind_gets_schemas_and_the_newest_of_each_topic() -> None:
    client = Client(HIGH_WATER)
    one = new_queue(client)
    assert put(one, schema("T"), data("/a", b"0"), data("/b", b"0"), now=2 * MS) == 0
    assert put(one, *(data(topic, str(number).encode()) for number in range(9) for topic in ("/a", "/b"))) == 18
    assert put(one, schema("U")) == 0
    assert (one.waiting, one.lag(7 * MS)) == (4, 5 * MS)
    client.level = 0
    assert not one.keeps_up  # what waits goes first
    one.drained()
    assert client.got == [schema("T"), schema("U"), data("/a", b"8"), data("/b", b"8")]
    assert (one.sent, one.dropped, one.waiting, one.lag(9)) == (4, 18, 0, 0)
    assert one.keeps_up


def test_topics_have_their_turn_however_often_others_come() -> None:
    client = Client(HIGH_WATER)
    one = new_queue(client)
    for number in range(4):
        put(one, *(data(topic, bytes([number]) * (HIGH_WATER - 1)) for topic in ("/a", "/b", "/c")))
        client.takes, client.level = 1, 0
        one.drained()
    assert [frame.topic for frame in client.got] == ["/a", "/b", "/c", "/a"]
    assert [frame.data[0] for frame in client.got] == [0, 1, 2, 3]


def test_a_schema_comes_before_data_of_its_type_also_where_it_was_repeated_after_it() -> None:
    client = Client(HIGH_WATER)
    one = new_queue(client)
    for frame in (schema("T"), data("/a", b"1"), schema("T")):
        put(one, frame)
    client.level = 0
    one.drained()
    assert client.got == [schema("T"), data("/a", b"1")]


def test_a_frame_that_is_larger_than_the_buffer_is_written_alone() -> None:
    client = Client(HIGH_WATER)
    one = new_queue(client)
    put(one, data("/a", bytes(HIGH_WATER * 2)), data("/b", b"1"))
    client.takes, client.level = 1, 0
    one.drained()
    assert [frame.topic for frame in client.got] == ["/a"]


def test_values_wait_for_the_kept_messages_of_their_topic() -> None:
    one = new_queue(Client())
    assert one.hold("/map")
    assert not one.hold("/map")
    frames = [schema("T"), data("/map", b"1"), data("/imu", b"2"), data("/map", b"3")]
    assert one.hold_back(frames) == [frames[0], frames[2]]
    one.record_miss("/map")
    one.record_miss("/imu")
    assert (one.held, one.missed_topics) == (2, {"/imu"})
    assert one.release("/map") == [frames[1], frames[3]]
    assert (one.held, one.holds, one.missed_topics) == (0, False, {"/imu", "/map"})


def test_a_client_that_has_all_kept_messages_lacks_none() -> None:
    one = new_queue(Client())
    one.hold("/map")
    one.record_miss("/map")
    assert one.release("/map", is_complete=True) == []
    assert one.missed_topics == set()


def test_values_that_wait_are_bounded() -> None:
    one = new_queue(Client())
    one.hold("/map")
    one.hold("/imu")
    large = data("/map", bytes(MOST_LATCHED_BYTES // 2))
    small = data("/imu", b"1")
    assert one.hold_back([large, small]) == []
    assert one.hold_back([large]) == [large, large, small]
    assert not one.holds
    assert one.hold_back([small]) == [small]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 3)), max_size=40))
def test_in_the_end_everybody_has_the_latest_and_every_frame_is_accounted_for(steps: list[tuple[str, int]]) -> None:
    client = Client(HIGH_WATER)
    one = new_queue(client)
    superseded, latest = 0, dict[str, bytes]()
    for number, (topic, takes) in enumerate(steps):
        frame = data(f"/{topic}", str(number).encode())
        latest[frame.topic] = frame.data
        superseded += put(one, frame)
        if takes:
            client.takes, client.level = takes, 0
            one.drained()
    client.takes, client.level = 1 << 40, 0
    one.drained()
    assert superseded == one.dropped
    assert one.sent + one.dropped == len(steps)
    assert {frame.topic: frame.data for frame in client.got} == latest
    numbers = {topic: [int(frame.data) for frame in client.got if frame.topic == topic] for topic in latest}
    assert all(each == sorted(each) for each in numbers.values())
