"""An endpoint's budget is kept and used up; when it is short, the urgent goes first and the least urgent is dropped."""

from __future__ import annotations

import ctypes
import errno
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.declared import MAX_DATAGRAM
from router.table.model.targets import Priority
from tests.carrier.deferring import Deferring
from tests.oracles.held_back import BURST, LEAST_OVERDRAFT, LEAST_ROOM, NS, OVERDRAFT, Message, Pacer

COMMAND, TELEMETRY, BULK = Priority
MS = 1_000_000
RANKS = (COMMAND, TELEMETRY, BULK)


class Link:
    """A pacer and what it sent: when, and which datagram. Each is a target of its own, so its fate is known."""

    def __init__(self, deferring: Deferring) -> None:
        self.deferring = deferring
        self.sent: list[tuple[int, int]] = []
        self.bytes_sent = 0
        self._count = 0

    @property
    def now(self) -> int:
        return self.deferring.now

    def offer(self, priority: Priority, size: int = 100, expires: int | None = None) -> int:
        """Return the datagram's number: they count from 0."""
        target = self.deferring.target(None, priority)
        self.deferring.offer(target, bytes(size), expires, is_written=True)
        self._collect()
        return target

    def wait(self, until: int) -> None:
        """Serve the pacer in time."""
        self.deferring.wait(until)
        self._collect()

    def _collect(self) -> None:
        for at, number, data in self.deferring.taken():
            self.sent.append((at, number))
            self.bytes_sent += len(data)

    @property
    def numbers(self) -> list[int]:
        return [number for _, number in self.sent]

    def fate(self, number: int) -> str | None:
        """None while it waits."""
        return next(iter(self.deferring.counted(number)), None)


Open = Callable[[int], Deferring]


@pytest.fixture
def opened(library: ctypes.CDLL, deferring: ctypes.CDLL) -> Iterator[Open]:
    """Opens groups with a bandwidth, one after the other."""
    groups: list[Deferring] = []

    def open_next(bandwidth: int) -> Deferring:
        close()
        groups.append(Deferring(library, deferring, bandwidth))
        return groups[-1]

    def close() -> None:
        while groups:
            groups.pop().close()

    yield open_next
    close()


@pytest.fixture
def link(opened: Open) -> Callable[[int], Link]:
    return lambda bandwidth: Link(opened(bandwidth))


# ---- the rate


def measured(group: Deferring, size: int, hertz: float, priority: Priority, late: int) -> int:
    """The bytes that were sent in 10 s. The thread serves `late` ns behind."""
    target, sent, datagram = group.target(None, priority), 0, bytes(size)
    for now in [*range(0, 10 * NS, round(NS / hertz)), 10 * NS]:
        while (due := group.next_due) is not None and due + late <= now:
            group.set(max(due + late, group.now))
            group.serve()
        group.set(now)
        if now < 10 * NS:
            group.offer(target, datagram)
        sent += sum(len(each.data) for each in group.taken())
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
    opened: Open, budget: int, size: int, load: float, priority: Priority
) -> None:
    sent = measured(opened(budget), size, budget * load / size, priority, late=0)
    overdraft = max(budget // 10, 2048) if priority is COMMAND else 0
    assert sent <= 10 * budget + budget * BURST // NS + (overdraft + size if overdraft else 0)
    assert sent >= min(load, 0.99) * 10 * budget - size


def test_a_thread_that_is_late_by_half_a_burst_costs_nothing(opened: Open) -> None:
    assert measured(opened(500_000), 100, 10_000, BULK, late=BURST // 2) >= 0.99 * 10 * 500_000


def test_the_longest_datagram_goes_through_the_smallest_budget_and_pays_before(link: Callable[[int], Link]) -> None:
    slow = link(1000)
    slow.offer(BULK, MAX_DATAGRAM)
    slow.offer(BULK, 20)
    slow.wait(70 * NS)
    assert slow.numbers == [0, 1]
    assert MAX_DATAGRAM * MS - BURST <= slow.sent[0][0] <= MAX_DATAGRAM * MS
    assert 0 < slow.sent[1][0] - slow.sent[0][0] <= BURST


# ---- who goes first


def test_with_a_small_budget_two_kilobytes_of_commands_go_ahead(link: Callable[[int], Link]) -> None:
    slow = link(1000)
    slow.offer(BULK)
    for _ in range(50):
        slow.offer(COMMAND)
    assert slow.bytes_sent == 2100


def test_at_the_end_all_that_waits_and_is_fresh_goes_by_priority(link: Callable[[int], Link]) -> None:
    slow = link(10_000)
    slow.offer(BULK, 5000)
    bulk, stale, telemetry = slow.offer(BULK), slow.offer(BULK, expires=0), slow.offer(TELEMETRY)
    slow.deferring.set(MS)
    slow.deferring.end_pacer()
    slow.wait(MS)
    assert slow.numbers == [telemetry, 0, bulk]
    assert slow.fate(stale) == "stale"
    assert slow.deferring.next_due is None


def test_what_waits_for_a_target_that_is_gone_goes_at_once_and_the_rest_stays(link: Callable[[int], Link]) -> None:
    slow = link(10_000)
    first, gone, last = (slow.offer(BULK, 5000) for _ in range(3))
    command = slow.deferring.target(None, COMMAND)
    slow.deferring.end(gone)
    slow.wait(0)
    assert slow.numbers == [gone]
    slow.deferring.offer(gone, bytes(9000), is_written=True)  # of a thread that is one message behind
    slow.deferring.offer(command, bytes(100))
    slow.wait(0)
    assert slow.numbers == [gone, gone]  # the budget has to pay for what went at once
    slow.wait(10 * NS)
    assert slow.numbers == [gone, gone, command, first, last]


# ---- what is dropped


def test_so_many_tiny_datagrams_may_wait_that_their_number_is_bounded(opened: Open) -> None:
    slow = opened(1)
    target = slow.target(None, BULK)
    slow.offer(target, bytes(1000))
    for _ in range(LEAST_ROOM // 16 + 10):
        slow.offer(target, b"12")
    assert slow.counted(target) == {"queue_full": 11}


def test_what_gets_too_old_while_it_waits_is_dropped_and_uses_up_nothing(link: Callable[[int], Link]) -> None:
    slow = link(10_000)
    slow.offer(BULK, 2000)
    stale, fresh = slow.offer(BULK, 5000, expires=100 * MS), slow.offer(BULK, expires=NS)
    slow.wait(200 * MS)
    assert slow.fate(stale) == "stale"
    assert slow.sent[-1] == (190 * MS, fresh)


@pytest.mark.parametrize(("late", "fate"), [(0, "sent"), (-1, "stale"), (5 * MS + 500_000, "sent")])
def test_what_the_budget_pays_for_in_time_leaves_in_time(link: Callable[[int], Link], late: int, fate: str) -> None:
    """The budget has paid for the second one after 99.5 ms."""
    slow = link(10_000)
    slow.offer(BULK, 200)
    second = slow.offer(BULK, 995, expires=99 * MS + 500_000 + late)
    slow.wait(NS)
    assert slow.fate(second) == fate
    if fate == "sent":
        assert slow.sent[-1] == (99 * MS + 500_000, second)


def test_what_waits_behind_one_that_never_expires_leaves_in_time(link: Callable[[int], Link]) -> None:
    slow = link(10_000)
    slow.offer(BULK, 200)
    slow.offer(BULK, 500)
    last = slow.offer(BULK, 20, expires=55 * MS)
    slow.wait(NS)
    assert slow.sent[1:] == [(50 * MS, 1), (52 * MS, last)]


def test_what_the_network_refuses_is_counted_and_the_next_is_tried(link: Callable[[int], Link]) -> None:
    refusing = link(100_000)
    refusing.deferring.refuse(errno.ECONNREFUSED)
    refused = refusing.offer(TELEMETRY)
    refusing.deferring.refuse(errno.EAGAIN)
    full = refusing.offer(TELEMETRY)
    refusing.deferring.refuse(0)
    sent = refusing.offer(TELEMETRY)
    assert [refusing.fate(number) for number in (refused, full, sent)] == ["send_error", "send_buffer_full", "sent"]


def test_what_is_too_long_for_a_datagram_is_tried_at_once(link: Callable[[int], Link]) -> None:
    slow = link(1000)
    slow.offer(BULK, 2000)
    slow.deferring.refuse(errno.EMSGSIZE)
    assert slow.fate(slow.offer(BULK, 65_508)) == "send_error"


def test_it_is_not_disturbed_by_being_served_too_early(link: Callable[[int], Link]) -> None:
    slow = link(10_000)
    slow.offer(BULK, 2000)
    slow.offer(BULK, 1000)
    for now in range(0, 179 * MS, 7 * MS):
        slow.deferring.set(now)
        slow.deferring.serve()
    slow.wait(179 * MS)
    assert slow.numbers == []
    slow.wait(NS)
    assert slow.numbers == [0, 1]


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
def test_the_rules_hold_at_every_step(
    library: ctypes.CDLL, deferring: ctypes.CDLL, budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    link, waiting = Link(Deferring(library, deferring, budget)), list[Waiting]()
    for rank, size, fresh_for, pause in messages:
        expires = None if fresh_for is None else link.now + fresh_for
        waiting.append(Waiting(rank, link.offer(RANKS[rank], size, expires), size, expires))
        waiting = still_waiting(link, waiting)
        assert sum(one.size for one in waiting) <= max(budget, LEAST_ROOM)
        until = link.now + pause
        while (due := link.deferring.next_due) is not None and due <= until:
            link.wait(due)
            waiting = still_waiting(link, waiting)
        link.wait(until)
        assert (link.deferring.next_due is None) == (not waiting)
    link.deferring.close()


@given(st.integers(1000, 200_000), st.lists(offers, max_size=40))
def test_a_command_never_waits_for_anything_but_commands(
    library: ctypes.CDLL, deferring: ctypes.CDLL, budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    """`overdrawn` is what commands alone owe, in ns."""
    link, overdrawn, counted_at = Link(Deferring(library, deferring, budget)), 0, 0
    overdraft = max(OVERDRAFT, -(-LEAST_OVERDRAFT * NS // budget))
    commands = dict[int, int]()  # that wait, and what they take
    for rank, size, fresh_for, pause in messages:
        expires = None if fresh_for is None else link.now + fresh_for
        priority, takes = RANKS[rank], -(-size * NS // budget)
        overdrawn, counted_at = max(0, overdrawn - link.now + counted_at), link.now
        may_go = not commands and overdrawn <= overdraft
        number = link.offer(priority, size, expires)
        if priority is COMMAND:
            commands[number] = takes
            assert link.fate(number) == "sent" or not may_go
        until = link.now + pause
        while True:
            for one in [one for one in commands if link.fate(one)]:
                overdrawn += commands.pop(one) if link.fate(one) == "sent" else 0
            if (due := link.deferring.next_due) is None or due > until:
                break
            link.wait(due)
            overdrawn, counted_at = max(0, overdrawn - link.now + counted_at), link.now
        link.wait(until)
    link.deferring.close()


@given(st.integers(1000, 200_000), st.lists(offers, max_size=40))
def test_in_no_time_goes_more_than_the_budget_and_what_was_saved_up_before(
    library: ctypes.CDLL, deferring: ctypes.CDLL, budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    """Without commands, which may overdraw it."""
    link, sizes = Link(Deferring(library, deferring, budget)), []
    for rank, size, fresh_for, pause in messages:
        sizes.append(size)
        link.offer(RANKS[max(rank, 1)], size, None if fresh_for is None else link.now + fresh_for)
        link.wait(link.now + pause)
    for first, (since, _) in enumerate(link.sent):
        sent = 0
        for until, number in link.sent[first:]:
            sent += sizes[number]
            assert sent <= budget * (until - since + BURST) / NS + max(sizes)
    link.deferring.close()


tight = st.tuples(
    st.integers(1, 2),
    st.integers(20, 30),
    st.none() | st.integers(5, 25).map(MS.__mul__),
    st.sampled_from((0, 0, 3 * MS)),
)
"""As `offers`, where many expire about when the budget has paid for them."""


@given(st.integers(5_000, 10_000), st.lists(tight, min_size=10, max_size=40))
def test_what_an_eager_pacer_sends_is_not_dropped_as_stale(
    library: ctypes.CDLL, deferring: ctypes.CDLL, budget: int, messages: list[tuple[int, int, int | None, int]]
) -> None:
    """The oracle sends each datagram as soon as the budget has paid for it."""
    fates: dict[int, str] = {}
    eager = Pacer(budget, lambda _, message, fate: fates.update({message.number: fate}))
    link = Link(Deferring(library, deferring, budget))
    for number, (rank, size, fresh_for, pause) in enumerate([*messages, (2, 10, None, NS)]):
        expires = None if fresh_for is None else link.now + fresh_for
        assert link.offer(RANKS[rank], size, expires) == number
        eager.offer(link.now, Message(number, None, size, expires, rank))
        until = link.now + pause
        while eager.next_due is not None and eager.next_due <= until:
            eager.serve(eager.next_due)
        link.wait(until)
    dropped = [number for number, fate in fates.items() if fate == "sent" and link.fate(number) == "stale"]
    assert dropped == []
    link.deferring.close()


@given(st.integers(1000, 200_000), st.integers(10, MAX_DATAGRAM // 2), st.integers(10, 500), st.integers(5, 90))
def test_nothing_starves_as_long_as_what_goes_before_it_leaves_some_budget(
    library: ctypes.CDLL, deferring: ctypes.CDLL, budget: int, size: int, small: int, percent: int
) -> None:
    group = Deferring(library, deferring, budget)
    bulk, telemetry = group.target(None, BULK), group.target(None, TELEMETRY)
    group.offer(bulk, bytes(size))
    patience = 2 * NS + size * NS * 100 // budget // (100 - percent)
    while not group.counted(bulk) and group.now < patience:
        group.offer(telemetry, bytes(small))
        group.wait(group.now + small * NS * 100 // budget // percent)
    assert next(iter(group.counted(bulk))) == "sent"
    group.close()


def still_waiting(link: Link, waiting: list[Waiting]) -> list[Waiting]:
    """What still waits of what did, after a look at what became of the others."""
    remaining = [one for one in waiting if link.fate(one.number) is None]
    for one in waiting:
        fate = link.fate(one.number)
        if fate == "sent":
            assert one.expires is None or link.now <= one.expires
            assert all(one[:2] < other[:2] for other in remaining)
        elif fate == "stale":
            assert one.expires is not None
            assert link.now > one.expires
        elif fate == "queue_full":
            assert all((-one.rank, one.number) < (-other.rank, other.number) for other in remaining)
    return remaining
