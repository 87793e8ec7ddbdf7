"""`max_rate` is right on average, without bursts, and forgives jitter; as an oracle decides."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable

from hypothesis import given
from hypothesis import strategies as st

from router.carrier.limits import RateLimit
from router.declared import Limit
from router.library import load
from tests.oracles import ages_and_rates as oracle

NS = 1_000_000_000

rates = st.integers(1, 1000) | st.floats(0.5, 1000)


def passed(hertz: float, times: Iterable[int]) -> list[int]:
    limit = RateLimit(load(), hertz)
    return [time for time in times if limit.may_pass(time)]


@given(rates, st.lists(st.floats(0, 3), min_size=1, max_size=200), st.integers(0, 2**62))
def test_in_any_second_at_most_one_more_than_the_rate_passes(hertz: float, gaps: list[float], start: int) -> None:
    """The gaps are in periods: dense, with pauses of up to three."""
    times = []
    for gap in gaps:
        start += round(gap * NS / hertz)
        times.append(start)
    kept = passed(hertz, times)
    most = math.ceil(hertz) + 1
    for first, beyond in zip(kept, kept[most:], strict=False):
        assert beyond - first > NS


@given(st.integers(2, 200), st.floats(1, 20), st.integers(0, 9 * NS))
def test_so_it_is_in_every_second(hertz: int, factor: float, start: int) -> None:
    kept = passed(hertz, range(0, 11 * NS, int(NS / hertz / factor)))
    assert abs(sum(start <= time < start + NS for time in kept) - hertz) <= 1


@given(st.integers(1, 200), st.floats(0, 1), st.lists(st.floats(0, 0.5), min_size=2, max_size=200))
def test_a_stream_not_above_the_rate_passes_whole_with_jitter_up_to_half_a_period(
    hertz: int, slowness: float, delays: list[float]
) -> None:
    period = math.ceil(NS / hertz)
    interval = round(period * (1 + slowness))
    times = [index * interval + int(delay * period) for index, delay in enumerate(delays)]
    assert passed(hertz, times) == times


@given(rates, st.lists(st.floats(0, 3), min_size=1, max_size=50))
def test_it_tells_from_when_on_the_next_may_pass(hertz: float, gaps: list[float]) -> None:
    limit, now = RateLimit(load(), hertz), 0
    for gap in gaps:
        now += round(gap * NS / hertz)
        may = Limit.from_address(limit._at).next_pass <= now
        assert limit.may_pass(now) == may
        assert Limit.from_address(limit._at).next_pass > now


def test_heavy_jitter_at_the_rate_costs_little() -> None:
    noise = random.Random(1)
    times = [round((index + noise.uniform(-0.4, 0.4)) * NS / 50) for index in range(1, 5000)]
    assert len(passed(50, times)) > 0.95 * len(times)


@given(st.lists(st.floats(0.5, 100), min_size=1, max_size=20))
def test_after_a_pause_nothing_was_saved_up(pauses: list[float]) -> None:
    """A message, a pause, then a flood: of it one passes at once and the next half a period later."""
    limit, now = RateLimit(load(), 10), 0
    for pause in pauses:
        limit.may_pass(now)
        now += NS // 10 + round(pause * NS)
        flood = [now + index * 1_000_000 for index in range(100)]
        assert [time - now for time in flood if limit.may_pass(time)] == [0, 50_000_000]
        now = flood[-1]


@given(
    st.sampled_from([0.3, 1, 7, 50, 333.3, 10**6]), st.lists(st.integers(0, 400), max_size=100), st.integers(0, 10**18)
)
def test_it_decides_as_the_oracle(hertz: float, gaps: list[int], began: int) -> None:
    """`gaps` are in percent of the period."""
    plain, native, now = oracle.RateLimit(hertz), RateLimit(load(), hertz), began
    for gap in gaps:
        now += math.ceil(NS / hertz) * gap // 100
        assert native.may_pass(now) == plain.may_pass(now)
