"""What becomes of a message outside of generated code is counted and reported as generated code would."""

from __future__ import annotations

import errno

import pytest

from router.compiler.metrics import DROP_REASONS
from router.errors import MappingError, NonFiniteError
from tests.engine.fakes import Destination, Topic


def test_a_datagram_counts_with_its_bytes() -> None:
    destination = Destination()
    destination.outcome.delivered(12)
    destination.outcome.delivered(30)
    assert destination.counted() == {"datagrams_sent": 2, "sent_bytes": 42}
    assert destination.reports == []


def test_a_message_counts_once() -> None:
    topic = Topic()
    topic.outcome.delivered(12)
    topic.outcome.filtered()
    topic.outcome.collected()
    assert topic.counted() == {"messages_published": 1, "messages_filtered": 1, "messages_collected": 1}


@pytest.mark.parametrize("reason", [reason for reason in DROP_REASONS if reason != "rate_limited"])
def test_a_loss_is_counted_and_reported(reason: str) -> None:
    destination = Destination()
    destination.outcome.dropped(reason, detail="the second one")
    assert destination.counted() == {reason: 1}
    [report] = destination.reports
    assert (report.kind, report.place, report.target) == ("drop", destination.route, destination.name)
    assert (report.reason, report.detail) == (reason, "the second one")


def test_what_the_table_asks_for_is_not_reported() -> None:
    destination = Destination()
    destination.outcome.dropped("rate_limited")
    assert destination.counted() == {"rate_limited": 1}
    assert destination.reports == []


@pytest.mark.parametrize(
    ("error", "of_a_destination", "of_a_topic"),
    [
        (NonFiniteError(), "non_finite", "non_finite"),
        (MappingError(), "mapping_error", "mapping_error"),
        (ZeroDivisionError(), "mapping_error", "mapping_error"),
        (OSError(errno.ENOBUFS, "no room"), "send_buffer_full", "publish_error"),
        (ConnectionRefusedError(errno.ECONNREFUSED, "nobody there"), "send_error", "publish_error"),
    ],
)
def test_an_error_tells_the_reason(error: Exception, of_a_destination: str, of_a_topic: str) -> None:
    for target, reason in ((Destination(), of_a_destination), (Topic(), of_a_topic)):
        target.outcome.failed(error)
        assert target.counted() == {reason: 1}
        assert target.reports[0].error is error
