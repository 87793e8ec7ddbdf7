"""When datagrams may gather, and for how long. Rates are datagrams per second; nothing here waits."""

from __future__ import annotations

import pytest

from router.net.receiver import FOR_SOCKETS, FOR_SUBSCRIBERS, SAMPLE, Coalescing

LONGEST = 1_000_000
HANDLING = 6e-6
TIMER_LATE = 60e-6


def settled(rate: float, enough: int, longest: int = LONGEST) -> tuple[float, int]:
    """The rest in seconds, and how many datagrams one look gets, of a steady stream; 0 and 1 without rests."""
    coalescing = Coalescing(longest, lambda: enough)
    rest, taken = coalescing.first(round(SAMPLE / rate * 1e9)), 1
    for _ in range(100):
        if not rest:
            return 0.0, 1
        taken = round(rate * (rest + TIMER_LATE) / (1 - rate * HANDLING))
        rest = coalescing.next(taken)
    return rest, taken


@pytest.mark.parametrize("rate", [1, 50, 1000, 2900])
def test_few_datagrams_are_each_taken_at_once(rate: float) -> None:
    assert settled(rate, FOR_SOCKETS) == (0.0, 1)


@pytest.mark.parametrize("rate", [3100, 5000, 20_000])
def test_many_gather_but_no_longer_than_the_listener_allows(rate: float) -> None:
    rest, taken = settled(rate, FOR_SOCKETS)
    assert 0 < rest <= LONGEST / 1e9
    assert taken >= 3


@pytest.mark.parametrize(("enough", "rate"), [(FOR_SUBSCRIBERS, 15_000), (FOR_SOCKETS, 70_000), (FOR_SOCKETS, 80_000)])
def test_about_as_many_gather_as_are_enough(enough: int, rate: float) -> None:
    rest, taken = settled(rate, enough)
    assert rest < LONGEST / 1e9
    assert abs(taken - enough) <= enough / 4


def test_a_rest_too_short_to_save_anything_is_none() -> None:
    assert settled(100_000, FOR_SUBSCRIBERS) == (0.0, 1)


def test_what_is_enough_is_asked_each_time() -> None:
    enough = FOR_SOCKETS
    coalescing = Coalescing(LONGEST, lambda: enough)
    coalescing.first(round(SAMPLE / 80_000 * 1e9))
    alone = coalescing.next(FOR_SOCKETS)
    enough = FOR_SOCKETS // 2
    assert coalescing.next(FOR_SOCKETS) == pytest.approx(alone / 2)


@pytest.mark.parametrize("taken", [0, 1])
def test_rests_end_when_hardly_anything_comes(taken: int) -> None:
    coalescing = Coalescing(LONGEST, lambda: FOR_SOCKETS)
    assert coalescing.first(round(SAMPLE / 20_000 * 1e9)) > 0
    assert coalescing.next(taken) == 0.0


@pytest.mark.parametrize("rate", [1, 3100, 100_000, 1e9])
def test_never_is_never(rate: float) -> None:
    assert settled(rate, FOR_SOCKETS, longest=0) == (0.0, 1)
