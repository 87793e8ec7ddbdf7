"""Frames come out complete, in order and once, whatever way their parts come in; and each part is counted once."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.errors import MappingError
from tests.engine.rig import Topic, serve
from tests.oracles.python_engine import collecting
from tests.oracles.python_engine.collecting import MOST_PARTS, Collector
from tests.oracles.python_engine.pacing import NS

MS = 1_000_000
Part = tuple[Hashable, int, int]
"""A part as the tests offer it: key, count and index; it stands for itself."""


class Frames:
    """A collector with a timeout of 1 s for two topics, and what came out of it."""

    def __init__(self) -> None:
        self.topics = Topic("first"), Topic("second")
        self.collector = Collector(NS, [topic.outcome for topic in self.topics])
        self.complete: list[list[object]] = []
        self.now = 0

    def offer(self, *parts: Part) -> None:
        for part in parts:
            frame = self.collector.offer(self.now, *part, part)
            if frame is not None:
                self.complete.append(frame)
                for topic in self.topics:  # as generated code does
                    topic.outcome.delivered(0)

    def wait(self, until: int) -> None:
        serve(self.collector, until)
        self.now = until

    @property
    def counted(self) -> Mapping[str, int]:
        first, second = (topic.counted() for topic in self.topics)
        assert first == second
        return first


@pytest.fixture
def frames() -> Frames:
    return Frames()


def parts_of(key: Hashable, count: int) -> list[Part]:
    return [(key, count, index) for index in range(count)]


# ---- complete


def test_copies_are_filtered_before_and_after_the_frame_is_complete(frames: Frames) -> None:
    frames.offer(("a", 2, 1), ("a", 2, 1), ("a", 2, 0), ("a", 2, 0), ("a", 2, 1))
    frames.wait(NS - 1)
    frames.offer(("a", 2, 0))
    assert frames.complete == [parts_of("a", 2)]
    assert frames.counted == {"messages_filtered": 4, "messages_collected": 1, "messages_published": 1}


# ---- incomplete


def test_a_frame_whose_time_is_up_counts_once(frames: Frames) -> None:
    frames.now = 5 * MS
    frames.offer(("a", 4, 0), ("a", 4, 3))
    frames.now = 900 * MS
    frames.offer(("a", 4, 1))
    assert frames.collector.next_due == 5 * MS + NS
    frames.wait(2 * NS)
    assert frames.complete == []
    assert frames.counted == {"messages_collected": 2, "incomplete": 1}
    assert [report.detail for report in frames.topics[0].reports] == ["3 of 4 parts"]


def test_a_part_that_comes_in_time_for_nobody_to_have_looked_is_still_too_late(frames: Frames) -> None:
    """Whoever serves the collector is late."""
    frames.offer(("a", 2, 0))
    frames.now = NS
    frames.offer(("a", 2, 1))
    assert frames.complete == []
    assert frames.counted == {"incomplete": 1, "messages_filtered": 1}


def test_at_the_end_what_is_open_is_incomplete(frames: Frames) -> None:
    frames.offer(("a", 3, 0), ("a", 3, 1), ("b", 2, 0))
    frames.collector.end(MS)
    assert frames.counted == {"messages_collected": 1, "incomplete": 2}
    assert frames.collector.next_due is None


# ---- hostile numbers


@pytest.mark.parametrize(("count", "index"), [(0, 0), (3, 3), (3, -1), (-1, 0), (-1, -2), (2**32 - 1, 2**32 - 1)])
def test_numbers_that_no_frame_has_are_a_failure_of_the_mapping(frames: Frames, count: int, index: int) -> None:
    frames.offer(("a", 3, 0))
    with pytest.raises(MappingError):
        frames.offer(("a", count, index))
    frames.offer(("a", 3, 1), ("a", 3, 2))
    assert frames.complete == [parts_of("a", 3)]


def test_a_frame_that_would_never_have_room_is_not_opened(frames: Frames) -> None:
    frames.offer(("a", 2, 0), ("a", 2**32 - 1, 1), ("a", MOST_PARTS + 1, 1), ("a", 2, 1))
    assert frames.complete == [parts_of("a", 2)]
    assert frames.counted == {"incomplete": 2, "messages_collected": 1, "messages_published": 1}


def test_the_largest_frame_has_room(frames: Frames) -> None:
    frames.offer(*parts_of("a", MOST_PARTS))
    assert frames.complete == [parts_of("a", MOST_PARTS)]


class Alive:
    """Counts how many of it there are."""

    now: ClassVar[int] = 0

    def __init__(self) -> None:
        Alive.now += 1

    def __del__(self) -> None:
        Alive.now -= 1


@pytest.mark.parametrize("most", [2, 200, MOST_PARTS, 2**32 - 1])
def test_what_is_held_stays_bounded(most: int) -> None:
    noise, topic = random.Random(most), Topic()
    collector = Collector(NS, [topic.outcome])
    for now in range(30_000):
        count = noise.randint(1, most)
        collector.offer(now, noise.randint(0, 3000), count, noise.randrange(count), Alive())
        assert Alive.now <= MOST_PARTS
    serve(collector, 2 * NS)
    assert Alive.now == 0


# ---- two cameras on a bad network


# ---- against a plain collector


@dataclass
class _Open:
    key: Hashable
    count: int
    opened: int
    parts: list[tuple[int, Part]] = field(default_factory=list)


class Plain:
    """Does what Collector does, in lists that are searched from end to end."""

    def __init__(self, frames: int, parts: int, closed: int) -> None:
        self.limits = frames, parts
        self.most_closed = closed
        self.open: list[_Open] = []
        self.closed: list[tuple[Hashable, int]] = []
        self.counted: Counter[str] = Counter()

    def tick(self, now: int) -> None:
        for frame in [frame for frame in self.open if frame.opened + NS <= now]:
            self.end(frame, now)

    def end(self, frame: _Open, now: int) -> None:
        self.counted["incomplete"] += 1
        self.open.remove(frame)
        self.close(frame.key, now)

    def close(self, key: Hashable, now: int) -> None:
        self.closed = [*self.closed, (key, now + NS)][-self.most_closed :]

    def offer(self, now: int, part: Part) -> list[Part] | None:
        key, count, index = part
        self.tick(now)
        if count > self.limits[1]:
            self.counted["incomplete"] += 1
            return None
        for frame in [frame for frame in self.open if frame.key == key and frame.count != count]:
            self.counted["incomplete"] += 1
            self.open.remove(frame)
        found = [frame for frame in self.open if frame.key == key]
        copies = [place for frame in found for place, _ in frame.parts if place == index]
        if copies or any(closed == key and until > now for closed, until in self.closed):
            self.counted["messages_filtered"] += 1
            return None
        if found:
            self.counted["messages_collected"] += 1
        else:
            if len(self.open) == self.limits[0]:
                self.end(self.open[0], now)
            self.open.append(_Open(key, count, now))
            found = [self.open[-1]]
        found[0].parts.append((index, part))
        if len(found[0].parts) == count:
            self.open.remove(found[0])
            self.close(key, now)
            return [held for _, held in sorted(found[0].parts)]
        if sum(len(frame.parts) for frame in self.open) > self.limits[1]:
            self.end(self.open[0], now)
        return None


@st.composite
def arrivals(draw: st.DrawFn) -> tuple[int, Part]:
    """Pauses (ns) and parts of few small frames, so that all of the rules have something to do."""
    count = draw(st.sampled_from([1, 2, 2, 3, 3, 3, 7, 8]))
    part = (draw(st.integers(0, 6)), count, draw(st.integers(0, count - 1)))
    return draw(st.sampled_from([0, 0, 0, 1, 100 * MS, 300 * MS, NS])), part


@given(st.lists(arrivals(), max_size=120))
def test_it_does_what_a_plain_collector_does(steps: list[tuple[int, Part]]) -> None:
    frames, plain = Frames(), Plain(3, 7, 4)
    with patch.multiple(collecting, MOST_FRAMES=3, MOST_PARTS=7, MOST_CLOSED=4):
        for pause, part in steps:
            for now in sorted({frame.opened + NS for frame in plain.open} | {frames.now + pause}):
                if now <= frames.now + pause:
                    plain.tick(now)
            frames.wait(frames.now + pause)
            complete, before = plain.offer(frames.now, part), len(frames.complete)
            frames.offer(part)
            assert frames.complete[before:] == ([] if complete is None else [complete])
            plain.counted["messages_published"] += complete is not None
            assert frames.counted == {name: count for name, count in plain.counted.items() if count}
        frames.wait(frames.now + NS)
    assert sum(frames.counted.values()) == len(steps)
