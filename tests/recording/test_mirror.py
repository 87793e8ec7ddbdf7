"""The mirror shows consumers what is received."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Sequence

import pytest

from router.recording import mirror
from router.recording.mirror import Acted, Consumer, Mirror, Mirrored, MirroredDatagram, Taken
from tests.recording.recorder_rig import Listed

PEER = ("127.0.0.2", 8)


class Source:
    """What receives: it keeps datagrams while somebody observes, as the carrier's ring does."""

    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self.mirror = Mirror(self, self.failures.append)
        self.lost = 7
        self.observed: list[bool] = []
        self.actions: deque[Acted] = deque()
        self._kept: deque[Mirrored] = deque()

    def receive(self, data: bytes) -> None:
        if self.mirror.is_observed:
            self._kept.append((len(self._kept), "rover", PEER, "board", "", data))

    def take(self) -> Listed:
        return Listed(self._kept.popleft() for _ in range(len(self._kept)))

    def take_actions(self) -> Listed:
        return Listed(self.actions.popleft() for _ in range(len(self.actions)))

    def observe(self, *, is_observed: bool) -> None:
        self.observed.append(is_observed)


def into(got: queue.SimpleQueue[MirroredDatagram]) -> Consumer:
    def consume(batch: Sequence[Mirrored]) -> None:
        for shown in batch:
            got.put(MirroredDatagram(*shown))

    return consume


@pytest.fixture
def source() -> Source:
    return Source()


def test_consumers_see_what_is_routed_with_peer_and_listener(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    detach = source.mirror.attach(into(got))
    for number in range(3):
        source.receive(b"%d" % number)
    seen = [got.get(timeout=5) for _ in range(3)]
    detach()
    assert [each.data for each in seen] == [b"0", b"1", b"2"]
    assert {(each.listener, each.peer, each.endpoint, each.reason) for each in seen} == {("rover", PEER, "board", "")}
    assert source.mirror.lost == 7


def test_what_waits_is_delivered_at_once_on_demand(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror, "PERIOD", 60 * 10**9)
    got: list[Mirrored] = []
    detach = source.mirror.attach(got.extend)
    source.receive(b"1")
    assert source.mirror.deliver()
    assert [data for *_, data in got] == [b"1"]
    detach()


def test_who_waits_for_a_hung_consumer_is_told(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror, "PERIOD", 10**7)
    hangs, may_go_on = threading.Event(), threading.Event()

    def hang(_: Sequence[Mirrored]) -> None:
        hangs.set()
        may_go_on.wait(60)

    detach = source.mirror.attach(hang)
    source.receive(b"1")
    assert hangs.wait(60)
    assert not source.mirror.deliver(0.01)
    may_go_on.set()
    detach()


def test_the_source_is_told_when_the_first_comes_and_the_last_goes(source: Source) -> None:
    first, second = (source.mirror.attach(lambda _: None) for _ in range(2))
    assert source.observed == [True]
    first()
    first()
    assert source.observed == [True]
    second()
    assert source.observed == [True, False]


def test_one_who_left_sees_no_more_and_one_who_comes_again_does(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    source.mirror.attach(into(got))()
    source.receive(b"unseen")
    detach = source.mirror.attach(into(got))
    source.receive(b"seen")
    assert got.get(timeout=5).data == b"seen"
    detach()
    assert got.empty()


def test_closing_shows_what_waits(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    detach = source.mirror.attach(into(got))
    source.receive(b"last")
    source.mirror.close()
    detach()
    assert got.get_nowait().data == b"last"
    assert source.observed == [True, False]


def test_a_keeper_gets_what_is_decoded_later(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror, "KEEPING_PERIOD", 60 * 10**9)
    kept: list[tuple[Taken[Mirrored], Taken[Acted]]] = []
    shown: list[Mirrored] = []
    detach = source.mirror.keep(lambda *taken: kept.append(taken))
    source.receive(b"1")
    source.actions.append((1, "tripped", "drive", "", "", "", "", b""))
    source.mirror.deliver()
    source.mirror.attach(shown.extend)
    source.receive(b"2")
    source.mirror.deliver()
    assert [data for datagrams, _ in kept for *_, data in datagrams.decode(datagrams.records)] == [b"1", b"2"]
    assert [route for _, actions in kept for _, _, route, *_ in actions] == ["drive"]
    assert [data for *_, data in shown] == [b"2"]
    detach()
    source.mirror.close()


def test_a_consumer_that_fails_is_told_of_and_spares_the_others(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()

    def failing(batch: Sequence[Mirrored]) -> None:
        raise LookupError("a bug")

    source.mirror.attach(failing)
    source.mirror.attach(into(got))
    source.receive(b"x")
    assert got.get(timeout=5).data == b"x"
    source.mirror.close()
    assert [str(error) for error in source.failures] == ["a bug"]
