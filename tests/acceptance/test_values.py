"""Every payload case through the running router: values on ROS topics, bytes at destinations, counters."""

from __future__ import annotations

from collections import Counter
from time import time
from typing import Any

import pytest

from tests.acceptance.conftest import Rover
from tests.acceptance.expected import expected_messages, spelled
from tests.acceptance.payloads import Sample, generated, golden
from tests.acceptance.ros_peer import RosPeer
from tests.acceptance.rover_map import FLOWS, topics_of
from tests.acceptance.site import Site, balance, key, total
from tests.wire.test_golden_envelopes import GOLDEN, native, values_of

CLOCK_STEP = 1e-6
"""Seconds by which a stamp in whole nanoseconds and a Python time may differ in rounding."""


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
                "mapping_error", "non_finite", "stale", "rate_limited", "queue_full", "send_buffer_full", "send_error",
                "publish_error", "incomplete", "loop",
            ):  # fmt: skip
                assert key("messages_dropped", route=case, target=target, reason=reason) in counts
    for reason in (
        "truncated", "empty", "malformed", "no_payload", "unknown_case", "unhandled", "ignored", "source_mismatch",
    ):  # fmt: skip
        assert key("datagrams_rejected", listener="rover", reason=reason) in counts
    for metric in ("datagrams_received", "received_bytes", "kernel_drops", "datagrams_padded"):
        assert key(metric, listener="rover") in counts
    assert key("unhandled", payload_case="unknown") in counts


@pytest.mark.parametrize("case", FLOWS)
def test_golden_envelopes_reach_topics_and_destinations(watched: Rover, peer: RosPeer, case: str) -> None:
    listed = [entry for entry in GOLDEN if entry["payload_case"] == case]
    samples = [golden(bytes.fromhex(entry["hex"])) for entry in listed]
    for entry, sample in zip(listed, samples, strict=True):
        assert values_of(sample.payload, entry["fields"]) == native(sample.payload.DESCRIPTOR, entry["fields"])
    play(watched.site, peer, samples)


@pytest.mark.parametrize("case", FLOWS)
def test_generated_envelopes_reach_topics_and_destinations(watched: Rover, peer: RosPeer, case: str) -> None:
    play(watched.site, peer, list(generated(case)))


def test_the_books_balance_and_nothing_is_left_over(watched: Rover, peer: RosPeer) -> None:
    """Last in this module: nothing went to an endpoint or a topic that none of the tests above expected."""
    counts = watched.site.scrape()
    balance(counts)
    assert total(counts, "kernel_drops") == total(counts, "messages_dropped") == 0
    assert watched.site.waiting() == {}
    assert peer.nothing_left()


def play(site: Site, peer: RosPeer, samples: list[Sample]) -> None:
    """Sends each variant of each sample, and holds everything that comes of it to what has to."""
    before, counted = site.scrape(), Counter[str]()
    for sample in samples:
        flow = FLOWS[sample.case]
        expected = expected_messages(sample.case, sample.payload)
        for datagram, repaired in sample.variants.items():
            earliest = time()
            site.send(flow.source, datagram)
            for destination in flow.destinations:
                assert site.receive(destination) == datagram
            arrived = dict(peer.receive() for _ in expected)
            stamps = [without_stamp(message) for message in arrived.values()]
            assert all(earliest - CLOCK_STEP <= stamp <= time() for stamp in stamps if stamp is not None)
            assert spelled(arrived) == spelled(expected)
            count(counted, sample.case, len(datagram), repaired=repaired)
    assert site.settle(before, counted[key("datagrams_received", listener="rover")]) == counted
    assert site.waiting() == {}


def count(counted: Counter[str], case: str, size: int, *, repaired: bool) -> None:
    flow = FLOWS[case]
    counted[key("datagrams_received", listener="rover")] += 1
    counted[key("received_bytes", listener="rover")] += size
    if repaired:
        counted[key("datagrams_padded", listener="rover")] += 1
    counted[key("messages_received", route=case, source=flow.source)] += 1
    for destination in flow.destinations:
        counted[key("datagrams_sent", route=case, destination=destination)] += 1
        counted[key("sent_bytes", route=case, destination=destination)] += size
    for topic in topics_of(case):
        counted[key("messages_published", route=case, topic=topic)] += 1


def without_stamp(message: dict[str, Any]) -> float | None:
    """Takes the stamp out of a message that has one, and gives it in seconds."""
    if "header" not in message:
        return None
    stamp = message["header"]["stamp"]
    message["header"]["stamp"] = None
    return float(stamp["sec"] + stamp["nanosec"] / 1e9)
