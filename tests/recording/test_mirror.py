"""The mirror shows consumers what is received, and is out of the way when there are none."""

from __future__ import annotations

import queue
import threading
from collections.abc import Sequence

import pytest

from router.datagrams import Peer
from router.engine.dispatch import Receive
from router.recording.mirror import MOST_WAITING, Consumer, Mirror, Mirrored, MirroredDatagram

PEER, STRANGER = ("127.0.0.2", 8), ("127.0.0.9", 8)
LIMIT = 100


class Source:
    """What receives: a function that counts and rejects strangers, rewired as a receive thread would be."""

    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self.routed: list[bytes] = []
        self.mirror = Mirror(LIMIT, self._rewire, self.failures.append)
        self.receive: Receive = self._route
        self.rewired = 0

    def _route(self, data: bytes, peer: Peer) -> str:
        if peer == STRANGER:
            return "source_mismatch"
        self.routed.append(data)
        return ""

    def tee(self) -> Receive:
        return self.mirror.tee("rover", self._route, {PEER: "board", STRANGER: ""}.__getitem__)

    def _rewire(self) -> None:
        self.rewired += 1
        self.receive = self.tee()


def into(got: queue.SimpleQueue[MirroredDatagram]) -> Consumer:
    def consume(batch: Sequence[Mirrored]) -> None:
        for shown in batch:
            got.put(MirroredDatagram(*shown))

    return consume


@pytest.fixture
def source() -> Source:
    return Source()


def test_nothing_is_between_while_nobody_watches(source: Source) -> None:
    assert source.tee() == source.receive == source._route


def test_consumers_see_what_is_routed_with_peer_and_listener(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    detach = source.mirror.attach(into(got))
    for number in range(3):
        source.receive(b"%d" % number, PEER)
    seen = [got.get(timeout=5) for _ in range(3)]
    detach()
    assert [each.data for each in seen] == source.routed == [b"0", b"1", b"2"]
    assert {(each.listener, each.peer) for each in seen} == {("rover", PEER)}
    assert sorted(each.at for each in seen) == [each.at for each in seen]


def test_consumers_see_what_was_decided_and_who_sent(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    source.mirror.attach(into(got))
    assert [source.receive(b"x", peer) for peer in (PEER, STRANGER, PEER)] == ["", "source_mismatch", ""]
    source.mirror.close()
    seen = [got.get_nowait() for _ in range(3)]
    assert [(each.endpoint, each.reason) for each in seen] == [("board", ""), ("", "source_mismatch"), ("board", "")]


def test_the_first_comes_and_the_last_goes_with_a_rewiring(source: Source) -> None:
    first, second = (source.mirror.attach(lambda _: None) for _ in range(2))
    assert source.rewired == 1
    first()
    first()
    assert source.rewired == 1
    second()
    assert source.rewired == 2
    assert source.tee() == source.receive == source._route


def test_one_who_left_sees_no_more_and_one_who_comes_again_does(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    source.mirror.attach(into(got))()
    source.receive(b"unseen", PEER)
    detach = source.mirror.attach(into(got))
    source.receive(b"seen", PEER)
    assert got.get(timeout=5).data == b"seen"
    detach()
    assert got.empty()


def test_closing_shows_what_waits(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    source.mirror.attach(into(got))
    source.receive(b"last", PEER)
    source.mirror.close()
    assert got.get_nowait().data == b"last"


def test_what_is_too_long_is_cut_one_byte_behind_the_limit(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()
    source.mirror.attach(into(got))
    source.receive(bytes(1000), PEER)
    assert len(got.get(timeout=5).data) == LIMIT + 1
    assert len(source.routed[0]) == 1000
    source.mirror.close()


def test_a_slow_consumer_costs_datagrams_that_are_counted_and_no_routing(source: Source) -> None:
    held, entered = threading.Event(), threading.Event()
    seen: list[int] = []

    def slow(batch: Sequence[Mirrored]) -> None:
        entered.set()
        held.wait(20)
        seen.append(len(batch))

    source.mirror.attach(slow)
    source.receive(b"first", PEER)
    assert entered.wait(5)
    for _ in range(MOST_WAITING + 10):
        source.receive(b"more", PEER)
    assert len(source.routed) == MOST_WAITING + 11
    assert source.mirror.lost == 10
    held.set()
    source.mirror.close()
    assert sum(seen) == MOST_WAITING + 1


def test_a_consumer_that_fails_is_told_of_and_spares_the_others(source: Source) -> None:
    got: queue.SimpleQueue[MirroredDatagram] = queue.SimpleQueue()

    def failing(batch: Sequence[Mirrored]) -> None:
        raise LookupError("a bug")

    source.mirror.attach(failing)
    source.mirror.attach(into(got))
    source.receive(b"x", PEER)
    assert got.get(timeout=5).data == b"x"
    source.mirror.close()
    assert [str(error) for error in source.failures] == ["a bug"]
