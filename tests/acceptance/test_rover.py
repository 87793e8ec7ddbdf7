"""Every payload case through the running rover: datagrams to topics and destinations, messages to datagrams, counters.

What is sent and expected comes from the list of directions and from units (`rover_map`, `expected`), not from the
table. The tests share one router, in this order.
"""

from __future__ import annotations

import math
import random
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from time import time
from typing import Any

import pytest
from hypothesis import settings

from tests.acceptance.conftest import Rover
from tests.acceptance.expected import (
    Values,
    expected_messages,
    from_board_units,
    in_board_units,
    same_datagram,
    spelled,
)
from tests.acceptance.payloads import FRAME, WIRE, Sample, arbitrary, generated, golden, sample
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import (
    ARRAY_ROUTE,
    ARRAYS,
    FLOWS,
    HOSTS,
    OUTFLOWS,
    TOPICS,
    TOPICS_FROM_ROS,
    topics_of,
)
from tests.acceptance.site import (
    BARE,
    RouterProcess,
    Site,
    arrived,
    balance,
    key,
    no_room,
    site,
    total,
    udp,
    wait_until,
)
from tests.ports import free_port
from tests.ros.peers import Publisher, Subscriber
from tests.tables import ROUTES
from tests.wire.test_golden_envelopes import GOLDEN, native, values_of

CLOCK_STEP = 1e-6
"""Seconds by which a stamp in whole nanoseconds and a Python time may differ in rounding."""

AT_ONCE = 8
"""Messages that may be on their way: the router's queues hold ten, of which the newest remain."""

RANDOM = settings().max_examples
LENGTHS = (0, 1, 2, 500, 0, 3)
LOAD = 100 * RANDOM
IMU = next(generated("imu_info"))
PH = bytes.fromhex("0a110d713dda401560e520401d333345412001")
"""ph_info from the sensor board, which the basestation gets."""

REJECTED = {
    "empty": ("empty", b""),
    "garbage": ("malformed", b"\xff" * 40),
    "text": ("malformed", b"GET / HTTP/1.1\r\n\r\n"),
    "a payload that is cut": ("malformed", PH[:9]),
    "a payload that is no message": ("malformed", bytes.fromhex("0a020d01")),
    "a length beyond the end, not of zeros": ("malformed", bytes.fromhex("0aff7f0d713d")),
    "a length that never ends": ("malformed", b"\x0a" + b"\x80" * 11),
    "something behind the zeros": ("malformed", PH + b"\0\0\x07"),
    "an unknown field": ("unknown_case", bytes.fromhex("fa0100")),
    "the announced timeout": ("unknown_case", bytes.fromhex("f0013c")),
    "the announced timeout of zero": ("unknown_case", bytes.fromhex("f00100")),
    "a known number as a group": ("malformed", b"\x0b\x0c"),
    "a known number as a varint": ("malformed", b"\x08\x07"),
    "an unknown field of a large number": ("unknown_case", bytes.fromhex("82f4030401020304")),
    "more than 16 KiB": ("truncated", PH.ljust(16 * 1024 + 1, b"\0")),
    "a large datagram": ("truncated", b"\x0a\xdc\xd4\x03" + b"\0" * 59_996),
    "the largest datagram": ("truncated", b"\xaa" * 65_507),
}
ACCEPTED = {
    "a long tag": b"\x8a\x80\x00" + PH[1:],
    "a long length": b"\x0a\x91\x80\x00" + PH[2:],
    "an unknown field in the payload": bytes.fromhex("0a08 0d713dda40 c83e07".replace(" ", "")),
    "the timeout behind the payload": PH + bytes.fromhex("f0013c"),
    "the timeout before the payload": bytes.fromhex("f0013c") + PH,
    "another case before the payload": bytes.fromhex("1a00") + PH,
    "the payload in two parts": bytes.fromhex("0a050d713dda40 0a022001".replace(" ", "")),
}
"""All of them a ph_info to any protobuf parser, and forwarded as they are."""
REPAIRED = {
    "padded to 16 KiB": (PH.ljust(16 * 1024, b"\0"), PH),
    "a length that lacks its last zero": (b"\x0a\x80", b"\x0a\x80\0"),
}


def test_every_series_exists_at_zero_before_the_first_datagram(rover: Rover) -> None:
    counts = rover.site.scrape()
    assert not any(counts.values())
    assert {key("messages_received", route=case, source=flow.source) for case, flow in FLOWS.items()} <= set(counts)
    for case, flow in FLOWS.items():
        assert {key("datagrams_sent", route=case, destination=name) for name in flow.destinations} <= set(counts)
        assert {key("messages_published", route=case, topic=topic) for topic in topics_of(case)} <= set(counts)
        for target in (*flow.destinations, *topics_of(case)):
            assert key("messages_filtered", route=case, target=target) in counts
            for reason in (
                "mapping_error", "non_finite", "too_large", "stale", "rate_limited", "queue_full", "send_buffer_full",
                "send_error", "publish_error", "incomplete", "loop",
            ):  # fmt: skip
                assert key("messages_dropped", route=case, target=target, reason=reason) in counts
    for reason in (
        "truncated", "empty", "malformed", "no_payload", "unknown_case", "unhandled", "ignored", "source_mismatch",
    ):  # fmt: skip
        assert key("datagrams_rejected", listener="rover", reason=reason) in counts
    for metric in ("datagrams_received", "received_bytes", "kernel_drops", "datagrams_padded"):
        assert key(metric, listener="rover") in counts
    assert key("unhandled", payload_case="unknown") in counts


# -- what must not pass, and what must though it looks odd -----------------------------------------------------------


def rejected(datagram: bytes, reason: str) -> Counter[str]:
    return Counter(
        {
            key("datagrams_received", listener="rover"): 1,
            key("received_bytes", listener="rover"): len(datagram),
            key("datagrams_rejected", listener="rover", reason=reason): 1,
        }
    )


def unhandled(datagram: bytes, case: str) -> Counter[str]:
    reason = "unknown_case" if case == "unknown" else "unhandled"
    return rejected(datagram, reason) + Counter({key("unhandled", payload_case=case): 1})


def exchange(place: Site, datagram: bytes, *sources: str) -> Counter[str]:
    """Sends it from each source, and gives what was counted. Nothing may arrive anywhere."""
    before = place.scrape()
    for source in sources:
        place.send(source, datagram)
    counted = place.settle(before, len(sources))
    assert place.waiting() == {}
    return counted


ROUTED = Counter(
    {
        key("datagrams_received", listener="rover"): 1,
        key("received_bytes", listener="rover"): len(PH),
        key("messages_received", route="ph_info", source="sensor_board"): 1,
        key("datagrams_sent", route="ph_info", destination="basestation"): 1,
        key("sent_bytes", route="ph_info", destination="basestation"): len(PH),
        **{key("messages_filtered", route="ph_info", target=topic): 1 for topic in topics_of("ph_info")},
    }
)
"""What is counted for `PH`, while nobody listens."""


@pytest.mark.parametrize(("reason", "datagram"), REJECTED.values(), ids=REJECTED)
def test_what_is_no_envelope_with_a_known_payload_is_rejected(rover: Rover, reason: str, datagram: bytes) -> None:
    place, before = rover.site, rover.site.scrape()
    place.send("sensor_board", datagram, PH)
    assert place.receive("basestation") == PH
    expected = unhandled(datagram, "unknown") if reason == "unknown_case" else rejected(datagram, reason)
    assert place.settle(before, 2) == expected + ROUTED
    assert place.waiting() == {}


@pytest.mark.parametrize("datagram", ACCEPTED.values(), ids=ACCEPTED)
def test_whatever_protobuf_can_read_is_forwarded_as_it_is(rover: Rover, datagram: bytes) -> None:
    assert WIRE.decode(datagram).case.name == "ph_info"
    before = rover.site.scrape()
    rover.site.send("sensor_board", datagram)
    assert rover.site.receive("basestation") == datagram
    counted = rover.site.settle(before, 1)
    assert counted[key("sent_bytes", route="ph_info", destination="basestation")] == len(datagram)
    assert rover.site.waiting() == {}


@pytest.mark.parametrize(("datagram", "whole"), REPAIRED.values(), ids=REPAIRED)
def test_what_is_repaired_is_forwarded_as_it_was_encoded(rover: Rover, datagram: bytes, whole: bytes) -> None:
    before = rover.site.scrape()
    rover.site.send("sensor_board", datagram)
    assert rover.site.receive("basestation") == whole
    counted = rover.site.settle(before, 1)
    assert counted[key("datagrams_padded", listener="rover")] == 1
    assert counted[key("received_bytes", listener="rover")] == len(datagram)
    assert counted[key("sent_bytes", route="ph_info", destination="basestation")] == len(whole)


@pytest.mark.parametrize("case", FLOWS)
def test_an_endpoint_may_only_send_what_its_routes_name(rover: Rover, case: str) -> None:
    datagram = next(generated(case)).datagram
    others = [name for name in HOSTS if name != FLOWS[case].source]
    each = rejected(datagram, "source_mismatch")
    assert exchange(rover.site, datagram, *others) == Counter(
        {name: len(others) * count for name, count in each.items()}
    )


def test_a_stranger_may_send_nothing(tmp_path: Path, rover: Rover) -> None:
    with site(tmp_path, {"stranger": "127.0.0.66"}) as elsewhere:
        before = rover.site.scrape()
        elsewhere.listen = rover.site.listen
        elsewhere.send("stranger", PH)
        assert rover.site.settle(before, 1) == rejected(PH, "source_mismatch")
        assert elsewhere.waiting() == rover.site.waiting() == {}


@pytest.mark.parametrize("case", OUTFLOWS)
def test_what_goes_from_ros_to_udp_is_not_taken_from_udp(rover: Rover, case: str) -> None:
    datagram = next(generated(case)).datagram
    assert exchange(rover.site, datagram, "basestation") == unhandled(datagram, case)


def test_what_is_repaired_and_then_rejected_is_counted_as_both(rover: Rover) -> None:
    repaired = Counter({key("datagrams_padded", listener="rover"): 1})
    trimmed, zeros = bytes.fromhex("f001"), b"\0" * 64
    assert exchange(rover.site, trimmed, "sensor_board") == unhandled(trimmed, "unknown") + repaired
    assert exchange(rover.site, zeros, "sensor_board") == rejected(zeros, "no_payload") + repaired


# -- topics are filled for those who listen, and only while they do --------------------------------------------------

LISTENED_TO = "imu_data"
IMU_TOPIC = {LISTENED_TO: topics_of("imu_info")[LISTENED_TO]}


def send_one(rover: Rover) -> dict[str, tuple[int, int]]:
    """How often each topic of the route was (published, filtered) for one datagram, which is forwarded anyway."""
    before = rover.site.scrape()
    rover.site.send(FLOWS["imu_info"].source, IMU.datagram)
    assert rover.site.receive("basestation") == IMU.datagram
    counted = rover.site.settle(before, 1)
    return {topic: published_and_filtered(counted, topic) for topic in topics_of("imu_info")}


def published_and_filtered(counted: Counter[str], topic: str) -> tuple[int, int]:
    published = counted[key("messages_published", route="imu_info", topic=topic)]
    return published, counted[key("messages_filtered", route="imu_info", target=topic)]


def test_a_topic_is_filled_while_somebody_listens(rover: Rover) -> None:
    nobody = dict.fromkeys(topics_of("imu_info"), (0, 1))
    one_listens = {**nobody, LISTENED_TO: (1, 0)}
    assert send_one(rover) == nobody
    with RosPeer(IMU_TOPIC) as first:
        wait_until(lambda: send_one(rover) == one_listens, "the first published message")
        assert first.receive() == (LISTENED_TO, expected_messages("imu_info", IMU.payload)[LISTENED_TO])
        with RosPeer(IMU_TOPIC):
            assert send_one(rover) == one_listens
        before = rover.site.scrape()
        for _ in range(10):
            assert send_one(rover) == one_listens
        assert rover.site.changes(before)[key("messages_published", route="imu_info", topic=LISTENED_TO)] == 10
        published = rover.site.scrape()[key("messages_published", route="imu_info", topic=LISTENED_TO)]
        assert [first.receive()[0] for _ in range(published - 1)] == [LISTENED_TO] * (published - 1)
        assert first.nothing_left()
    wait_until(lambda: send_one(rover) == nobody, "the end of publishing")
    balance(rover.site.scrape())


@pytest.mark.parametrize(
    ("route", "topic", "policy", "peer"),
    [
        ("drive_motor", "drive_motor", "reliability", (Publisher, "--best-effort")),
        ("imu_info", "imu/mag", "reliability", (Subscriber,)),
        pytest.param(
            *("detected_object_from_ros_2", "detected_objects", "reliability", (Publisher, "--best-effort")),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("imu_info", "imu_data", "durability", (Subscriber, "--transient-local")), marks=pytest.mark.slow
        ),
    ],
)
def test_a_peer_that_cannot_be_served_is_told_and_counted(
    rover: Rover, route: str, topic: str, policy: str, peer: tuple[Any, ...]
) -> None:
    kind, *options = peer
    series = key("qos_incompatible", policy=policy, route=route, topic=topic)
    assert rover.site.samples()[series] == 0
    with closing(kind(topic, {**TOPICS, **TOPICS_FROM_ROS}[topic], *options)):
        wait_until(lambda: rover.site.samples()[series] == 1, "the event")
    wait_until(lambda: rover.site.samples()[series] == 0, "the peer to have gone")
    lines = [line for line in rover.router.log() if (line.get("topic"), line.get("policy")) == (topic, policy)]
    assert [line["level"] for line in lines] == ["warning"]


# -- from ROS: bytes at UDP receivers as the protobuf library would send them ----------------------------------------


@pytest.fixture(scope="module")
def talker(rover: Rover) -> Iterator[RosPeer]:
    """Publishes on all topics that the rover listens to."""
    with RosPeer() as peer:
        peer.open_heard(TOPICS_FROM_ROS)
        yield peer


def in_turns(messages: Sequence[Values]) -> Iterator[Sequence[Values]]:
    for start in range(0, len(messages), AT_ONCE):
        yield messages[start : start + AT_ONCE]


def said(case: str) -> list[Values]:
    """ROS messages of a payload case: ordinary and extreme values, NaN, infinities, enum numbers without a name."""
    return [in_board_units(made.payload) for made in (*generated(case), *islice(arbitrary(case), RANDOM))]


@pytest.mark.parametrize("case", OUTFLOWS)
def test_messages_become_datagrams_byte_for_byte_and_in_order(rover: Rover, talker: RosPeer, case: str) -> None:
    """A board gets none with NaN or infinity."""
    flow, place = OUTFLOWS[case], rover.site
    before, messages, size, refused = place.scrape(), said(case), 0, 0
    for turn in in_turns(messages):
        talker.say(case, *turn)
        for message in turn:
            if flow.destination.endswith("_board") and not is_finite(message):
                refused += 1
                continue
            datagram = place.receive(flow.destination)
            assert same_datagram(datagram, from_board_units(case, message).datagram), message
            size += len(datagram)
    assert place.settle(before, 0, len(messages)) == +Counter(
        {
            key("messages_received", route=flow.route, source=case): len(messages),
            key("datagrams_sent", route=flow.route, destination=flow.destination): len(messages) - refused,
            key("sent_bytes", route=flow.route, destination=flow.destination): size,
            key("messages_dropped", route=flow.route, target=flow.destination, reason="non_finite"): refused,
        }
    )
    assert (refused > 0) == flow.destination.endswith("_board")
    assert place.waiting() == {}


def is_finite(value: Any) -> bool:
    """Whether all floats in the values of a message are."""
    if isinstance(value, dict):
        return all(map(is_finite, value.values()))
    return not isinstance(value, float) or math.isfinite(value)


def test_each_element_of_an_array_becomes_a_datagram(rover: Rover, talker: RosPeer) -> None:
    """What elements say of their frame is not to be believed."""
    place = rover.site
    before = place.scrape()
    for number, length in enumerate(LENGTHS):
        frame = 2**32 - 1 - number
        made = islice(arbitrary("detected_object", seed=number), length)
        objects = [in_board_units(each.payload) for each in made]
        talker.say(ARRAYS, {"frame_id": frame, "detections": objects})
        for index, element in enumerate(objects):
            expected = {**element, "frame_id": frame, "total_count": length, "index": index}
            assert same_datagram(place.receive("basestation"), from_board_units("detected_object", expected).datagram)
    counted = place.settle(before, 0, len(LENGTHS))
    assert counted[key("messages_received", route=ARRAY_ROUTE, source=ARRAYS)] == sum(LENGTHS)
    assert total(counted, "messages_received") == total(counted, "datagrams_sent") == sum(LENGTHS)
    assert place.waiting() == {}


# -- to ROS and to UDP -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", FLOWS)
def test_golden_envelopes_reach_topics_and_destinations(watched: Rover, peer: RosPeer, case: str) -> None:
    listed = [entry for entry in GOLDEN if entry["payload_case"] == case]
    samples = [golden(bytes.fromhex(entry["hex"])) for entry in listed]
    for entry, each in zip(listed, samples, strict=True):
        assert values_of(each.payload, entry["fields"]) == native(each.payload.DESCRIPTOR, entry["fields"])
    play(watched.site, peer, samples)


@pytest.mark.parametrize("case", FLOWS)
def test_generated_envelopes_reach_topics_and_destinations(watched: Rover, peer: RosPeer, case: str) -> None:
    play(watched.site, peer, list(generated(case)))


def test_the_books_balance_and_nothing_is_left_over(watched: Rover, peer: RosPeer) -> None:
    """Nothing went to an endpoint or a topic that none of the tests above expected."""
    counts = watched.site.scrape()
    balance(counts)
    assert total(counts, "kernel_drops") == 0
    assert total(counts, "messages_dropped") == total(counts, "messages_dropped", reason="non_finite")
    assert watched.site.waiting() == {}
    assert peer.nothing_left()


def play(site: Site, peer: RosPeer, samples: list[Sample]) -> None:
    """Sends each variant of each sample, and holds everything that comes of it to what has to."""
    before, counted = site.scrape(), Counter[str]()
    for sent in samples:
        flow = FLOWS[sent.case]
        expected = expected_messages(sent.case, sent.payload)
        for datagram, repaired in sent.variants.items():
            earliest = time()
            site.send(flow.source, datagram)
            for destination in flow.destinations:
                assert site.receive(destination) == sent.datagram
            arrived = dict(peer.receive() for _ in expected)
            stamps = [without_stamp(message) for message in arrived.values()]
            assert all(earliest - CLOCK_STEP <= stamp <= time() for stamp in stamps if stamp is not None)
            assert spelled(arrived) == spelled(expected)
            count(counted, sent, len(datagram), repaired=repaired)
    assert site.settle(before, counted[key("datagrams_received", listener="rover")]) == counted
    assert site.waiting() == {}


def count(counted: Counter[str], sent: Sample, size: int, *, repaired: bool) -> None:
    case = sent.case
    flow = FLOWS[case]
    counted[key("datagrams_received", listener="rover")] += 1
    counted[key("received_bytes", listener="rover")] += size
    if repaired:
        counted[key("datagrams_padded", listener="rover")] += 1
    counted[key("messages_received", route=case, source=flow.source)] += 1
    for destination in flow.destinations:
        counted[key("datagrams_sent", route=case, destination=destination)] += 1
        counted[key("sent_bytes", route=case, destination=destination)] += len(sent.datagram)
    for topic in topics_of(case):
        counted[key("messages_published", route=case, topic=topic)] += 1


def without_stamp(message: dict[str, Any]) -> float | None:
    """Takes the stamp out of a message that has one, and gives it in seconds."""
    if "header" not in message:
        return None
    stamp = message["header"]["stamp"]
    message["header"]["stamp"] = None
    return float(stamp["sec"] + stamp["nanosec"] / 1e9)


def test_a_value_that_a_mapping_cannot_take_is_told_with_the_line_of_the_table(watched: Rover) -> None:
    """Sine of infinity is no number: `gps/vel` goes without, the other targets are served."""
    payload = WIRE.envelopes.first.cases["gps_info"].message_class(heading=float("inf"), speed=1.0)
    datagram = sample("gps_info", payload).datagram
    place, router = watched.site, watched.router
    before = place.scrape()
    place.send("sensor_board", datagram, datagram)
    assert [place.receive("basestation") for _ in range(2)] == [datagram] * 2
    counted = place.settle(before, 2)
    for topic in topics_of("gps_info"):
        published = counted[key("messages_published", route="gps_info", topic=topic)]
        assert published == (0 if topic == "gps/vel" else 2)
    assert counted[key("messages_dropped", route="gps_info", target="gps/vel", reason="mapping_error")] == 2

    def told() -> list[dict[str, Any]]:
        return [line for line in router.events("message dropped") if line["target"] == "gps/vel"]

    wait_until(lambda: bool(told()), "the line")  # it is counted first
    [line] = told()
    assert (line["route"], line["target"], line["reason"]) == ("gps_info", "gps/vel", "mapping_error")
    rover_yaml = ROUTES / "rover.yaml"
    number = next(n for n, text in enumerate(rover_yaml.read_text().splitlines(), 1) if "speed * sin(" in text)
    where, field, why = line["detail"].rsplit(": ", 2)
    assert f"rover.yaml:{number}:" in where
    assert (field, why) == ("twist.linear.x", "the function has no result for inf")


# -- under load: the counters balance when more comes in than the router can take ------------------------------------

GOOD = [each for case in FLOWS for each in generated(case)]


def one_of(rng: random.Random, bad: list[bytes]) -> tuple[str, bytes]:
    """A datagram and who sends it: a good or bad one, trimmed, padded, or from who may not."""
    good = rng.choice(GOOD)
    source = FLOWS[good.case].source
    form = rng.randrange(10)
    if form == 0:
        return source, rng.choice(bad)
    if form == 1:
        return source, rng.randbytes(rng.randrange(60))
    if form == 2:
        return rng.choice(list(HOSTS)), good.datagram
    if form == 3:
        return source, good.datagram.ljust(FRAME, b"\0")
    return source, good.datagram.rstrip(b"\0") if form < 6 else good.datagram


def test_the_books_balance_under_load(watched: Rover) -> None:
    place, rng = watched.site, random.Random(1)
    before, lost = place.scrape(), {name: no_room(opened) for name, opened in place.endpoints.items()}
    bad = [datagram for _, datagram in REJECTED.values()]
    for _ in range(LOAD):
        source, datagram = one_of(rng, bad)
        place.send(source, datagram)
    now = place.settle(before, LOAD)
    assert total(now, "datagrams_received") + total(now, "kernel_drops") == LOAD
    balance(place.scrape())
    for reason in ("malformed", "source_mismatch", "unknown_case", "truncated", "empty"):
        assert total(now, "datagrams_rejected", reason=reason), reason
    assert total(now, "datagrams_padded")
    assert total(now, "messages_published")
    for name, opened in place.endpoints.items():
        assert total(now, "datagrams_sent", destination=name) == arrived(opened, lost[name])


def test_what_the_kernel_drops_is_counted(watched: Rover) -> None:
    """A router that is stopped for a while receives what its buffer holds, and knows how many more there were."""
    place, number = watched.site, 20_000
    before = place.scrape()
    with watched.router.standing_still():
        place.send("sensor_board", *[GOOD[0].datagram] * number)
    now = place.settle(before, number)
    assert total(now, "kernel_drops") > 0
    assert total(now, "datagrams_received") + total(now, "kernel_drops") == number
    balance(place.scrape())


# -- another table ---------------------------------------------------------------------------------------------------

NARROW = """\
  down: {{address: 127.0.0.51:@down, kind: tool}}
routes:
  ph_info: {{source: sensor_board, destinations: [basestation, down, driving_board]}}
  imu_info: {{ignore: a test}}
"""


def test_a_narrow_table_ignores_and_lacks_cases_repairs_nothing_and_serves_who_is_there(tmp_path: Path) -> None:
    down = free_port("127.0.0.51")
    table = BARE.replace("{listen}", "{listen}, framing: exact") + NARROW
    refused = key("messages_dropped", route="ph_info", target="down", reason="send_error")
    with (
        site(tmp_path) as place,
        RouterProcess(tmp_path, place.table(table.replace("@down", str(down)))) as router,
    ):
        gps, empty = next(generated("gps_info")).datagram, golden(bytes.fromhex("0a00")).datagram
        assert exchange(place, IMU.datagram, "sensor_board") == rejected(IMU.datagram, "ignored")
        assert exchange(place, gps, "sensor_board") == unhandled(gps, "gps_info")
        for changed in (empty.rstrip(b"\0"), PH.ljust(FRAME, b"\0")):
            assert exchange(place, changed, "sensor_board") == rejected(changed, "malformed")

        before = place.scrape()
        for _ in range(10):
            place.send("sensor_board", PH)
            assert [place.receive(name) for name in ("basestation", "driving_board")] == [PH, PH]
        counts = place.settle(before, 10)
        assert total(counts, "messages_dropped") == counts[refused] >= 9
        assert total(counts, "datagrams_sent") == 30 - counts[refused]
        with udp("127.0.0.51", down) as back:
            for _ in range(10):
                place.send("sensor_board", PH)
                assert back.recv(1000) == PH
        after = place.settle(before, 20)
        assert after[refused] - counts[refused] <= 1
        balance(place.scrape())
        assert router.stop(signal.SIGTERM) == 0
