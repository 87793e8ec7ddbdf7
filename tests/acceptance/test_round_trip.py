"""Every payload case from UDP to ROS and back to UDP, through two routers that know each case in both directions."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import pytest
from hypothesis import settings

from tests.acceptance.expected import same_datagram
from tests.acceptance.payloads import WIRE, Sample, arbitrary, generated, golden
from tests.acceptance.round_trip import back_to_back, carried, turned
from tests.acceptance.site import Site, balance, labels_of, total
from tests.wire.test_golden_envelopes import GOLDEN

RANDOM = settings().max_examples
Ends = tuple[Site, Site]


@pytest.fixture(scope="module")
def ends(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ends]:
    with back_to_back(tmp_path_factory.mktemp("round_trip")) as both:
        yield both


def samples(case: str) -> Iterator[Sample]:
    yield from (golden(bytes.fromhex(entry["hex"])) for entry in GOLDEN if entry["payload_case"] == case)
    yield from generated(case)
    yield from islice(arbitrary(case), RANDOM)


@pytest.mark.parametrize("case", WIRE.envelopes.first.cases)
def test_values_come_back_equal_and_in_order(ends: Ends, case: str) -> None:
    for start, end in (ends, ends[::-1]):
        for sent, arrived in carried(start, end, samples(case)):
            assert same_datagram(arrived, turned(sent)), sent.payload
        assert end.waiting() == {}


def test_the_books_of_both_balance_and_nothing_was_lost(ends: Ends) -> None:
    """Last in this module."""
    for place in ends:
        counts = place.scrape()
        balance(counts, {source for source in labels_of(counts, "messages_received", "source") if "/" in source})
        assert total(counts, "messages_dropped") == total(counts, "datagrams_rejected") == 0
        assert total(counts, "kernel_drops") == 0
