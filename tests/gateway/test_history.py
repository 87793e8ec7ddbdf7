"""The history keeps everything for a while, then the latest of each topic; a client that is behind gets from it."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from router.gateway.history import History
from router.gateway.subscriber import Subscriber
from router.gateway.transport.base import HIGH_WATER, Frame

MS = 1_000_000


def data(topic: str, text: bytes, type_name: str = "T") -> Frame:
    return Frame(text, topic, type_name, is_schema=False, born=0)


def schema(type_name: str, topic: str = "") -> Frame:
    return Frame(b"schema", topic, type_name, is_schema=True, born=0)


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


def behind(history: History) -> tuple[Client, Subscriber]:
    client = Client(HIGH_WATER)
    subscriber = Subscriber(client, 0, history, lambda frames: frames)
    assert not subscriber.keeps_up
    subscriber.fall_behind(0)
    return client, subscriber


def test_who_was_behind_for_a_moment_gets_everything_in_its_order() -> None:
    history = History()
    history.add([data("/a", b"before")])
    client, subscriber = behind(history)
    frames = [schema("T"), data("/a", b"1"), data("/a", b"2"), data("/b", b"3")]
    history.add(frames)
    assert (subscriber.waiting, subscriber.lag(5 * MS)) == (4, 5 * MS)
    client.level = 0
    assert subscriber.drained() == 0
    assert client.got == frames
    assert (subscriber.sent, subscriber.dropped, subscriber.waiting, subscriber.lag(9)) == (4, 0, 0, 0)
    assert subscriber.keeps_up


def test_who_was_behind_for_longer_gets_schemas_and_the_latest_of_each_topic() -> None:
    history = History(most_frames=2)
    client, subscriber = behind(history)
    history.add([schema("T"), *(data(topic, str(number).encode()) for number in range(9) for topic in ("/a", "/b"))])
    assert subscriber.waiting == 3
    assert subscriber.settle() == 16
    assert subscriber.settle() == 0
    client.level = 0
    assert subscriber.drained() == 0
    assert client.got == [schema("T"), data("/a", b"8"), data("/b", b"8")]
    assert (subscriber.sent, subscriber.dropped) == (3, 16)


def test_topics_have_their_turn_however_often_others_come() -> None:
    history = History(most_bytes=0)
    client, subscriber = behind(history)
    for number in range(4):
        history.add([data(topic, bytes([number]) * (HIGH_WATER - 1)) for topic in ("/a", "/b", "/c")])
        client.takes, client.level = 1, 0
        subscriber.drained()
    assert [frame.topic for frame in client.got] == ["/a", "/b", "/c", "/a"]
    assert [frame.data[0] for frame in client.got] == [0, 1, 2, 3]


def test_a_schema_comes_before_data_of_its_type_also_where_it_was_repeated_after_it() -> None:
    history = History(most_frames=0)
    client, subscriber = behind(history)
    history.add([schema("T"), data("/a", b"1"), schema("T")])
    client.level = 0
    subscriber.drained()
    assert client.got == [schema("T"), data("/a", b"1")]


def test_those_who_stand_still_are_counted_without_looking_at_each_frame() -> None:
    history = History(most_frames=1)
    crowd = [behind(history)[1] for _ in range(3)]
    history.add([data("/a", b"x")] * 10)
    crowd.append(behind(history)[1])
    history.add([data("/b", b"x")])
    assert [each.waiting for each in crowd] == [2, 2, 2, 1]
    assert [each.settle() for each in crowd] == [9, 9, 9, 0]


@given(
    st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 3), st.booleans()), max_size=40),
    st.integers(0, 5),
)
def test_in_the_end_everybody_has_the_latest_and_every_frame_is_accounted_for(
    steps: list[tuple[str, int, bool]], most_frames: int
) -> None:
    history = History(most_frames=most_frames)
    client, subscriber = behind(history)
    told, latest = 0, dict[str, bytes]()
    for number, (topic, takes, pauses) in enumerate(steps):
        frame = data(f"/{topic}", str(number).encode())
        latest[frame.topic] = frame.data
        history.add([frame])
        if not subscriber.is_behind:
            client.level = HIGH_WATER
            subscriber.fall_behind(0)
            history.add([frame])
        if pauses:
            told += subscriber.settle()
        if takes:
            client.takes, client.level = takes, 0
            told += subscriber.drained()
    client.takes, client.level = 1 << 40, 0
    told += subscriber.drained()
    assert told == subscriber.dropped
    assert {frame.topic: frame.data for frame in client.got} == latest
    numbers = {topic: [int(frame.data) for frame in client.got if frame.topic == topic] for topic in latest}
    assert all(each == sorted(each) for each in numbers.values())
