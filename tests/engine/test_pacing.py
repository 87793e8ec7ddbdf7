"""An endpoint's budget is kept and used up; when it is short, the urgent goes first and the least urgent is dropped."""

from __future__ import annotations

import errno
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.table.model import Priority
from router.types.framing import MAX_DATAGRAM
from tests.engine.rig import Destination, play, serve
from tests.oracles.python_engine.pacing import BURST, LEAST_OVERDRAFT, LEAST_QUEUE, NS, OVERDRAFT, Pacer

COMMAND, TELEMETRY, BULK = Priority
MS = 1_000_000


class Link:
    """A pacer and what it sent: when, and which datagram. Each is a target of its own, so its fate is known."""

    def __init__(self, budget: int) -> None:
        self.now = 0
        self.sent: list[tuple[int, int]] = []
        self.bytes_sent = 0
        self.error: OSError | None = None
        self.targets: list[Destination] = []
        self.pacer = Pacer(budget)

    def _send(self, data: bytes, expires: int | None) -> int:
        if self.error is not None:
            raise self.error
        self.sent.append((self.now, int.from_bytes(data, "little")))
        self.bytes_sent += len(data)
        return len(data)

    def offer(self, priority: Priority, size: int = 100, expires: int | None = None) -> int:
        """Returns the datagram's number: they count from 0."""
        number = len(self.targets)
        self.targets.append(Destination())
        deliver = self.pacer.queue(priority, self.targets[-1].outcome, self._send)
        deliver(self.now, number.to_bytes(size, "little"), expires)
        return number

    def wait(self, until: int) -> None:
        """Serves the pacer in time."""
        while self.pacer.next_due is not None and self.pacer.next_due <= until:
            self.now = self.pacer.next_due
            self.pacer.due(self.now)
        self.now = until

    @property
    def numbers(self) -> list[int]:
        return [number for _, number in self.sent]

    def fate(self, number: int) -> str | None:
        """None while it waits."""
        return next(iter(self.targets[number].counted()), None)


# ---- the rate


def measured(budget: int, size: int, hertz: float, priority: Priority, late: int) -> int:
    """The bytes that were sent in 10 s."""
    sent = 0

    def send(data: bytes, expires: int | None) -> int:
        nonlocal sent
        sent += len(data)
        return len(data)

    pacer = Pacer(budget)
    deliver = pacer.queue(priority, Destination().outcome, send)
    datagram = bytes(size)

    def offer(now: int) -> None:
        deliver(now, datagram, None)

    play(pacer, ((now, offer) for now in range(0, 10 * NS, round(NS / hertz))), 10 * NS, late)
    return sent


@pytest.mark.parametrize("priority", Priority)
@pytest.mark.parametrize(
    ("budget", "size", "load"),
    [
        (2_000, 40, 0.99),
        (2_000, 1000, 2),
        (50_000, 40, 2),
        (50_000, 1000, 1.01),
        (500_000, 1000, 0.5),
        (500_000, 400, 2),
    ],
)
def test_over_ten_seconds_the_budget_is_kept_and_used_up(
    budget: int, size: int, load: float, priority: Priority
) -> None:
    hertz = budget * load / size
    sent = measured(budget, size, hertz, priority, late=0)
    overdraft = max(budget // 10, 2048) if priority is COMMAND else 0
    assert sent <= 10 * budget + budget * BURST // NS + (overdraft + size if overdraft else 0)
    assert sent >= min(load, 0.99) * 10 * budget - size


def test_a_timer_thread_that_is_late_by_half_a_burst_costs_nothing() -> None:
    assert measured(500_000, 100, 10_000, BULK, late=BURST // 2) >= 0.99 * 10 * 500_000


def test_after_a_pause_there_is_no_more_than_a_burst() -> None:
    link = Link(100_000)
    link.wait(60 * NS)
    for _ in range(100):
        link.offer(TELEMETRY)
    assert link.bytes_sent == 100_000 * BURST // NS


def test_the_longest_datagram_goes_through_the_smallest_budget_and_pays_before() -> None:
    link = Link(1000)
    link.offer(BULK, MAX_DATAGRAM)
    link.offer(BULK, 20)
    link.wait(70 * NS)
    assert link.numbers == [0, 1]
    assert MAX_DATAGRAM * MS - BURST <= link.sent[0][0] <= MAX_DATAGRAM * MS
    assert 0 < link.sent[1][0] - link.sent[0][0] <= BURST


def test_what_was_saved_up_for_one_that_was_dropped_is_lost() -> None:
    link = Link(10_000)
    link.offer(BULK, 30_000, expires=2 * NS)
    link.wait(2 * NS + 1)
    assert link.fate(0) == "stale"
    for _ in range(100):
        link.offer(TELEMETRY)
    assert link.bytes_sent == 10_000 * BURST // NS


def test_nothing_is_saved_up_for_what_is_too_old() -> None:
    link = Link(10_000)
    link.offer(BULK, 30_000, expires=100 * MS)
    fresh = link.offer(BULK, 1000)
    link.wait(300 * MS)
    assert (link.fate(0), link.fate(fresh)) == ("stale", "datagrams_sent")


# ---- who goes first


def test_commands_wait_for_each_other_when_they_are_too_far_ahead() -> None:
    """They overdraw the budget by 100 ms of it; the others wait until that is paid."""
    link = Link(100_000)
    bulk = [link.offer(BULK) for _ in range(30)]
    commands = [link.offer(COMMAND) for _ in range(200)]
    assert link.numbers == bulk[:20] + commands[:101]
    link.wait(10 * NS)
    assert link.numbers == bulk[:20] + commands + bulk[20:]


def test_with_a_small_budget_two_kilobytes_of_commands_go_ahead() -> None:
    link = Link(1000)
    link.offer(BULK)
    for _ in range(50):
        link.offer(COMMAND)
    assert link.bytes_sent == 2100


def test_at_the_end_all_that_waits_and_is_fresh_goes_by_priority() -> None:
    link = Link(10_000)
    link.offer(BULK, 5000)
    bulk, stale, telemetry = link.offer(BULK), link.offer(BULK, expires=0), link.offer(TELEMETRY)
    link.now = MS
    link.pacer.end(MS)
    assert link.numbers == [telemetry, 0, bulk]
    assert link.fate(stale) == "stale"
    assert link.pacer.next_due is None


# ---- what is dropped


def test_the_oldest_of_the_least_urgent_is_dropped_when_there_is_no_room() -> None:
    link = Link(1000)
    link.offer(BULK, MAX_DATAGRAM)
    oldest, newest = link.offer(BULK, 1000), link.offer(BULK, 1000)
    telemetry = [link.offer(TELEMETRY, 1000) for _ in range(LEAST_QUEUE // 1000)]
    assert link.fate(oldest) == link.fate(newest) == "queue_full"
    assert [link.fate(number) for number in telemetry] == [None] * len(telemetry)

    late = link.offer(BULK, 1000)
    assert link.fate(late) == "queue_full"
    link.offer(TELEMETRY, 1000)
    assert link.fate(telemetry[0]) == "queue_full"
    assert link.fate(telemetry[1]) is None
    assert [report.reason for report in link.targets[oldest].reports] == ["queue_full"]


def test_what_gets_too_old_while_it_waits_is_dropped_and_uses_up_nothing() -> None:
    link = Link(10_000)
    link.offer(BULK, 2000)
    stale, fresh = link.offer(BULK, 5000, expires=100 * MS), link.offer(BULK, expires=NS)
    link.wait(200 * MS)
    assert link.fate(stale) == "stale"
    assert link.sent[-1] == (190 * MS, fresh)


def test_what_the_network_refuses_is_counted_and_the_next_is_tried() -> None:
    link = Link(100_000)
    link.error = ConnectionRefusedError(errno.ECONNREFUSED, "nobody there")
    refused = link.offer(TELEMETRY)
    link.error = BlockingIOError(errno.EAGAIN, "full")
    full = link.offer(TELEMETRY)
    link.error = None
    sent = link.offer(TELEMETRY)
    assert [link.fate(number) for number in (refused, full, sent)] == [
        "send_error",
        "send_buffer_full",
        "datagrams_sent",
    ]
    assert link.targets[refused].reports[0].error is not None


# ---- all together

offers = st.tuples(
    st.integers(0, 2), st.integers(10, 30_000), st.none() | st.integers(0, NS), st.just(0) | st.integers(0, NS)
)
"""The priority's place in their order, size, time until stale, time until the next (ns)."""


class Waiting(NamedTuple):
    rank: int
    number: int
    size: int
    expires: int | None


@given(st.integers(1000, 200_000), st.lists(offers, max_size=40))
def test_the_rules_hold_at_every_step(budget: int, messages: list[tuple[int, int, int | None, int]]) -> None:
    link, waiting = Link(budget), list[Waiting]()
    for rank, size, fresh_for, pause in messages:
        expires = None if fresh_for is None else link.now + fresh_for
        waiting.append(Waiting(rank, link.offer([*Priority][rank], size, expires), size, expires))
        waiting = still_waiting(link, waiting)
        assert sum(one.size for one in waiting) <= max(budget, LEAST_QUEUE)
        until = link.now + pause
        while link.pacer.next_due is not None and link.pacer.next_due <= until:
            link.wait(link.pacer.next_due)
            waiting = still_waiting(link, waiting)
        link.now = until
        assert (link.pacer.next_due is None) == (not waiting)


@given(st.integers(1000, 200_000), st.lists(offers, max_size=40))
def test_a_command_never_waits_for_anything_but_commands(
    budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    """`overdrawn` is what commands alone owe, in ns."""
    link, overdrawn, counted_at = Link(budget), 0, 0
    overdraft = max(OVERDRAFT, -(-LEAST_OVERDRAFT * NS // budget))
    commands = dict[int, int]()  # that wait, and what they take
    for rank, size, fresh_for, pause in messages:
        expires = None if fresh_for is None else link.now + fresh_for
        priority, takes = [*Priority][rank], -(-size * NS // budget)
        overdrawn, counted_at = max(0, overdrawn - link.now + counted_at), link.now
        may_go = not commands and overdrawn <= overdraft
        number = link.offer(priority, size, expires)
        if priority is COMMAND:
            commands[number] = takes
            assert link.fate(number) == "datagrams_sent" or not may_go
        until = link.now + pause
        while True:
            for one in [one for one in commands if link.fate(one)]:
                overdrawn += commands.pop(one) if link.fate(one) == "datagrams_sent" else 0
            if link.pacer.next_due is None or link.pacer.next_due > until:
                break
            link.wait(link.pacer.next_due)
            overdrawn, counted_at = max(0, overdrawn - link.now + counted_at), link.now
        link.now = until


@given(st.integers(1000, 200_000), st.lists(offers, max_size=40))
def test_in_no_time_goes_more_than_the_budget_and_what_was_saved_up_before(
    budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    """Without commands, which may overdraw it."""
    link, sizes = Link(budget), []
    for rank, size, fresh_for, pause in messages:
        sizes.append(size)
        link.offer([*Priority][max(rank, 1)], size, None if fresh_for is None else link.now + fresh_for)
        link.wait(link.now + pause)
    for first, (since, _) in enumerate(link.sent):
        sent = 0
        for until, number in link.sent[first:]:
            sent += sizes[number]
            assert sent <= budget * (until - since + BURST) / NS + max(sizes)


@given(st.integers(1000, 200_000), st.integers(10, MAX_DATAGRAM // 2), st.integers(10, 500), st.integers(5, 90))
def test_nothing_starves_as_long_as_what_goes_before_it_leaves_some_budget(
    budget: int, size: int, small: int, percent: int
) -> None:
    link = Link(budget)
    bulk = link.offer(BULK, size)
    patience = 2 * NS + size * NS * 100 // budget // (100 - percent)
    while link.fate(bulk) is None and link.now < patience:
        link.offer(TELEMETRY, small)
        link.wait(link.now + small * NS * 100 // budget // percent)
    assert link.fate(bulk) == "datagrams_sent"


def still_waiting(link: Link, waiting: list[Waiting]) -> list[Waiting]:
    """What still waits of what did, after a look at what became of the others."""
    remaining = [one for one in waiting if link.fate(one.number) is None]
    for one in waiting:
        fate = link.fate(one.number)
        if fate == "datagrams_sent":
            assert one.expires is None or link.now <= one.expires
            assert all(one[:2] < other[:2] for other in remaining)
        elif fate == "stale":
            assert one.expires is not None
            assert link.now > one.expires
        elif fate == "queue_full":
            assert all((-one.rank, one.number) < (-other.rank, other.number) for other in remaining)
    return remaining


def test_it_is_not_disturbed_by_being_called_too_early() -> None:
    link = Link(10_000)
    link.offer(BULK, 2000)
    link.offer(BULK, 1000)
    for now in range(0, 180 * MS, 7 * MS):
        link.pacer.due(now)
    assert link.numbers == []
    serve(link.pacer, NS)
    assert link.numbers == [0, 1]
