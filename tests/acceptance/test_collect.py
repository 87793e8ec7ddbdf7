"""Frames of two cameras through the running router, in any order, with copies and losses, and with hostile numbers."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from tests.acceptance.expected import Values, in_board_units, spelled
from tests.acceptance.payloads import WIRE, Sample, arbitrary, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.site import BARE, RouterProcess, Site, balance, key, site, total, wait_until

TABLE = (
    BARE.replace("{listen}", "{listen}, receive_buffer: 4MiB")
    + """\
routes:
  detected_object:
    source: [left, right]
    collect: {{by: frame_id, count: total_count, order: index, timeout: 2s}}
    topics:
      - topic: objects
        type: comms/msg/DetectedObjectArray
        queue_depth: 1000
        fields: {{frame_id: frame_id, detections: items}}
"""
)
TOPICS = {"objects": "comms/msg/DetectedObjectArray"}
CAMERAS = {"left": "127.0.0.31", "right": "127.0.0.32"}

FRAMES = 40
"""Of each camera."""

WAVE = 4
"""Frames of each camera whose parts are mixed. With those that stay incomplete, all are fewer than the router holds."""

LOST = 0.3
COPIED = 0.2
FILLING = 10_000
"""Hostile datagrams after which the router holds as much as it ever will."""

HOSTILE = 20_000
"""Those that follow."""

FLAT = 1 << 20
"""Bytes by which a process may seem to grow without keeping anything: 50 of each datagram."""


@dataclass(frozen=True)
class Part:
    camera: str
    sample: Sample

    @property
    def frame(self) -> tuple[str, int]:
        return self.camera, self.sample.payload.frame_id


Running = tuple[Site, RouterProcess]


def part(camera: str, frame: int, count: int, index: int, like: Any = None) -> Part:
    payload: Any = WIRE.envelopes.first.cases["detected_object"].message_class()
    if like is not None:
        payload.CopyFrom(like)
    payload.frame_id, payload.total_count, payload.index = frame, count, index
    return Part(camera, sample("detected_object", payload))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("collect")
    with site(folder, CAMERAS) as opened, RouterProcess(folder, opened.table(TABLE)) as router:
        yield opened, router


def picture(camera: str, frame: int, rng: random.Random) -> list[Part]:
    count = rng.randint(1, 6)
    values = islice(arbitrary("detected_object", seed=rng.randrange(1000)), count)
    return [part(camera, frame, count, index, made.payload) for index, made in enumerate(values)]


def waves(rng: random.Random) -> Iterator[list[Part]]:
    """Both cameras number their frames alike."""
    for first in range(0, FRAMES, WAVE):
        sent = []
        for frame in range(first, min(first + WAVE, FRAMES)):
            for camera in CAMERAS:
                kept = [some for some in picture(camera, frame, rng) if rng.random() > LOST]
                sent += kept + [some for some in kept if rng.random() < COPIED]
        rng.shuffle(sent)
        yield sent


def whole_frames(sent: Sequence[Part]) -> dict[tuple[str, int], list[Values]]:
    """What has to be published, in whatever order of frames: all objects of each complete frame, in order."""
    frames: dict[tuple[str, int], dict[int, Values]] = {}
    counts: dict[tuple[str, int], int] = {}
    for some in sent:
        payload = some.sample.payload
        frames.setdefault(some.frame, {})[payload.index] = in_board_units(payload)
        counts[some.frame] = payload.total_count
    return {frame: [there[i] for i in sorted(there)] for frame, there in frames.items() if len(there) == counts[frame]}


def subscribed(place: Site, peer: RosPeer) -> None:
    """Sends frames of one part until the router has learned of the peer, and receives what came of them."""
    start, sent = place.scrape(), 0

    def published() -> bool:
        nonlocal sent
        sent += 1
        place.send("left", part("left", FRAMES + sent, 1, 0).sample.datagram)
        return bool(total(place.changes(start), "messages_published"))

    wait_until(published, "the match")
    counted = place.settle(start, sent)
    for _ in range(total(counted, "messages_published")):
        peer.receive()


def test_whole_frames_come_out_once_and_others_are_counted(place: Running) -> None:
    opened, _ = place
    with RosPeer(TOPICS) as peer:
        subscribed(opened, peer)
        before = opened.scrape()
        sent: list[Part] = []
        for wave in waves(random.Random(1)):
            for some in wave:
                opened.send(some.camera, some.sample.datagram)
            opened.settle(before, len(sent) + len(wave))
            sent += wave
        frames = {some.frame for some in sent}
        parts = {(*some.frame, some.sample.payload.index) for some in sent}
        whole = whole_frames(sent)
        assert 0 < len(whole) < len(frames)
        wait_until(lambda: dropped(opened, before) == len(frames) - len(whole), "the end of the last frame")

        arrived = [peer.receive()[1] for _ in whole]
        expected = [{"frame_id": frame, "detections": objects} for (_, frame), objects in whole.items()]
        assert Counter(map(str, map(spelled, arrived))) == Counter(map(str, map(spelled, expected)))
        assert peer.nothing_left()

    counted = opened.changes(before)
    for camera in CAMERAS:
        received = counted[key("messages_received", route="detected_object", source=camera)]
        assert received == sum(some.camera == camera for some in sent)
    assert total(counted, "messages_published") == len(whole)
    assert total(counted, "messages_collected") == len(parts) - len(frames)
    assert total(counted, "messages_filtered") == len(sent) - len(parts)


def dropped(place: Site, before: Counter[str]) -> int:
    return total(place.changes(before), "messages_dropped", reason="incomplete")


def resident(router: RouterProcess) -> int:
    """Bytes."""
    pages = Path(f"/proc/{router.process.pid}/statm").read_text().split()[1]
    return int(pages) * 4096


HOSTILE_NUMBERS: dict[str, Callable[[int], Part]] = {
    "four billion parts": lambda number: part("left", number, 2**32 - 1, number % 100),
    "frames that never end": lambda number: part("left", number, 2, 0),
    "large frames that never end": lambda number: part("left", number // 8000, 8192, number % 8000),
    "another count each time": lambda number: part("left", 7, 2 + number % 8000, 0),
    "a part that its frame cannot have": lambda number: part("left", number, 5, 5 + number),
}


@pytest.mark.slow
@pytest.mark.parametrize("hostile", HOSTILE_NUMBERS.values(), ids=HOSTILE_NUMBERS)
def test_memory_stays_flat_however_hostile_the_numbers_are(place: Running, hostile: Callable[[int], Part]) -> None:
    opened, router = place
    flood(opened, hostile, range(FILLING))
    before = resident(router)
    flood(opened, hostile, range(FILLING, FILLING + HOSTILE))
    assert resident(router) - before < FLAT


def test_the_books_balance(place: Running) -> None:
    """Last in this module."""
    opened, _ = place
    wait_until(lambda: open_frames(opened.scrape()) == 0, "the end of the last frame")
    balance(opened.scrape(), ())


def flood(place: Site, hostile: Callable[[int], Part], numbers: range) -> None:
    before = place.scrape()
    for start in range(numbers.start, numbers.stop, 1000):
        place.send("left", *(hostile(number).sample.datagram for number in range(start, start + 1000)))
        counted = place.settle(before, start + 1000 - numbers.start)
        assert total(counted, "kernel_drops") == 0


def open_frames(counts: Counter[str]) -> int:
    """Frames whose first part has not been accounted for yet."""
    done = ("messages_published", "messages_dropped", "messages_filtered", "messages_collected")
    return total(counts, "messages_received") - sum(total(counts, metric) for metric in done)
