"""What late clients get of latched topics: real processes publish, the clients of several gateways are played."""

from __future__ import annotations

import asyncio
import json
import os
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, contextmanager
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from router.gateway.latched import FRESH_S, MOST_LATCHED
from router.gateway.transport.base import HIGH_WATER
from router.ros.topics import DiscoveredPublisher
from tests.gateway.asynchronous import asynchronous, until
from tests.gateway.stage import Graph, Played, PlayedClient, Stage, Tap, program
from tests.ros.opening import STRING, cdr, open_ros
from tests.ros.peers import Publisher

GATEWAY = (
    "{{transport: {{tcp: 127.0.0.1:{port}}}, format: json_lines, publish_period: {period}, "
    "topics: {{include: [/greeting]}}, discovery_period: 50ms}}"
)
PATIENCE_S = 20.0
OUTCOMES = ("messages_sent", "messages_filtered")


def texts(played: Played) -> list[str]:
    return [frame.data.decode().split('"data":{"data":"')[1].split('"')[0] for frame in played.client.values]


def has_come(played: Played, text: str) -> bool:
    return texts(played)[-1:] == [text]


ALIKE = [pytest.param((period, period), marks=pytest.mark.slow) for period in ("20ms", "each")]


@pytest.mark.parametrize("periods", [("20ms", "each"), ("each", "20ms"), *ALIKE])
@pytest.mark.parametrize("kept", [3, pytest.param(1, marks=pytest.mark.slow)])
@asynchronous
async def test_a_latched_value_is_sent_and_counted_once_however_many_gateways_join(
    tmp_path: Path, periods: tuple[str, str], kept: int
) -> None:
    first, second, third = (
        GATEWAY.format(port=8600 + number, period=period) for number, period in enumerate((*periods, periods[0]))
    )
    made = program(tmp_path, f"first: {first}, second: {second}, third: {third}")
    with closing(Publisher("greeting", STRING, "--transient-local")) as peer, closing(open_ros()) as ros:
        peer.publish([cdr(str(number)) for number in range(kept)])
        async with Stage(made, ros.topics) as stage:
            for name, played in stage.played.items():
                await played.start()
                await until(partial(has_come, played, str(kept - 1)))
                await asyncio.sleep(0.3)  # what would come again comes now
                for other in stage.played.values():
                    if hasattr(other, "transport"):
                        assert len(set(texts(other))) == len(texts(other))
                received = stage.count("messages_received", name, "ros")
                assert received <= kept
            before = {name: stage.count("messages_received", name, "ros") for name in stage.played}
            peer.publish([cdr("new")])
            await until(lambda: all(has_come(played, "new") for played in stage.played.values()))
            for name, played in stage.played.items():
                assert len(set(texts(played))) == len(texts(played))
                received = stage.count("messages_received", name, "ros")
                assert received == before[name] + 1 <= kept + 1
                assert received == sum(stage.count(outcome, name, "clients") for outcome in OUTCOMES)
            assert stage.faults == []


class LateClient(PlayedClient):
    """A client that comes later; nothing is written to it while it `is_slow`."""

    def __init__(self, played: Played) -> None:
        super().__init__()
        self.is_slow = False
        self._played = played
        played.service.joined(self)

    def backlog(self) -> int:
        return HIGH_WATER if self.is_slow else 0

    def goes_on(self) -> None:
        self.is_slow = False
        self._played.service.drained(self)

    @property
    def texts(self) -> list[str]:
        return [json.loads(frame.data)["data"]["data"] for frame in self.values]


@contextmanager
def publishers(*depths: int) -> Iterator[list[Publisher]]:
    """Each keeps so many messages; 0 for one that keeps none."""
    with ExitStack() as opened:
        options = (("--transient-local", "--depth", str(depth)) if depth else () for depth in depths)
        peers = [Publisher("greeting", STRING, *each) for each in options]
        for peer in peers:
            opened.callback(end, peer)
        yield peers


def end(peer: Publisher) -> None:
    if peer.process.poll() is None:
        peer.close()


def acknowledged(peer: Publisher) -> None:
    """It has published, and those who subscribe by now have all of it."""
    peer.publish([b""])
    while peer.line() != "acknowledged":
        pass  # but of subscribers that it found


@asynccontextmanager
async def gateway(folder: Path, period: str) -> AsyncIterator[tuple[Stage, Played]]:
    with closing(open_ros()) as ros:
        async with Stage(program(folder, f"it: {GATEWAY.format(port=8600, period=period)}"), ros.topics) as stage:
            await stage.played["it"].start()
            yield stage, stage.played["it"]
            assert stage.faults == []


async def subscribed(*peers: Publisher) -> None:
    for peer in peers:
        assert await asyncio.to_thread(peer.line) == "matched"


@pytest.mark.parametrize("period", ["20ms", "each"])
@asynchronous
async def test_a_late_client_gets_what_each_publisher_keeps_once_and_oldest_first(tmp_path: Path, period: str) -> None:
    with publishers(1, 1, 1, 3) as peers:
        for number, peer in enumerate(peers):
            peer.publish([cdr(f"{number} {time}") for time in range(5)])
            acknowledged(peer)
        expected = ["0 4", "1 4", "2 4", "3 2", "3 3", "3 4"]
        async with gateway(tmp_path, period) as (_, played):
            await until(lambda: {*texts(played)} == {*expected})
            for _ in range(2):
                late = LateClient(played)
                await until(lambda late=late: late.texts == expected)  # type: ignore[misc]
            peers[1].kill()
            peers[3].close()
            await asyncio.sleep(FRESH_S)
            last = LateClient(played)
            await until(lambda: last.texts == ["0 4", "2 4"])


@pytest.mark.parametrize("period", ["20ms", "each"])
@asynchronous
async def test_a_late_client_of_a_topic_that_is_never_quiet_gets_no_old_message_after_a_new_one(
    tmp_path: Path, period: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.gateway.topics.RESEND_S", 3600.0)  # a busy computer makes pauses, and then it is quiet
    numbers = [f"{number:03}" for number in range(200)]
    with publishers(5) as [peer]:
        peer.publish([cdr(numbers[0])])
        async with gateway(tmp_path, period) as (_, played):
            await until(lambda: texts(played) == numbers[:1])
            await asyncio.sleep(0.5)  # the first client has all that is kept
            for number in numbers[1:20]:
                peer.publish([cdr(number)])
                await asyncio.sleep(0.005)
            late = LateClient(played)
            for number in numbers[20:]:
                peer.publish([cdr(number)])
                await asyncio.sleep(0.005)
            await until(lambda: late.texts[-1:] == numbers[-1:])
            assert late.texts == sorted(late.texts)  # with a period, the newest may come twice
            if period == "each":
                assert late.texts == numbers[-len(late.texts) :]


@pytest.mark.parametrize("period", ["500ms", "each"])
@asynchronous
async def test_a_client_that_is_there_gets_what_gave_way_within_a_period(tmp_path: Path, period: str) -> None:
    with publishers(1, 1, 3) as peers:
        async with gateway(tmp_path, period) as (_, played):
            await subscribed(*peers)
            late = LateClient(played)
            for peer, said in zip(peers, (["a"], ["b"], ["1", "2", "3", "4"]), strict=True):
                peer.publish([cdr(text) for text in said])
                acknowledged(peer)
            await until(lambda: {*late.texts} >= {"a", "b", "2", "3", "4"})
            assert late.texts[-1] == max(late.texts, key="ab1234".index)


@asynchronous
async def test_what_publishers_keep_comes_to_a_slow_client_when_it_keeps_up_again(tmp_path: Path) -> None:
    with publishers(1, 1, 1) as peers:
        async with gateway(tmp_path, "each") as (stage, played):
            await subscribed(*peers)
            slow, behind = LateClient(played), LateClient(played)
            slow.is_slow = True
            for number, peer in enumerate(peers):
                peer.publish([cdr(str(number))])
                acknowledged(peer)
            await until(lambda: len(behind.texts) == 3)
            later = LateClient(played)
            later.is_slow = True  # before it gets what it came for
            await until(lambda: stage.count("client_messages_dropped", "it", "superseded") == 2)
            await asyncio.sleep(1.0)
            assert slow.texts == later.texts == []
            for each in (slow, later):
                each.goes_on()
            await until(lambda: {*slow.texts} == {*later.texts} == {"0", "1", "2"})
            assert slow.texts[-1] == later.texts[-1] == "2"


@asynchronous
async def test_of_a_mixed_topic_a_late_client_gets_what_is_kept_and_the_latest_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.gateway.latched.PATIENCE_S", 20.0)  # on a busy computer the middleware takes its time
    with publishers(1, 1, 0) as peers:
        async with gateway(tmp_path, "20ms") as (_, played):
            await subscribed(*peers)
            for peer, text in zip(peers, ("a", "b", "c"), strict=True):
                peer.publish([cdr(text)])
                await until(partial(has_come, played, text))
            late = LateClient(played)
            await until(lambda: late.texts == ["a", "b", "c"])


@asynchronous
async def test_behind_a_publisher_that_never_stops_nothing_is_lost_for_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.gateway.sending.MOST_LOOKS", 2)
    with publishers(1, 1) as [peer, busy]:
        async with gateway(tmp_path, "500ms") as (_, played):
            await subscribed(peer, busy)

            def has_come() -> bool:
                busy.publish([cdr("again")])
                return "once" in texts(played)

            await until(lambda: has_come() or "again" in texts(played))
            peer.publish([cdr("once")])
            await until(has_come)


@asynchronous
async def test_large_messages_that_are_kept_go_to_a_late_client_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("router.gateway.latched.PATIENCE_S", 20.0)  # on a busy computer the middleware takes its time
    with publishers(1, 1) as peers:
        large = ["a" * 100_000, "b" * 100_000]
        for peer, text in zip(peers, large, strict=True):
            peer.publish([cdr(text)])
        async with gateway(tmp_path, "20ms") as (_, played):
            await until(lambda: {*texts(played)} == {*large})
            late = LateClient(played)
            await until(lambda: {*late.texts} == {*large})
            assert len(texts(played)) == 2


class DatedTap(Tap):
    """A tap whose messages come with their times of publication (ns)."""

    def __init__(self, depth: int, *messages: tuple[bytes, int]) -> None:
        super().__init__(depth)
        self._dated = deque[tuple[bytes, int]]()
        self.publish(*messages)

    def publish(self, *messages: tuple[bytes, int]) -> None:
        self._dated.extend(messages)
        os.eventfd_write(self.fd, len(messages))

    def take(self) -> tuple[bytes, int] | None:
        return self._dated.popleft() if self._dated else None


class TwoPublishers(Graph):
    """Each keeps a message of /greeting; the large one reaches the subscription for a late client first."""

    small, large = (cdr("x"), 1000), (cdr("x" * 20_000_000), 2000)

    def publishers(self, topic: str) -> list[DiscoveredPublisher]:
        seen = DiscoveredPublisher(STRING, is_reliable=True, keeps=True, is_ours=False, gid=b"one")
        return [seen, seen._replace(gid=b"two")]

    def tap(self, topic: str, message_class: object, *, is_reliable: bool, keeps: bool, depth: int) -> Tap:
        if depth == MOST_LATCHED:
            return DatedTap(depth, self.small, self.large)
        self.taps[topic] = DatedTap(depth, self.small)
        return self.taps[topic]

    def deliver(self) -> None:
        tap = self.taps["/greeting"]
        assert isinstance(tap, DatedTap)
        tap.publish(self.large)


@pytest.mark.parametrize("period", ["20ms", "each"])
@asynchronous
async def test_what_is_too_large_is_counted_once_if_it_arrives_after_a_late_client(tmp_path: Path, period: str) -> None:
    graph = TwoPublishers({"/greeting": STRING})
    async with Stage(program(tmp_path, f"it: {GATEWAY.format(port=8600, period=period)}"), graph) as stage:
        played = stage.played["it"]
        await played.start()
        await until(partial(has_come, played, "x"))
        late = LateClient(played)
        await until(lambda: late.texts == ["x"])
        await until(lambda: stage.count("messages_dropped", "it", "clients", "too_large") == 1)
        received = stage.count("messages_received", "it", "ros")
        graph.deliver()
        await until(lambda: stage.count("messages_received", "it", "ros") == received + 1)
        await until(lambda: 1 + sum(stage.count(outcome, "it", "clients") for outcome in OUTCOMES) == received + 1)
        assert stage.count("messages_dropped", "it", "clients", "too_large") == 1


@asynchronous
async def test_what_is_kept_and_too_large_is_counted_once_however_many_clients_come(tmp_path: Path) -> None:
    with publishers(1, 1) as peers:
        for peer, length in zip(peers, (10, 20_000_000), strict=True):
            peer.publish([cdr("x" * length)])
        async with gateway(tmp_path, "20ms") as (stage, played):
            for _ in range(2):
                late = LateClient(played)
                await until(lambda late=late: late.texts == ["x" * 10])  # type: ignore[misc]
                await until(lambda: stage.count("messages_dropped", "it", "clients", "too_large") == 1)
            outcomes = ("messages_sent", "messages_filtered")
            balance = 1 + sum(stage.count(outcome, "it", "clients") for outcome in outcomes)
            assert stage.count("messages_received", "it", "ros") == balance
