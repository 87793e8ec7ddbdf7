"""The age of a message is that of the boot clock, whatever is done to the wall clock meanwhile."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from router.carrier.limits import Freshness, TimeRange
from router.library import load
from tests.oracles import ages_and_rates as oracle
from tests.oracles.ages_and_rates import MEMORY, TOLERANCE

MS = 1_000_000
SECOND = 1000 * MS
HOUR = 3600 * SECOND
JUMPS = [sign * size for sign in (1, -1) for size in (50 * MS, SECOND, 2 * SECOND, HOUR, 24 * 365 * 50 * HOUR)]


class Looked(Freshness):
    """With what only native threads do."""

    def __init__(self, library: ctypes.CDLL) -> None:
        super().__init__(library)
        self._look = library.freshness_look

    def look(self, received_at: int, now: int) -> None:
        self._look(self._at, received_at, now)

    def forget_past(self) -> None:
        self._structure.count = 0

    @property
    def remembered(self) -> int:
        return int(self._structure.count)


@dataclass
class Computer:
    """Two clocks. `settings` has since when the wall clock is by how much ahead of the boot clock."""

    slew: float = 0.0
    now: int = 10_000 * SECOND
    freshness: Looked = field(default_factory=lambda: Looked(load()))
    settings: list[tuple[int, int]] = field(default_factory=lambda: [(-SECOND, 1_700_000_000 * SECOND)])

    def ahead(self, time: int) -> int:
        return self.setting(time) + round(self.slew * time)

    def setting(self, time: int) -> int:
        return [offset for since, offset in self.settings if since <= time][-1]

    def settings_since(self, time: int) -> list[int]:
        return [self.setting(time)] + [offset for since, offset in self.settings if since > time]

    def wall(self, time: int) -> int:
        return time + self.ahead(time)

    def jump(self, by: int) -> None:
        self.settings.append((self.now, self.settings[-1][1] + by))

    def youngest(self, event: int) -> int:
        """The youngest reading of a message that was stamped at `event` and is looked at now."""
        return self.readings(event).youngest

    def readings(self, event: int, not_before: int | None = None) -> TimeRange:
        return self.freshness.times(self.wall(event), self.wall(self.now), self.now, not_before)

    def find_empty(self) -> None:
        """As the receive thread when there is nothing to receive."""
        self.freshness.forget_past()
        self.freshness.look(self.wall(self.now), self.now)

    def command_for(self, duration: int, rate: int = 50) -> None:
        """Fresh commands, each of them found to be so."""
        for _ in range(duration * rate // SECOND):
            self.now += SECOND // rate
            assert abs(self.youngest(self.now - 5 * MS) - (self.now - 5 * MS)) <= TOLERANCE


def test_without_jumps_the_age_is_exact() -> None:
    computer = Computer()
    for age in (0, 1, MS, HOUR, 2 * MS):
        computer.now += SECOND
        assert computer.youngest(computer.now - age) == computer.now - age


@pytest.mark.parametrize("jump", JUMPS)
def test_a_jump_leaves_fresh_commands_fresh(jump: int) -> None:
    computer = Computer()
    computer.command_for(3 * SECOND)
    computer.jump(jump)
    computer.command_for(3 * SECOND)


@pytest.mark.parametrize("jump", JUMPS)
def test_a_command_that_was_on_its_way_during_a_jump_stays_fresh(jump: int) -> None:
    computer = Computer()
    computer.command_for(SECOND)
    event = computer.now
    computer.jump(jump)
    computer.now += 10 * MS
    assert abs(computer.youngest(event) - event) <= TOLERANCE


@pytest.mark.parametrize("jump", [jump for jump in JUMPS if jump not in (-2 * SECOND, -SECOND, -50 * MS)])
def test_commands_that_waited_for_2_s_are_stale_although_the_clock_was_set_meanwhile(jump: int) -> None:
    """As when the router is stopped for 2 s: its next look at the clocks is when it takes the first of them."""
    computer = Computer()
    computer.command_for(SECOND)
    first = computer.now
    computer.now += SECOND
    computer.jump(jump)
    computer.now += SECOND
    for event in range(first, computer.now - SECOND, 20 * MS):
        assert abs(computer.youngest(event) - event) <= TOLERANCE


@pytest.mark.parametrize("jump", JUMPS)
def test_a_jump_of_before_makes_no_stale_command_fresh(jump: int) -> None:
    computer = Computer()
    computer.command_for(SECOND)
    computer.jump(jump)
    computer.command_for(3 * SECOND)
    assert computer.youngest(computer.now - 2 * SECOND) == computer.now - 2 * SECOND
    computer.now += HOUR
    assert computer.youngest(computer.now - 2 * SECOND) == computer.now - 2 * SECOND


def test_a_setting_that_the_stamp_cannot_be_of_is_not_considered() -> None:
    """Set back by 2 s; 0.4 s later comes a stamp of 2.5 s before. Under the new setting that is half a second old."""
    computer = Computer()
    computer.command_for(5 * SECOND)
    computer.jump(-2 * SECOND)
    computer.command_for(400 * MS)
    assert abs(computer.youngest(computer.now - 2500 * MS) - (computer.now - 2500 * MS)) <= TOLERANCE


def test_a_stamp_from_before_everything_that_is_remembered_is_stale() -> None:
    computer = Computer()
    start = computer.now
    for _ in range(3):
        computer.command_for(11 * SECOND)
        computer.jump(SECOND)
    computer.command_for(SECOND)
    assert computer.youngest(start - HOUR) < start


def test_the_clock_of_a_computer_that_is_ahead_counts_as_now() -> None:
    computer = Computer()
    assert computer.youngest(computer.now + SECOND) == computer.now
    computer.command_for(SECOND)
    assert computer.youngest(computer.now + HOUR) == computer.now


def test_a_pause_between_reading_the_clocks_is_no_lasting_jump() -> None:
    computer = Computer()
    computer.command_for(SECOND)
    read, computer.now = computer.now, computer.now + 2 * SECOND
    assert computer.freshness.times(computer.wall(read), computer.wall(computer.now), read).youngest == read
    computer.command_for(SECOND)


def test_settings_are_remembered_within_bounds() -> None:
    computer = Computer()
    for _ in range(1_000):
        computer.now += MS
        computer.jump(SECOND)
        computer.youngest(computer.now)
    assert computer.freshness.remembered < 100
    computer.now += MEMORY + 1
    computer.youngest(computer.now)
    assert computer.freshness.remembered == 0


@pytest.mark.parametrize("jump", [*JUMPS, -3 * SECOND, 3 * SECOND])
def test_what_waited_for_3_s_is_stale_by_its_oldest_reading_whatever_was_done_to_the_clock(jump: int) -> None:
    """As when the router is stopped for 3 s, and the clock is set meanwhile: also by just these 3 s."""
    for share in (0, 1, 2, 3):
        computer = Computer()
        computer.command_for(5 * SECOND)
        first = computer.now
        computer.now += share * SECOND
        computer.jump(jump)
        computer.now += (3 - share) * SECOND
        not_before = None
        for event in range(first, computer.now - 200 * MS, 20 * MS):
            alone, in_order = computer.readings(event).oldest, computer.readings(event, not_before).oldest
            assert alone <= event + TOLERANCE
            assert in_order <= event + TOLERANCE
            not_before = in_order


@pytest.mark.parametrize("jump", JUMPS)
def test_messages_that_are_in_order_are_never_taken_for_older_than_they_are(jump: int) -> None:
    """As those of a ROS publisher: each is known not to be older than the one before."""
    computer = Computer()
    computer.command_for(5 * SECOND)
    not_before = computer.readings(computer.now).oldest
    computer.jump(jump)
    for _ in range(250):
        computer.now += 20 * MS
        event = computer.now - 5 * MS
        not_before = computer.readings(event, not_before).oldest
        assert abs(not_before - event) <= 2 * TOLERANCE


@pytest.mark.parametrize("jump", JUMPS)
def test_what_comes_after_nothing_was_waiting_is_never_taken_for_older_than_it_is(jump: int) -> None:
    """As datagrams: when none is waiting, those that come later were stamped later."""
    computer = Computer()
    computer.command_for(5 * SECOND)
    computer.jump(jump)
    computer.now += 30 * MS
    computer.find_empty()  # here the jump is seen
    computer.find_empty()
    for _ in range(250):
        computer.now += 20 * MS
        event = computer.now - 5 * MS
        assert computer.readings(event) == (event, event)


def test_a_fresh_message_of_which_nothing_else_is_known_may_be_old_for_as_long_as_the_clock_was_set_back() -> None:
    computer = Computer()
    computer.command_for(5 * SECOND)
    computer.jump(-2 * SECOND)
    since, refused_until = computer.now, 0
    for _ in range(250):
        computer.now += 20 * MS
        if computer.readings(computer.now).oldest < computer.now - TOLERANCE:
            refused_until = computer.now
    assert abs(since + 2 * SECOND - refused_until) <= 20 * MS + TOLERANCE


jumps = st.just(0) | st.sampled_from(JUMPS) | st.integers(-5 * SECOND, 5 * SECOND) | st.integers(-50 * HOUR, 50 * HOUR)
turns = st.lists(
    st.tuples(st.integers(0, 3 * SECOND), jumps, st.floats(0, 1), st.integers(0, 12 * SECOND)), max_size=25
)


@given(turns, st.floats(-0.0005, 0.0005))
def test_with_any_jumps_the_truth_or_what_a_jump_at_that_time_made_of_it_is_found(
    turns: list[tuple[int, int, float, int]], slew: float
) -> None:
    """Between two messages passes a gap, in which the clock may be set once; each comes after a delay of its own."""
    computer = Computer(slew)
    looks = [computer.now]
    computer.youngest(computer.now)
    for gap, jump, share, delay in turns:
        before = round(gap * share)
        computer.now += before
        computer.jump(jump)
        computer.now += gap - before
        event = computer.now - delay
        oldest, found = computer.readings(event)
        assert oldest <= found <= computer.now
        if delay <= MEMORY:
            assert oldest <= event + TOLERANCE
            last_look = max((look for look in looks if look < event), default=0)
            errors = [computer.setting(event) - offset for offset in computer.settings_since(last_look - TOLERANCE)]
            assert min(abs(found - event - error) for error in errors if error >= 0) <= TOLERANCE
        looks.append(computer.now)


near = st.integers(-3, 3)
spans = st.one_of(
    near,
    st.builds(lambda times, off: times * TOLERANCE // 2 + off, st.integers(-3, 3), near),
    st.builds(lambda times, off: times * MEMORY // 8 + off, st.integers(-20, 20), near),
    st.integers(-(10**18), 10**18),
)


@given(steps=st.lists(st.tuples(spans.map(abs), spans, st.booleans(), spans, st.none() | spans), max_size=120))
def test_the_age_of_messages_while_the_wall_clock_jumps(
    library: ctypes.CDLL, steps: list[tuple[int, int, bool, int, int | None]]
) -> None:
    """The last of each step is how long before now the message was at most; None: only the clocks are looked at."""
    plain, native, now, ahead = oracle.Freshness(), Looked(library), 10**12, 10**18
    for passed, jump, jumps, age, known in steps:
        now = min(now + passed, 10**18)
        ahead = max(-(10**18), min(ahead + jump * jumps, 2 * 10**18))
        received_at = now + ahead
        if known is None:
            native.look(received_at, now)
            plain.look(received_at, now)
            continue
        for not_before in (None, now - known):
            event = received_at - age, received_at, now, not_before
            assert native.times(*event) == plain.times(*event)


@given(
    ages=st.lists(st.integers(1, 100).map(lambda ms: ms * 1_000_000), min_size=40, max_size=80),
    age=st.integers(0, 10**10),
)
def test_more_jumps_than_are_remembered(library: ctypes.CDLL, ages: list[int], age: int) -> None:
    plain, native, now = oracle.Freshness(), Looked(library), 10**12
    for number, passed in enumerate(ages):
        now += passed
        received_at = now + number * TOLERANCE
        for stamp in (received_at - passed, received_at - age, now):
            assert native.times(stamp, received_at, now) == plain.times(stamp, received_at, now)
