"""Topics followed by gateways, with real publishers in processes of their own."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Collection, Iterator
from contextlib import ExitStack, asynccontextmanager, closing
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from rcl_interfaces.srv import GetParameters  # type: ignore[import-untyped]
from rclpy.serialization import serialize_message

from router.compiler.compiled_table import TopicPlan
from router.errors import StartError
from router.gateway.encoding import ReadyType, Sample
from router.gateway.json_codec import UnreadableError
from router.gateway.json_types import Style
from router.gateway.packets import decompress
from router.gateway.publishers import Selection
from router.gateway.subscriptions import NotInstalledError, Subscriptions, TopicSubscription
from router.gateway.transport.base import PER_TURN
from router.types.ros import MsgFiles, RosbagsDefinitions, RosInterfaces, ros_interfaces
from tests.gateway.asynchronous import asynchronous, until
from tests.ros.opening import HELLO, STRING, cdr, open_ros, padded, string_topic
from tests.ros.peers import Publisher

INT32 = "std_msgs/msg/Int32"
FIVE = bytes.fromhex("0001000005000000")
INTERFACES = ros_interfaces()
PLAIN = Selection(STRING, is_reliable=True, keeps=False, others=())
OURS = PLAIN._replace(is_ours=True)
PATIENCE_S = 20.0

Publish = Callable[..., Publisher]


@pytest.fixture
def publisher() -> Iterator[Publish]:
    """Opens `Publisher("greeting", type, *options)`."""
    with ExitStack() as peers:
        yield lambda *arguments: peers.enter_context(closing(Publisher("greeting", *arguments)))


@asynccontextmanager
async def opened(*publishers: TopicPlan) -> AsyncIterator[Subscriptions]:
    """A subscriptions on a node that publishes on these."""
    with (
        closing(open_ros(*publishers)) as ros,
        closing(Subscriptions(ros.topics, INTERFACES, asyncio.get_running_loop())) as subscriptions,
    ):
        yield subscriptions


async def found(
    subscriptions: Subscriptions, topics: Collection[str], inbound: Collection[str] = ()
) -> dict[str, Selection]:
    return (await subscriptions.discover(inbound, lambda topic: 0 if topic in topics else None, 1000))[0]


async def seen(subscriptions: Subscriptions, condition: Callable[[Selection], bool] = lambda _: True) -> Selection:
    """What is seen of /greeting as soon as it is published so."""
    deadline = asyncio.get_running_loop().time() + PATIENCE_S
    while True:
        choice = (await found(subscriptions, ["/greeting"])).get("/greeting")
        if choice and condition(choice):
            return choice
        assert asyncio.get_running_loop().time() < deadline, f"it was never published like that: {choice}"
        await asyncio.sleep(0.01)


async def matched(peer: Publisher) -> None:
    assert await asyncio.to_thread(peer.line) == "matched"


def latest(subscription: TopicSubscription) -> bytes | None:
    sample = subscription.latest()
    return sample.cdr if sample else None


async def heard(peer: Publisher, cdr: bytes, subscription: TopicSubscription) -> None:
    """It publishes until it is heard: whoever was subscribed to anew is not told in any other way."""

    def came() -> bool:
        peer.publish([cdr])
        return latest(subscription) == cdr

    await until(came)


@asynchronous
async def test_wanted_topics_are_seen_as_their_publishers_have_them(publisher: Publish) -> None:
    publisher(STRING, "--transient-local")
    async with opened(string_topic(topic="own")) as subscriptions:
        keepers = (await seen(subscriptions)).keepers
        assert len(keepers) == 1
        assert await found(subscriptions, ["/greeting", "/own", "/nobody"]) == {
            "/greeting": Selection(STRING, is_reliable=True, keeps=True, others=(), keepers=keepers),
            "/own": OURS,
        }
        assert await found(subscriptions, ["/own"], inbound=["/own"]) == {}
        assert await found(subscriptions, []) == {}


@asynchronous
async def test_of_too_many_topics_those_of_the_lowest_rank_are_found_and_the_others_named() -> None:
    async with opened(*(string_topic(topic=name) for name in "abc")) as subscriptions:
        await found(subscriptions, ["/a", "/b", "/c"])
        ranks = {"/a": 2, "/b": 2, "/c": 1, "/rosout": None}
        assert subscriptions.is_of_table("/a")
        chosen, beyond = await subscriptions.discover((), ranks.get, 2)
        assert (chosen, beyond) == ({"/a": OURS, "/c": OURS}, {"/b"})


@asynchronous
async def test_looking_lets_others_have_their_turn_between_topics() -> None:
    turns = 0

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    numbers = [f"/number_{number}" for number in range(20)]
    async with opened(*(string_topic(topic=number[1:]) for number in numbers)) as subscriptions:
        await found(subscriptions, numbers)  # the type is ready from here on
        task = asyncio.get_running_loop().create_task(other())
        assert len(await found(subscriptions, numbers)) == 20
        assert turns >= 20
        task.cancel()


@asynchronous
async def test_the_latest_value_is_the_newest_and_stays_until_another_one_comes(publisher: Publish) -> None:
    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", PLAIN, None)
        assert (subscription.topic, subscription.type_name) == ("/greeting", STRING)
        assert json.loads(subscription.schema(Style.PLAIN))["name"] == "String"
        assert subscription.latest() is None
        peer = publisher(STRING)
        await matched(peer)
        peer.publish(cdr(str(number)) for number in range(50))
        await until(lambda: subscription.arrived == 50)
        sample = subscription.latest()
        assert sample
        assert (sample.topic, sample.type_name, sample.cdr) == ("/greeting", STRING, cdr("49"))
        assert subscription.latest() is sample
        peer.publish([HELLO])
        await until(lambda: latest(subscription) == HELLO)
        assert subscription.arrived == 51


@asynchronous
async def test_every_message_is_handed_on_in_order_and_a_turn_is_short(publisher: Publish) -> None:
    texts = [cdr(str(number)) for number in range(100)]
    samples: list[bytes] = []
    turns: list[int] = []

    def turn() -> None:
        turns.append(len(samples))
        if len(samples) < len(texts):
            asyncio.get_running_loop().call_soon(turn)

    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", PLAIN, lambda _, sample: samples.append(sample.cdr))
        peer = publisher(STRING)
        await matched(peer)
        peer.publish(texts)
        peer.await_receipt()  # while the loop stands still, so that they all wait
        turn()
        await until(lambda: samples == texts)
        assert max(after - before for before, after in pairwise(turns)) <= PER_TURN
        assert subscription.arrived == len(texts)
        assert latest(subscription) == texts[-1]


@asynchronous
async def test_all_who_want_each_message_share_a_feed_and_all_who_want_the_latest_another(publisher: Publish) -> None:
    first: list[tuple[TopicSubscription, Sample]] = []
    second: list[tuple[TopicSubscription, Sample]] = []

    def each(subscription: TopicSubscription, sample: Sample) -> None:
        first.append((subscription, sample))

    async with opened() as subscriptions:
        calm = subscriptions.join("/greeting", PLAIN, None)
        subscription = subscriptions.join("/greeting", PLAIN, each)
        assert subscriptions.join("/greeting", PLAIN, lambda *handed: second.append(handed)) is subscription
        assert subscriptions.join("/greeting", PLAIN, None) is calm is not subscription
        peer = publisher(STRING)
        await heard(peer, cdr("one"), subscription)
        peer.publish([cdr("two"), cdr("three")])
        await until(lambda: latest(subscription) == latest(calm) == cdr("three"))
        assert first == second
        assert all(handed is subscription for handed, _ in first)
        assert [sample.cdr for _, sample in first][-2:] == [cdr("two"), cdr("three")]
        assert subscription.latest() is first[-1][1]
        subscriptions.leave(subscription, each)
        peer.publish([cdr("four")])
        await until(lambda: latest(subscription) == cdr("four"))
        assert len(first) == len(second) - 1


@asynchronous
async def test_what_is_kept_comes_once_though_publishers_of_less_quality_come_and_go(publisher: Publish) -> None:
    samples: list[bytes] = []

    def each(_: TopicSubscription, sample: Sample) -> None:
        samples.append(sample.cdr)

    async with opened() as subscriptions:
        publisher(STRING, "--transient-local").publish([HELLO])
        kept = await seen(subscriptions)
        subscription = subscriptions.join("/greeting", kept, each)
        await until(lambda: samples == [HELLO])
        for wanted in (kept._replace(keeps=False), kept):
            assert subscriptions.join("/greeting", wanted, each) is subscription
            subscriptions.leave(subscription, each)
        await until(lambda: subscription.arrived == 2)  # delivered again
        await asyncio.sleep(0.1)
        assert samples == [HELLO]
        assert subscription.missed == 0


@asynchronous
async def test_a_fault_of_one_follower_loses_nothing_else(publisher: Publish) -> None:
    samples: list[bytes] = []
    faults: list[object] = []

    def fails(_: TopicSubscription, sample: Sample) -> None:
        raise RuntimeError("no")

    asyncio.get_running_loop().set_exception_handler(lambda _, context: faults.append(context["exception"]))
    async with opened() as subscriptions:
        subscriptions.join("/greeting", PLAIN, fails)
        subscriptions.join("/greeting", PLAIN, lambda _, sample: samples.append(sample.cdr))
        peer = publisher(STRING)
        await matched(peer)
        peer.publish([HELLO, cdr("newer")])
        await until(lambda: samples == [HELLO, cdr("newer")])
        assert [str(fault) for fault in faults] == ["no", "no"]


@asynchronous
async def test_a_feed_is_closed_when_the_last_follower_leaves() -> None:
    with (
        closing(open_ros()) as ros,
        closing(Subscriptions(ros.topics, INTERFACES, asyncio.get_running_loop())) as subscriptions,
    ):
        subscription = subscriptions.join("/nobody", PLAIN, None)
        assert subscriptions.join("/nobody", PLAIN, None) is subscription
        subscriptions.leave(subscription, None)
        assert "/nobody" in ros.topics.names()
        subscriptions.leave(subscription, None)
        await until(lambda: "/nobody" not in ros.topics.names())
        assert subscription.latest() is None
        assert subscriptions.join("/nobody", PLAIN, None) is not subscription


@asynchronous
async def test_it_adapts_when_a_publisher_of_less_quality_joins(publisher: Publish) -> None:
    async with opened() as subscriptions:
        reliable = publisher(STRING)
        subscription = subscriptions.join("/greeting", before := await seen(subscriptions), None)
        await matched(reliable)
        lossy = publisher(STRING, "--best-effort")
        after = await seen(subscriptions, lambda choice: not choice.is_reliable)
        assert subscriptions.join("/greeting", after, None) is subscription
        subscriptions.leave(subscription, None)
        assert before.is_reliable
        await heard(lossy, HELLO, subscription)
        await heard(reliable, cdr("as well"), subscription)


@asynchronous
async def test_whoever_follows_again_for_another_quality_gets_no_message_twice(publisher: Publish) -> None:
    samples: list[bytes] = []

    def each(_: TopicSubscription, sample: Sample) -> None:
        samples.append(sample.cdr)

    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", PLAIN, each)
        peer = publisher(STRING)
        await matched(peer)
        peer.publish([HELLO])
        peer.await_receipt()  # holds up the loop: what came is not taken yet
        assert samples == []
        assert subscriptions.join("/greeting", PLAIN._replace(is_reliable=False), each) is subscription
        subscriptions.leave(subscription, each)
        assert samples == [HELLO]


@asynchronous
async def test_what_gave_way_in_the_queue_is_counted_once_and_nothing_else(publisher: Publish) -> None:
    samples: list[bytes] = []
    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", PLAIN, lambda _, sample: samples.append(sample.cdr))
        peer = publisher(STRING)
        await matched(peer)
        peer.publish([HELLO])
        await until(lambda: samples == [HELLO])
        peer.publish([HELLO] * 250)
        peer.await_receipt()
        await until(lambda: subscription.arrived == 251)
        peer.publish([cdr("last")])
        await until(lambda: samples[-1] == cdr("last"))
        assert (len(samples), subscription.missed) == (102, 150)
        peer.close()
        await asyncio.sleep(0.5)  # a publisher that goes is no message
        assert (subscription.arrived, subscription.missed) == (252, 150)


@asynchronous
async def test_what_was_kept_comes_to_a_late_feed(publisher: Publish) -> None:
    publisher(STRING, "--transient-local").publish([HELLO])
    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", await seen(subscriptions), None)
        await until(lambda: latest(subscription) == HELLO)


@asynchronous
async def test_another_type_is_another_feed_and_the_old_one_ends(publisher: Publish) -> None:
    async with opened() as subscriptions:
        text = publisher(STRING)
        old = subscriptions.join("/greeting", await seen(subscriptions), None)
        assert subscriptions.join("/greeting", PLAIN, None) is old  # somebody else, who does not know yet
        await matched(text)
        text.publish([HELLO])
        await until(lambda: latest(old) == HELLO)
        publisher(INT32)
        number = publisher(INT32)
        several = await seen(subscriptions, lambda choice: choice.type_name == INT32)
        assert several.others == (STRING,)
        new = subscriptions.join("/greeting", several, None)
        assert (new is old, new.type_name) == (False, INT32)
        assert (new.is_open, old.is_open) == (True, False)
        subscriptions.leave(old, None)
        await matched(number)
        number.publish([FIVE])
        await until(lambda: latest(new) == FIVE)
        assert latest(old) == HELLO
        assert subscriptions.join("/greeting", several, None) is new
        subscriptions.leave(old, None)
        assert latest(new) == FIVE


@asynchronous
async def test_a_publisher_that_was_killed_is_followed_by_its_successor() -> None:
    async with opened() as subscriptions:
        subscription = subscriptions.join("/greeting", PLAIN, None)
        killed = Publisher("greeting", STRING)
        await matched(killed)
        killed.publish([HELLO])
        await until(lambda: latest(subscription) == HELLO)
        killed.kill()
        with closing(Publisher("greeting", STRING)) as successor:
            await matched(successor)
            successor.publish([cdr("again")])
            await until(lambda: latest(subscription) == cdr("again"))


EVENT = "rcl_interfaces/srv/GetParameters_Event"


@asynchronous
async def test_a_part_of_a_service_is_followed_though_no_msg_file_declares_it(publisher: Publish) -> None:
    happened = GetParameters.Event(request=[GetParameters.Request(names=["speed"])])
    async with opened() as subscriptions:
        peer = publisher(EVENT)
        subscription = subscriptions.join(
            "/greeting", await seen(subscriptions, lambda choice: choice.type_name == EVENT), None
        )
        await heard(peer, padded(serialize_message(happened)), subscription)
        sample = subscription.latest()
        assert sample
        assert sample.type_name == EVENT
        value = json.loads(sample.text(Style.PLAIN))
        assert (value["request"], value["response"]) == ([{"names": ["speed"]}], [])
        schema = json.loads(subscription.schema(Style.PLAIN))
        assert (schema["name"], schema["namespace"]) == ("GetParameters_Event", "rcl_interfaces::srv")
        request = schema["fields"][1]["subtype"]
        assert (request["name"], request["namespace"]) == ("GetParameters_Request", "rcl_interfaces::srv")


@asynchronous
async def test_a_message_is_followed_as_its_class_says_where_msg_files_do_not(
    publisher: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RosbagsDefinitions, "find", lambda *_: None)
    file = tmp_path / "std_msgs" / "msg" / "String.msg"
    file.parent.mkdir(parents=True)
    peer, loop = publisher(STRING), asyncio.get_running_loop()
    with closing(open_ros()) as ros:
        for text in (None, "no_such_msgs/Thing it", "this is no definition"):
            if text:
                file.write_text(text, encoding="utf-8")
            interfaces = RosInterfaces(MsgFiles([tmp_path]), RosbagsDefinitions())
            with closing(Subscriptions(ros.topics, interfaces, loop)) as subscriptions:
                subscription = subscriptions.join("/greeting", PLAIN, None)
                await heard(peer, HELLO, subscription)
                sample = subscription.latest()
                assert sample
                assert sample.text(Style.PLAIN) == b'{"data":"hello, rover"}'


@asynchronous
async def test_a_type_that_is_not_installed_is_refused_each_time() -> None:
    async with opened() as subscriptions:
        for type_name in ["std_msgs/msg/NoSuch", "no_such/msg/Thing", "some::Idl_", "a/action/B_Feedback"] * 2:
            with pytest.raises(NotInstalledError, match=f"{type_name} is not installed"):
                subscriptions.join("/greeting", PLAIN._replace(type_name=type_name), None)


@asynchronous
async def test_a_topic_that_a_route_has_with_another_type_is_refused_and_can_be_followed_with_its_own() -> None:
    async with opened(string_topic()) as subscriptions:
        with pytest.raises(StartError, match="'/greeting' is std_msgs/msg/String in this router"):
            subscriptions.join("/greeting", PLAIN._replace(type_name=INT32), None)
        assert subscriptions.join("/greeting", PLAIN, None).type_name == STRING


@asynchronous
async def test_a_topic_of_a_route_is_seen_with_the_type_of_the_route_though_others_have_more_publishers(
    publisher: Publish,
) -> None:
    publisher(INT32)
    publisher(INT32)
    async with opened(string_topic()) as subscriptions:
        selection = await seen(subscriptions, lambda choice: choice.others == (INT32,))
        assert subscriptions.join("/greeting", selection, None).type_name == STRING


class Counted(ReadyType):
    """Counts conversions."""

    conversions = 0

    def text(self, style: Style, cdr: bytes) -> bytes:
        self.conversions += 1
        return super().text(style, cdr)


def string_type() -> Counted:
    message = INTERFACES.get(STRING)
    assert message
    return Counted(message, None)


def test_each_form_of_a_sample_is_made_once() -> None:
    ready = string_type()
    sample = Sample("/greeting", ready, HELLO, 1)
    assert not sample.has_payload(Style.WRAPPED, 3)
    for _ in range(2):
        assert sample.text(Style.PLAIN) == b'{"data":"hello, rover"}'
        assert sample.payload(Style.PLAIN, 0) == b'{"data":"hello, rover"}'
        assert sample.payload(Style.WRAPPED, 0) == b'{"data":["hello, rover"]}'
        assert decompress(sample.payload(Style.WRAPPED, 3), 1000) == b'{"data":["hello, rover"]}'
        assert sample.payload(Style.WRAPPED, 3) is sample.payload(Style.WRAPPED, 3)
    assert sample.has_payload(Style.WRAPPED, 3)
    assert ready.conversions == 2


def test_bytes_that_are_no_message_are_refused_each_time() -> None:
    sample = Sample("/greeting", string_type(), HELLO[:6], 1)
    for _ in range(2):
        with pytest.raises(UnreadableError):
            sample.payload(Style.WRAPPED, 0)
