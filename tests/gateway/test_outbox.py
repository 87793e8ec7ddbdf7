"""The outbox keeps everything for a while, then the latest of each topic, and schemas before their data."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from router.edges.gateway_transport import Frame
from router.gateway.outbox import MOST_FRAMES, Outbox


def data(topic: str, text: bytes, type_name: str = "T") -> Frame:
    return Frame(text, topic, type_name, is_schema=False, born=0)


def schema(type_name: str, text: bytes = b"schema") -> Frame:
    return Frame(text, "", type_name, is_schema=True, born=0)


def offer_all(outbox: Outbox, frames: list[Frame]) -> int:
    return sum(outbox.offer(frame, number) for number, frame in enumerate(frames))


def test_what_fits_comes_out_in_the_order_in_which_it_went_in() -> None:
    frames = [schema("T"), data("/a", b"1"), data("/a", b"2"), data("/b", b"3")]
    outbox = Outbox(100)
    assert offer_all(outbox, frames) == 0
    assert outbox.bytes == sum(len(frame.data) for frame in frames)
    assert outbox.take(100) == frames
    assert (len(outbox), outbox.bytes) == (0, 0)


def test_beyond_its_bytes_a_frame_takes_the_place_of_all_of_its_topic() -> None:
    outbox = Outbox(4)
    assert offer_all(outbox, [data("/a", b"1"), data("/b", b"2"), data("/a", b"3"), data("/b", b"4")]) == 0
    assert outbox.offer(data("/a", b"5"), 9) == 2
    assert [frame.data for frame in outbox.take(100)] == [b"5", b"2", b"4"]


def test_a_topic_of_which_nothing_waits_gets_one_in_all_the_same() -> None:
    outbox = Outbox(1)
    assert offer_all(outbox, [data("/a", b"11"), data("/b", b"22"), data("/c", b"33")]) == 0
    assert [frame.topic for frame in outbox.take(100)] == ["/a", "/b", "/c"]


def test_a_schema_is_never_displaced_and_waits_once() -> None:
    outbox = Outbox(1)
    assert offer_all(outbox, [schema("T"), schema("U"), data("/a", b"1"), schema("T"), data("/a", b"2")]) == 1
    assert [(frame.type_name, frame.data) for frame in outbox.take(100)] == [
        ("T", b"schema"),
        ("U", b"schema"),
        ("T", b"2"),
    ]


def test_a_value_of_a_new_type_stays_behind_its_schema() -> None:
    outbox = Outbox(1)
    offer_all(outbox, [data("/a", b"old", "T"), schema("U"), data("/a", b"new", "U")])
    assert [frame.data for frame in outbox.take(100)] == [b"schema", b"new"]


def test_it_gives_no_more_bytes_than_wanted_but_always_something() -> None:
    outbox = Outbox(100)
    offer_all(outbox, [data("/a", b"12345"), data("/b", b"12"), data("/c", b"12"), data("/d", b"1")])
    assert [frame.topic for frame in outbox.take(3)] == ["/a"]
    assert [frame.topic for frame in outbox.take(4)] == ["/b", "/c"]
    assert [frame.topic for frame in outbox.take(0)] == ["/d"]
    assert outbox.take(10) == []


def test_beyond_so_many_frames_it_is_the_same() -> None:
    outbox = Outbox(1 << 20)
    for number in range(MOST_FRAMES):
        assert outbox.offer(data("/a", b"1"), number) == 0
    assert outbox.offer(data("/a", b"2"), 0) == MOST_FRAMES
    assert [frame.data for frame in outbox.take(100)] == [b"2"]


def test_the_lag_is_how_long_the_next_turn_has_been_waited_for() -> None:
    outbox = Outbox(1)
    assert outbox.lag(50) == 0
    outbox.offer(data("/a", b"1"), 10)
    outbox.offer(data("/b", b"2"), 20)
    assert outbox.lag(50) == 40
    outbox.offer(data("/a", b"3"), 45)  # takes the place of the first
    assert outbox.lag(50) == 40
    outbox.take(1)
    assert outbox.lag(50) == 30


FRAMES = st.builds(
    lambda is_schema, topic, kind, size: (
        schema(kind, b"s" * size) if is_schema else data(topic, bytes([65]) * size, kind)
    ),
    st.booleans(),
    st.sampled_from(["/a", "/b", "/c"]),
    st.sampled_from(["T", "U"]),
    st.integers(1, 6),
)


@given(st.lists(st.one_of(FRAMES, st.none()), max_size=60), st.integers(0, 20))
def test_whatever_happens_the_latest_value_of_each_topic_comes_out_after_its_schema(
    steps: list[Frame | None], most: int
) -> None:
    """None takes some. Frames are told apart by identity."""
    outbox = Outbox(most)
    offered: list[Frame] = []
    taken: list[Frame] = []
    displaced = 0
    for now, step in enumerate(steps):
        if step is None:
            taken += outbox.take(8)
            continue
        frame = step._replace(born=now)
        displaced += outbox.offer(frame, now)
        offered.append(frame)
        waiting_topics = len({each.topic for each in offered if not each.is_schema})
        assert outbox.bytes <= most + 6 * (waiting_topics + 2)
    taken += outbox.take(10**6)
    assert (len(outbox), outbox.bytes) == (0, 0)

    values = [frame for frame in taken if not frame.is_schema]
    assert len(values) + displaced == sum(not frame.is_schema for frame in offered)
    for topic in {frame.topic for frame in offered if not frame.is_schema}:
        births = [frame.born for frame in values if frame.topic == topic]
        assert births == sorted(births)
        assert births[-1] == max(frame.born for frame in offered if frame.topic == topic and not frame.is_schema)
    first_offered: dict[str, int] = {}
    for frame in offered:
        if frame.is_schema:
            first_offered.setdefault(frame.type_name, frame.born)
    seen: set[str] = set()
    for frame in taken:
        if frame.is_schema:
            seen.add(frame.type_name)
        elif frame.born > first_offered.get(frame.type_name, 10**6):
            assert frame.type_name in seen
