"""What is held back fares as an oracle says, whatever is offered, served, reloaded and ended."""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.carrier.building import MEMORY, RACES, run_program
from tests.carrier.deferring import Deferring
from tests.carrier.test_pacing import RANKS
from tests.oracles.held_back import Deferral, Message, Pacer

NS, MS = 1_000_000_000, 1_000_000


class Target(NamedTuple):
    """`hertz` of `on_limit: latest`, None without; `rank` of its priority."""

    hertz: int | None
    rank: int


class Offer(NamedTuple):
    target: int
    size: int
    fresh_for: int | None
    is_written: bool


class Wait(NamedTuple):
    """Let time pass, and serve what is due, all of it at the end if the thread was late."""

    ns: int
    is_late: bool


class Change(NamedTuple):
    """A reload that keeps a target, with another rate perhaps."""

    target: int
    hertz: int | None


class End(NamedTuple):
    """A reload that drops a target."""

    target: int


Event = Offer | Wait | Change | End
TARGETS, EVENTS = 3, 200
RATES = st.none() | st.integers(1, 200)
targets = st.lists(st.builds(Target, RATES, st.integers(0, 2)), min_size=TARGETS, max_size=TARGETS)
offers = st.builds(
    Offer,
    st.integers(0, TARGETS - 1),
    st.integers(4, 60) | st.integers(4, 16_000),
    st.none() | st.integers(0, 50 * MS) | st.integers(0, 2 * NS),
    st.booleans(),
)
waits = st.builds(Wait, st.integers(0, 40 * MS) | st.integers(0, NS), st.booleans())
reloads = st.builds(Change, st.integers(0, TARGETS - 1), RATES) | st.builds(End, st.integers(0, TARGETS - 1))
histories = st.lists(offers | offers | offers | waits | waits | reloads, max_size=60)


def history_of(noise: Random) -> list[Event]:
    """One that is longer and busier than those that Hypothesis makes."""
    events: list[Event] = []
    for _ in range(EVENTS):
        target, kind = noise.randrange(TARGETS), noise.random()
        if kind < 0.6:
            size = noise.choice((noise.randrange(4, 60), noise.randrange(4, 2000), noise.randrange(4, 16_000)))
            fresh_for = noise.choice((None, noise.randrange(50 * MS), noise.randrange(2 * NS)))
            events.append(Offer(target, size, fresh_for, noise.random() < 0.5))
        elif kind < 0.99:
            events.append(Wait(noise.choice((noise.randrange(20 * MS), noise.randrange(NS))), noise.random() < 0.3))
        else:
            rate = noise.choice((None, noise.randrange(1, 200)))
            events.append(Change(target, rate) if noise.random() < 0.9 else End(target))
    return events


class Model:
    """The oracle's targets. `left` is when which message left, `fates` how often what became of one."""

    def __init__(self, targets: Sequence[Target], bandwidth: int | None) -> None:
        self.now = 0
        self.left: list[tuple[int, int]] = []
        self.fates = Counter[str]()
        self._pacer = Pacer(bandwidth, self._fate) if bandwidth else None
        self._ranks = [each.rank for each in targets]
        self._deferrals = [Deferral(each.hertz, self._pacer, self._fate) for each in targets]
        # A group serves first what was added last.
        self._timers: list[Deferral | Pacer] = [*reversed(self._deferrals), *filter(None, [self._pacer])]

    def _fate(self, now: int, message: Message, fate: str) -> None:
        self.fates[fate] += 1
        if fate == "sent":
            self.left.append((now, message.number))

    def offer(self, number: int, offer: Offer) -> None:
        expires = None if offer.fresh_for is None else self.now + offer.fresh_for
        message = Message(number, offer.target, offer.size, expires, self._ranks[offer.target])
        self._deferrals[offer.target].offer(self.now, message)

    def wait(self, wait: Wait) -> None:
        until = self.now + wait.ns
        if wait.is_late:
            self.now = until
        while (due := self.next_due) is not None and due <= until:
            self.now = max(self.now, due)
            for each in self._timers:
                if each.next_due is not None and each.next_due <= self.now:
                    each.serve(self.now)
        self.now = until

    @property
    def next_due(self) -> int | None:
        return min((each.next_due for each in self._timers if each.next_due is not None), default=None)

    def change(self, change: Change) -> None:
        deferral = self._deferrals[change.target]
        if not deferral.has_ended:
            deferral.change(self.now, change.hertz)

    def end(self, end: End) -> None:
        self._deferrals[end.target].end(self.now)
        if self._pacer is not None:
            self._pacer.release(self.now, lambda message: message.target == end.target)


def carried(
    group: Deferring, targets: Sequence[Target], history: Sequence[Event]
) -> tuple[list[tuple[int, int]], Counter[str]]:
    """What leaves, and what was counted."""
    now = [group.target(each.hertz, RANKS[each.rank]) for each in targets]
    known, ended = set(now), set[int]()
    for number, event in enumerate(history):
        if isinstance(event, Offer):
            expires = None if event.fresh_for is None else group.now + event.fresh_for
            data = number.to_bytes(4, "little").ljust(event.size, b"\0")
            group.offer(now[event.target], data, expires, is_written=event.is_written)
        elif isinstance(event, Wait):
            until = group.now + event.ns
            if event.is_late:
                group.set(until)
            group.wait(until)
        elif event.target not in ended and isinstance(event, Change):
            now[event.target] = group.change(now[event.target], event.hertz, RANKS[targets[event.target].rank])
            known.add(now[event.target])
        elif event.target not in ended:
            ended.add(event.target)
            group.end(now[event.target])
    left = [(each.at, int.from_bytes(each.data[:4], "little")) for each in group.taken()]
    counted = Counter[str]()
    for target in known:
        counted += Counter(group.counted(target))
    del counted["bytes"]
    return left, counted


def expected(
    targets: Sequence[Target], bandwidth: int | None, history: Sequence[Event]
) -> tuple[list[tuple[int, int]], Counter[str]]:
    model = Model(targets, bandwidth)
    for number, event in enumerate(history):
        if isinstance(event, Offer):
            model.offer(number, event)
        elif isinstance(event, Wait):
            model.wait(event)
        elif isinstance(event, Change):
            model.change(event)
        else:
            model.end(event)
    return model.left, model.fates


@pytest.mark.parametrize("count", [100, pytest.param(5_000, marks=pytest.mark.slow)])
def test_long_histories_have_the_outcome_that_the_oracle_says(
    library: ctypes.CDLL, deferring: ctypes.CDLL, count: int
) -> None:
    fates = Counter[str]()
    for seed in range(count):
        noise = Random(seed)
        made = [Target(noise.choice((None, noise.randrange(1, 200))), noise.randrange(3)) for _ in range(TARGETS)]
        bandwidth, history = noise.choice((None, 500, 5_000, 50_000)), history_of(noise)
        group = Deferring(library, deferring, bandwidth)
        found, right = carried(group, made, history), expected(made, bandwidth, history)
        group.close()
        assert found == right, f"seed {seed}"
        fates += found[1]
    assert fates.keys() == {"sent", "stale", "rate_limited", "queue_full"}


@given(targets, st.none() | st.integers(500, 200_000), histories)
def test_what_leaves_and_what_is_counted_is_what_the_oracle_says(
    library: ctypes.CDLL, deferring: ctypes.CDLL, targets: list[Target], bandwidth: int | None, history: list[Event]
) -> None:
    group = Deferring(library, deferring, bandwidth)
    try:
        assert carried(group, targets, history) == expected(targets, bandwidth, history)
    finally:
        group.close()


@pytest.mark.parametrize(
    "sanitizers", ["", pytest.param(RACES, marks=pytest.mark.slow), pytest.param(MEMORY, marks=pytest.mark.slow)]
)
def test_threads_offer_and_serve_while_programs_change(tmp_path: Path, sanitizers: str) -> None:
    run_program("holding", tmp_path, 20_000 if sanitizers else 5_000, sanitizers=sanitizers)
