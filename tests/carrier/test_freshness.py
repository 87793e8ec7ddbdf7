"""The carrier tells the age of a message and limits rates as Python does."""

from __future__ import annotations

import ctypes

from hypothesis import given
from hypothesis import strategies as st

from router.carrier import structures as c
from router.engine.freshness import MEMORY, TOLERANCE, Born, Freshness
from router.engine.pacing import RateLimit

_MOST_BYTES = 4096
"""More than `struct freshness` has."""

near = st.integers(-3, 3)
spans = st.one_of(
    near,
    st.builds(lambda times, off: times * TOLERANCE // 2 + off, st.integers(-3, 3), near),
    st.builds(lambda times, off: times * MEMORY // 8 + off, st.integers(-20, 20), near),
    st.integers(-(10**18), 10**18),
)


class Native:
    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._structure = ctypes.create_string_buffer(_MOST_BYTES)

    def look(self, received_at: int, now: int) -> None:
        self._library.freshness_look(self._structure, received_at, now)

    def born(self, stamp: int, received_at: int, now: int, not_before: int | None = None) -> Born:
        known = -(1 << 63) if not_before is None else not_before
        found = self._library.freshness_born(self._structure, stamp, received_at, now, known)
        return Born(found.oldest, found.youngest)


@given(steps=st.lists(st.tuples(spans.map(abs), spans, st.booleans(), spans, st.none() | spans), max_size=120))
def test_the_age_of_messages_while_the_wall_clock_jumps(
    library: ctypes.CDLL, steps: list[tuple[int, int, bool, int, int | None]]
) -> None:
    """The last of each step is how long before now the message was at most; None: only the clocks are looked at."""
    python, native, now, ahead = Freshness(), Native(library), 10**12, 10**18
    for passed, jump, jumps, age, known in steps:
        now = min(now + passed, 10**18)
        ahead = max(-(10**18), min(ahead + jump * jumps, 2 * 10**18))
        received_at = now + ahead
        if known is None:
            native.look(received_at, now)
            python.look(received_at, now)
            continue
        for not_before in (None, now - known):
            event = received_at - age, received_at, now, not_before
            assert native.born(*event) == python.born(*event)


@given(
    ages=st.lists(st.integers(1, 100).map(lambda ms: ms * 1_000_000), min_size=40, max_size=80),
    age=st.integers(0, 10**10),
)
def test_more_jumps_than_are_remembered(library: ctypes.CDLL, ages: list[int], age: int) -> None:
    python, native, now = Freshness(), Native(library), 10**12
    for number, passed in enumerate(ages):
        now += passed
        received_at = now + number * TOLERANCE
        for stamp in (received_at - passed, received_at - age, now):
            assert native.born(stamp, received_at, now) == python.born(stamp, received_at, now)


@given(
    st.sampled_from([0.3, 1, 7, 50, 333.3, 10**6]), st.lists(st.integers(0, 400), max_size=100), st.integers(0, 10**18)
)
def test_limits_of_rates(seams: ctypes.CDLL, hertz: float, gaps: list[int], began: int) -> None:
    """`gaps` are in percent of the period."""
    python = RateLimit(hertz)
    period = RateLimit.period(hertz)
    native, now = c.Limit(period, period - period // 2, -period), began
    for gap in gaps:
        now += period * gap // 100
        assert seams.seam_limit_passes(ctypes.byref(native), now) == python.may_pass(now)
