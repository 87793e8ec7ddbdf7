"""The thread that publishes: what becomes of each message, changes of programs, stops, a middleware that is stuck."""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from time import sleep
from typing import Any

import pytest

from router.declared import Wanted
from tests.carrier.building import MEMORY, RACES, run_program
from tests.carrier.publishing import Publisher, Publishing, wait_until
from tests.carrier.serving_ros import middleware
from tests.carrier.simulated import START, Simulated
from tests.small_tables import STRANGER, enveloped, program

_FLOAT = "type: std_msgs/msg/Float32, fields: {data: "
ROUTES = f"""\
  imu_info:
    source: any
    topics:
      - {{topic: accel, {_FLOAT}accel_x}}}}
      - {{topic: inverse, {_FLOAT}"1 / accel_y"}}, when: accel_x < 100}}
      - {{topic: whole, type: std_msgs/msg/Int32, fields: {{data: round(accel_z)}}}}
      - {{topic: seldom, {_FLOAT}accel_x}}, max_rate: 0.001 Hz}}
  gps_info:
    source: any
    topics: [{{topic: position, {_FLOAT}hdop}}}}, {{topic: accel, {_FLOAT}hdop}}}}]
"""
SHORT_LIVED = f"""\
  imu_info:
    source: any
    topics: [{{topic: accel, {_FLOAT}accel_x}}}}]
    ttl: 1ms
"""
STALE, PUBLISH_ERROR = 2, 7


@pytest.fixture(scope="session")
def functions(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return middleware(tmp_path_factory.mktemp("middleware") / "middleware.so")


Open = Callable[..., Publishing]


@pytest.fixture
def opened(library: ctypes.CDLL, functions: ctypes.CDLL, tmp_path: Path) -> Iterator[Open]:
    """Receives by a table of these routes, and publishes."""
    with ExitStack() as stack:

        def made(routes: str = ROUTES, queue: int = 1 << 16) -> Publishing:
            return Publishing(library, functions, program(tmp_path, routes), stack, queue)

        yield made


def imu(x: float = 1.0, y: float = 2.0, z: float = 3.0) -> bytes:
    return enveloped(imu_info={"accel_x": x, "accel_y": y, "accel_z": z})


def gps(hdop: float = 1.0) -> bytes:
    return enveloped(gps_info={"hdop": hdop})


def number(cdr: bytes) -> float:
    (found,) = struct.unpack("<xxxxf", cdr)
    return float(found)


def check_books(publishing: Publishing) -> None:
    """They balance, and nothing waits."""
    assert list(publishing.ledger().imbalances()) == []
    assert publishing.count("messages_waiting") == 0


# ---- outcomes


def compare(publishing: Publishing, *datagrams: bytes, listener: str = "exact") -> None:
    """The thread counts and publishes what the simulation does, but for topics that have no subscriber."""
    staged = Simulated(publishing.program)
    for datagram in datagrams:
        staged.simulation.datagram(listener, STRANGER, datagram, START)
    publishing.send(*datagrams, listener=listener)
    wait_until(lambda: not publishing.count("messages_waiting"))
    unwanted = {topic for topic, each in publishing.publishers.items() if not each.demand.wanted}
    for topic, publisher in publishing.publishers.items():
        assert publisher.published() == ([] if topic in unwanted else staged.to(topic))
    found, expected = (
        {
            key: count
            for key, count in each.ledger().counted("messages_", "datagrams_").items()
            if key[-1] not in unwanted
        }
        for each in (publishing, staged)
    )
    assert found == expected
    assert [(route, topic) for route, topic, *_ in publishing.losses()] == staged.losses
    check_books(publishing)


def test_each_message_comes_to_what_it_comes_to_on_the_stage(opened: Open) -> None:
    publishing = opened()
    publishing.publishers["position"].demand.wanted = 0
    compare(
        publishing, imu(), imu(2.5), imu(y=0.0), imu(z=math.nan), imu(z=math.inf), imu(x=1000.0, y=0.0), gps(), gps(7.5)
    )
    route = "imu_info", "whole"
    assert publishing.count("messages_dropped", *route, "non_finite") == 2
    assert publishing.count("messages_dropped", "imu_info", "inverse", "mapping_error") == 1
    assert publishing.count("messages_dropped", "imu_info", "seldom", "rate_limited") == 5
    assert publishing.count("messages_filtered", "imu_info", "inverse") == 1
    assert publishing.count("messages_filtered", "gps_info", "position") == 2


SPLIT = f"""\
  imu_info:
    source: any
    topics:
      - {{topic: each, for_each: "[accel_x, accel_y, 9 / accel_z]", when: item != 5, {_FLOAT}10 / item}}}}
      - {{topic: whole, type: std_msgs/msg/Int32, fields: {{data: round(accel_z)}}}}
"""


def test_the_elements_of_a_list_come_to_what_they_come_to_on_the_stage(opened: Open) -> None:
    publishing = opened(SPLIT)
    compare(publishing, imu(), imu(y=0.0), imu(x=5.0), imu(z=0.0))
    route = "imu_info", "each"
    assert publishing.count("messages_received") == 4
    assert publishing.count("messages_split", *route) == 6
    assert publishing.count("messages_published", *route) == 7
    assert publishing.count("messages_filtered", *route) == 1
    assert publishing.count("messages_dropped", *route, "mapping_error") == 2


def test_books_balance_between_the_elements_of_a_list(opened: Open) -> None:
    publishing = opened(SPLIT)
    each = publishing.publishers["each"]
    each.impede(delay_us=20_000)
    publishing.send(imu(), imu(2.0))
    while publishing.count("messages_waiting"):
        assert list(publishing.ledger().imbalances()) == []
    check_books(publishing)
    assert publishing.count("messages_published", "imu_info", "each") == 6


def test_an_envelope_may_have_several_fields_and_lack_its_zeros(opened: Open) -> None:
    parts = imu(1.0, 2.0, 3.0), imu(5.0, 0.0, 0.0)
    compare(opened(), gps(3.0) + imu(), imu() + gps(9.0), parts[0] + parts[1], parts[1] + parts[0])
    compare(opened(), imu(5.0, 1.0, 0.0)[:-1], gps(0.5).rstrip(b"\0"), (gps(2.0) + imu(1.0, 0.5)).rstrip(b"\0"),
            listener="trimmed")  # fmt: skip


def test_nobody_wants_a_topic_for_a_while(opened: Open) -> None:
    publishing = opened(SHORT_LIVED.replace("1ms", "1h"))
    accel = publishing.publishers["accel"]
    for turn in range(40):
        accel.demand.wanted = turn // 10 % 2
        publishing.send(imu(float(turn)))
        wait_until(lambda: not publishing.count("messages_waiting"))
    assert [number(cdr) for cdr in accel.published()] == [*range(10, 20), *range(30, 40)]
    assert publishing.count("messages_filtered") == 20
    check_books(publishing)


def test_what_waits_for_a_topic_that_nobody_wants_any_more_is_filtered(opened: Open) -> None:
    publishing = opened()
    accel, position = publishing.publishers["accel"], publishing.publishers["position"]
    position.impede(is_stuck=True)
    publishing.send(gps(), imu(), imu())
    accel.demand.wanted = 0
    position.impede()
    wait_until(lambda: not publishing.count("messages_waiting"))
    assert accel.count == 0
    assert publishing.count("messages_filtered", "imu_info", "accel") == 2
    check_books(publishing)


def test_what_has_waited_too_long_is_stale(opened: Open) -> None:
    publishing = opened(SHORT_LIVED)
    accel = publishing.publishers["accel"]
    accel.impede(is_stuck=True)
    publishing.send(imu(1.0))
    wait_until(lambda: accel.is_called or publishing.count("messages_dropped"))
    publishing.send(imu(2.0), imu(3.0))
    sleep(0.01)
    accel.impede()
    wait_until(lambda: not publishing.count("messages_waiting"))
    assert publishing.count("messages_dropped", "imu_info", "accel", "stale") >= 2
    assert ("imu_info", "accel", STALE, "") in publishing.losses()
    check_books(publishing)


def test_a_middleware_that_refuses_says_why(opened: Open) -> None:
    publishing = opened(SHORT_LIVED.replace("1ms", "1h"))
    accel = publishing.publishers["accel"]
    reasons = ["there is no room", "x" * 1000, "the others have gone: ä"]
    for reason in reasons:
        accel.impede(refusal=reason)
        publishing.send(imu())
        wait_until(lambda: not publishing.count("messages_waiting"))
    accel.impede()
    publishing.send(imu(4.0))
    publishing.wait_for("messages_published", 1)
    assert publishing.losses() == [("imu_info", "accel", PUBLISH_ERROR, reason[:255]) for reason in reasons]
    assert publishing.count("messages_dropped", "imu_info", "accel", "publish_error") == 3
    assert [number(cdr) for cdr in accel.published()] == [4.0]
    check_books(publishing)


# ---- subscribers that want only the newest message


def sampled(opened: Open, *arguments: Any) -> tuple[Publishing, Publisher]:
    publishing = opened(*arguments)
    for publisher in publishing.publishers.values():
        publisher.demand.wanted = Wanted.NEWEST_MESSAGE
    return publishing, publishing.publishers["position"]


def test_the_newest_message_is_published_once_it_is_due(opened: Open) -> None:
    publishing, position = sampled(opened)
    publishing.send(*map(gps, (1.0, 2.0, 3.0)))
    publishing.publish_due()
    wait_until(lambda: not publishing.count("messages_waiting"))
    assert position.count == 0
    position.demand.is_due = 1
    publishing.publish_due()
    wait_until(lambda: not position.demand.is_due)
    assert [number(cdr) for cdr in position.published()] == [3.0]
    assert position.demand.replaced == 2
    assert publishing.count("messages_published", "gps_info", "position") == 3
    assert publishing.publishers["accel"].count == 0
    check_books(publishing)


def test_messages_wait_in_the_queue_while_it_has_room(opened: Open) -> None:
    publishing, position = sampled(opened, ROUTES, 1 << 14)
    publishing.send(gps())
    sleep(0.05)
    waiting = publishing.count("messages_waiting", "gps_info", "position")  # a thread that has just begun looks once
    publishing.send(gps())
    sleep(0.05)
    assert publishing.count("messages_waiting", "gps_info", "position") == waiting + 1
    publishing.send(*(gps(float(turn)) for turn in range(200)))
    wait_until(lambda: publishing.count("messages_waiting", "gps_info", "position") < 200)  # it was half full
    assert publishing.count("messages_dropped") == 0
    position.demand.is_due = 1
    publishing.publish_due()
    wait_until(lambda: position.count == 1)
    assert [number(cdr) for cdr in position.published()] == [199.0]


def test_the_newest_of_those_that_meet_the_condition_counts(opened: Open) -> None:
    publishing, _ = sampled(opened)
    inverse = publishing.publishers["inverse"]
    publishing.send(imu(1.0, y=2.0), imu(1000.0, y=4.0))
    inverse.demand.is_due = 1
    publishing.publish_due()
    wait_until(lambda: inverse.count == 1)
    assert [number(cdr) for cdr in inverse.published()] == [0.5]


def test_a_message_with_a_ttl_does_not_wait(opened: Open) -> None:
    publishing, _ = sampled(
        opened, ROUTES.replace("topics: [{topic: position", "ttl: 1h\n    topics: [{topic: position")
    )
    publishing.send(gps())
    wait_until(lambda: not publishing.count("messages_waiting"))


def test_a_held_message_does_not_follow_a_newer_one(opened: Open) -> None:
    publishing, position = sampled(opened)
    publishing.send(gps(1.0))
    publishing.publish_due()
    wait_until(lambda: not publishing.count("messages_waiting"))
    position.demand.wanted = Wanted.EVERY_MESSAGE
    publishing.send(gps(2.0), gps(3.0))
    wait_until(lambda: position.count == 2)
    position.demand.is_due = 1
    publishing.publish_due()
    sleep(0.05)
    assert [number(cdr) for cdr in position.published()] == [2.0, 3.0]
    assert position.demand.replaced == 1


@pytest.mark.parametrize("end", [lambda publishing: publishing.change(2), lambda publishing: publishing.thread.stop()])
def test_the_newest_message_is_published_before_a_change_or_stop(
    opened: Open, end: Callable[[Publishing], object]
) -> None:
    publishing, position = sampled(opened)
    publishing.send(gps(1.0), gps(2.0))
    end(publishing)
    wait_until(lambda: position.count == 1)
    assert [number(cdr) for cdr in position.published()] == [2.0]
    check_books(publishing)


def test_a_newest_message_that_the_middleware_refuses_is_counted(opened: Open) -> None:
    publishing, position = sampled(opened)
    position.impede(refusal="there is no room")
    publishing.send(gps())
    position.demand.is_due = 1
    publishing.publish_due()
    publishing.wait_for("messages_dropped", 1)
    assert publishing.losses() == [("gps_info", "position", PUBLISH_ERROR, "there is no room")]
    assert publishing.count("messages_published", "gps_info", "position") == 0
    check_books(publishing)


# ---- a middleware that is stuck


def test_a_full_queue_drops_its_oldest_messages(opened: Open) -> None:
    publishing = opened(ROUTES, 1 << 12)
    accel = publishing.publishers["accel"]
    accel.impede(is_stuck=True)
    publishing.send(gps(0.0))
    wait_until(lambda: accel.is_called)
    publishing.send(*(gps(float(turn)) for turn in range(1, 200)))
    dropped = publishing.count("messages_dropped", "gps_info", "accel", "queue_full")
    assert dropped == publishing.count("messages_dropped", "gps_info", "position", "queue_full")
    assert 0 < dropped < 199
    assert list(publishing.ledger().imbalances()) == []
    assert publishing.count("messages_waiting", "gps_info", "accel") == 200 - dropped
    accel.impede()
    wait_until(lambda: not publishing.count("messages_waiting"))
    expected = [0.0, *map(float, range(dropped + 1, 200))]
    for publisher in (accel, publishing.publishers["position"]):
        assert [number(cdr) for cdr in publisher.published()] == expected
    check_books(publishing)


def test_a_topic_that_is_stuck_is_named(opened: Open) -> None:
    publishing = opened()
    assert publishing.stalled() is None
    position = publishing.publishers["position"]
    position.impede(is_stuck=True)
    publishing.send(gps())
    wait_until(lambda: position.is_called)
    stalled = publishing.stalled()
    assert stalled is not None
    assert stalled[0] == "position"
    sleep(0.01)
    later = publishing.stalled()
    assert later is not None
    assert later[1] >= stalled[1] + 0.01
    position.impede()
    wait_until(lambda: publishing.stalled() is None)


def test_a_stop_publishes_what_waits(opened: Open) -> None:
    publishing = opened()
    accel = publishing.publishers["accel"]
    accel.impede(is_stuck=True)
    publishing.send(*(gps(float(turn)) for turn in range(50)))
    publishing.stop_receiving()
    accel.impede()
    assert publishing.thread.stop()
    assert publishing.thread.stop()
    assert [number(cdr) for cdr in accel.published()] == list(range(50))
    assert publishing.stalled() is None
    check_books(publishing)


def test_a_thread_that_is_stuck_is_left_and_publishes_nothing_more(opened: Open) -> None:
    publishing = opened()
    accel = publishing.publishers["accel"]
    accel.impede(is_stuck=True)
    publishing.send(*(gps(float(turn)) for turn in range(50)))
    wait_until(lambda: accel.is_called)
    publishing.stop_receiving()
    assert not publishing.thread.stop()
    assert not publishing.thread.stop()
    before = publishing.ledger().counted("")
    accel.impede()
    wait_until(lambda: not accel.is_called)
    sleep(0.05)
    assert (accel.count, publishing.publishers["position"].count) == (1, 1)
    assert publishing.ledger().counted("") == before
    assert publishing.thread.wait_for(99, 0.1)


def test_a_thread_that_is_slow_is_left_likewise(opened: Open) -> None:
    publishing = opened()
    accel = publishing.publishers["accel"]
    accel.impede(delay_us=5000)
    publishing.send(*(gps(float(turn)) for turn in range(400)))
    publishing.stop_receiving()
    assert not publishing.thread.stop()
    left_at = accel.count
    sleep(0.1)
    assert accel.count <= left_at + 1
    assert accel.count < 400


def test_books_are_read_while_a_publisher_is_stuck(opened: Open) -> None:
    """There is no waiting for the middleware, and each target is counted as far as it was served."""
    publishing = opened()
    whole = publishing.publishers["whole"]
    whole.impede(is_stuck=True)
    publishing.send(imu(), imu())
    wait_until(lambda: whole.is_called)
    assert list(publishing.ledger().imbalances()) == []
    assert publishing.count("messages_published", "imu_info") == 2
    assert [publishing.count("messages_waiting", "imu_info", topic) for topic in ("accel", "whole")] == [1, 2]
    whole.impede()


# ---- what is held back

HELD = f"""\
  imu_info:
    source: any
    topics:
      - {{topic: held, {_FLOAT}accel_x}}, max_rate: RATE, on_limit: latest}}
      - {{topic: whole, type: std_msgs/msg/Int32, fields: {{data: round(accel_z)}}}}
"""
NEVER, SOON = HELD.replace("RATE", "0.001 Hz"), HELD.replace("RATE", "50 Hz")


def held_of(publishing: Publishing) -> list[float]:
    return [number(cdr) for cdr in publishing.publishers["held"].published()]


def test_the_newest_that_is_held_is_published_when_it_may(opened: Open) -> None:
    publishing = opened(SOON)
    publishing.send(*(imu(float(turn)) for turn in range(20)))
    wait_until(lambda: held_of(publishing)[-1:] == [19.0])
    assert held_of(publishing) == sorted(held_of(publishing))
    assert publishing.publishers["whole"].count == 20
    check_books(publishing)


def test_a_stop_publishes_what_is_held(opened: Open) -> None:
    publishing = opened(NEVER)
    publishing.send(imu(1.0), imu(2.0), imu(3.0))
    wait_until(lambda: not publishing.count("messages_waiting"))
    assert held_of(publishing) == [1.0]
    publishing.stop_receiving()
    assert publishing.thread.stop()
    assert held_of(publishing) == [1.0, 3.0]
    check_books(publishing)


def test_a_thread_that_is_stuck_with_what_was_held_is_left(opened: Open) -> None:
    publishing = opened(SOON)
    held, whole = publishing.publishers["held"], publishing.publishers["whole"]
    publishing.send(imu(1.0))
    wait_until(lambda: held.count == 1)
    held.impede(is_stuck=True)
    publishing.send(imu(2.0), imu(3.0))
    wait_until(lambda: held.is_called)
    publishing.stop_receiving()
    assert not publishing.thread.stop()
    before, many = publishing.ledger().counted(""), whole.count
    held.impede()
    wait_until(lambda: not held.is_called)
    sleep(0.05)
    assert publishing.ledger().counted("") == before
    assert (held.count, whole.count) == (2, many)


def test_what_is_held_goes_along_to_the_next_program(opened: Open) -> None:
    publishing = opened(NEVER)
    publishing.send(imu(1.0), imu(2.0))
    wait_until(lambda: not publishing.count("messages_waiting"))
    for generation in (2, 3):
        publishing.change(generation)
        assert publishing.thread.wait_for(generation, 10)
    assert held_of(publishing) == [1.0]
    publishing.send(imu(3.0))
    wait_until(lambda: publishing.count("messages_dropped", "imu_info", "held", "rate_limited") == 1)
    publishing.stop_receiving()
    publishing.thread.stop()
    assert held_of(publishing) == [1.0, 3.0]
    check_books(publishing)


@pytest.mark.parametrize("later", [HELD.replace(", max_rate: RATE, on_limit: latest", ""), SOON])
def test_what_the_next_program_does_not_hold_comes_before_its_own(opened: Open, tmp_path: Path, later: str) -> None:
    publishing = opened(NEVER)
    publishing.send(imu(1.0), imu(2.0))
    whole = publishing.publishers["whole"]
    whole.impede(is_stuck=True)
    publishing.send(imu(3.0))
    wait_until(lambda: whole.is_called)
    publishing.change(2, program(tmp_path, later))
    publishing.send(imu(4.0))  # behind messages of the earlier program, which the thread has not served
    whole.impede()
    wait_until(lambda: held_of(publishing)[-1:] == [4.0])
    assert held_of(publishing) == [1.0, 3.0, 4.0]
    check_books(publishing)


# ---- frames

FRAMES = f"""\
  imu_info:
    source: any
    collect: {{by: round(accel_z), count: 3, order: round(accel_y), timeout: TIMEOUT}}
    topics: [{{topic: accel, {_FLOAT}"accel_x + items[2].accel_x"}}}}, {{topic: unwanted, {_FLOAT}accel_x}}}}]
"""
LONG = FRAMES.replace("TIMEOUT", "1h")


def of_frame(place: int, frame: int = 1) -> bytes:
    return imu(10.0 + place, place, frame)


def served(publishing: Publishing) -> None:
    wait_until(lambda: not publishing.count("messages_waiting"))


def fates_of(publishing: Publishing, topic: str = "accel") -> dict[str, int]:
    published, collected, filtered = (
        publishing.count(f"messages_{what}", "imu_info", topic) for what in ("published", "collected", "filtered")
    )
    incomplete = publishing.count("messages_dropped", "imu_info", topic, "incomplete")
    return {"published": published, "collected": collected, "filtered": filtered, "incomplete": incomplete}


def test_a_frame_is_published_when_it_is_complete(opened: Open) -> None:
    publishing = opened(LONG)
    publishing.publishers["unwanted"].demand.wanted = 0
    publishing.send(of_frame(2), of_frame(0), of_frame(0), of_frame(1))
    served(publishing)
    assert [number(cdr) for cdr in publishing.publishers["accel"].published()] == [22.0]
    assert fates_of(publishing) == {"published": 1, "collected": 2, "filtered": 1, "incomplete": 0}
    assert fates_of(publishing, "unwanted") == {"published": 0, "collected": 2, "filtered": 2, "incomplete": 0}
    check_books(publishing)


def test_a_frame_is_collected_while_nobody_wants_its_topic(opened: Open) -> None:
    """Somebody may, until it is complete."""
    publishing = opened(LONG)
    for publisher in publishing.publishers.values():
        publisher.demand.wanted = 0
    publishing.send(of_frame(2), of_frame(0))
    served(publishing)
    publishing.publishers["accel"].demand.wanted = 1
    publishing.send(of_frame(1))
    served(publishing)
    assert publishing.publishers["accel"].count == 1


def test_a_frame_ends_in_time_while_nothing_comes(opened: Open) -> None:
    publishing = opened(FRAMES.replace("TIMEOUT", "30ms"))
    publishing.send(of_frame(0), of_frame(1))
    wait_until(lambda: fates_of(publishing)["incomplete"] == 1)
    assert publishing.count("messages_published") == 0
    assert [loss[3] for loss in publishing.losses()] == ["2 of 3 parts"] * 2
    check_books(publishing)


def test_a_frame_that_is_open_goes_along_to_the_next_program(opened: Open) -> None:
    publishing = opened(LONG)
    publishing.send(of_frame(0), of_frame(1))
    served(publishing)
    for generation in (2, 3):
        publishing.change(generation)
        assert publishing.thread.wait_for(generation, 10)
    publishing.send(of_frame(2))
    served(publishing)
    assert [number(cdr) for cdr in publishing.publishers["accel"].published()] == [22.0]
    assert fates_of(publishing) == {"published": 1, "collected": 2, "filtered": 0, "incomplete": 0}
    check_books(publishing)


def test_a_frame_ends_with_the_last_program_that_collects_it(opened: Open, tmp_path: Path) -> None:
    publishing = opened(LONG)
    accel = publishing.publishers["accel"]
    publishing.send(of_frame(0, frame=2))
    served(publishing)
    accel.impede(is_stuck=True)
    publishing.send(of_frame(0), of_frame(1), of_frame(2))
    wait_until(lambda: accel.is_called)
    publishing.change(2, program(tmp_path, FRAMES.replace("TIMEOUT", "2h")))
    publishing.send(of_frame(1, frame=2))  # behind messages of the earlier program, which the thread has not served
    accel.impede()
    assert publishing.thread.wait_for(2, 10)
    served(publishing)
    assert fates_of(publishing) == {"published": 1, "collected": 2, "filtered": 0, "incomplete": 1}
    publishing.stop_receiving()
    assert publishing.thread.stop()
    assert fates_of(publishing)["incomplete"] == 2
    check_books(publishing)


# ---- generations


def test_programs_follow_each_other(opened: Open, tmp_path: Path) -> None:
    publishing = opened()
    accel = publishing.publishers["accel"]
    doubled = program(tmp_path, ROUTES.replace("accel_x}}", "accel_x * 2}}"))
    accel.impede(is_stuck=True)
    publishing.send(imu(1.0), imu(2.0))
    wait_until(lambda: accel.is_called)
    publishing.change(2, doubled)
    publishing.send(imu(3.0))
    assert not publishing.thread.wait_for(2, 0.05)
    accel.impede()
    assert publishing.thread.wait_for(2, 10)
    publishing.send(imu(4.0))
    wait_until(lambda: not publishing.count("messages_waiting"))
    assert [number(cdr) for cdr in accel.published()] == [1.0, 2.0, 6.0, 8.0]
    check_books(publishing)


def test_a_generation_is_reached_without_messages(opened: Open) -> None:
    publishing = opened()
    for generation in (2, 3, 7):
        assert not publishing.thread.wait_for(generation, 0.01)
        publishing.change(generation)
        assert publishing.thread.wait_for(generation, 10)
        assert publishing.thread.wait_for(generation - 1, 10)


@pytest.mark.parametrize(
    "sanitizers",
    ["", pytest.param(RACES, marks=pytest.mark.slow), pytest.param(MEMORY, marks=pytest.mark.slow)],
)
def test_programs_change_while_messages_come(tmp_path: Path, sanitizers: str) -> None:
    run_program("publish", tmp_path, sanitizers=sanitizers)
