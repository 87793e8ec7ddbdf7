"""The oracle of a whole table, composed of the other oracles: the messages that targets get and lose.

Implements the rules of docs/reference/table.md and docs/design/reload.md. Of timers that are due at the same time, the
one added last is served first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

from router.compiler.compiled_table import DeadmanPlan
from tests.oracles.ages_and_rates import Freshness, RateLimit
from tests.oracles.deadman import Deadman, Deadmen
from tests.oracles.frames import COLLECTED, FILTERED, INCOMPLETE, MAPPING_ERROR, Frames, Part
from tests.oracles.held_back import Deferral, Message, Pacer

Key = Any
COMMAND, TELEMETRY, BULK = range(3)


class Happened(NamedTuple):
    """`what` is sent, braked, published, filtered, collected or the reason of a drop; `data` is the sent message."""

    at: int
    route: str
    target: str
    what: str
    data: bytes = b""


@dataclass(frozen=True)
class Target:
    """A target of a route; `only_positive` is a condition on the number in messages."""

    route: str
    label: str
    is_topic: bool = False
    is_board: bool = False
    rank: int = TELEMETRY
    hertz: int | None = None
    is_latest: bool = False
    only_positive: bool = False
    feeds: tuple[str, ...] = ()
    """The routes whose deadmen its messages feed, or disarm if the deadman is another route's."""

    @property
    def place(self) -> tuple[str, str]:
        return self.route, self.label


@dataclass(frozen=True)
class Table:
    """`targets` are in the order of the table. `ttl`, `timeouts` of `collect` and deadmen are by route, in ns.

    `sources` are by route, in the order of the endpoints: None for strangers, and for all publishers of a topic.
    """

    targets: tuple[Target, ...]
    sources: Mapping[str, tuple[str | None, ...]]
    ttl: Mapping[str, int]
    bandwidths: Mapping[str, int]
    timeouts: Mapping[str, int]
    deadmen: Mapping[str, DeadmanPlan]

    def of(self, route: str) -> list[Target]:
        """Destinations come first."""
        return sorted((each for each in self.targets if each.route == route), key=lambda each: each.is_topic)


class Timer(Protocol):
    @property
    def next_due(self) -> int | None: ...

    def serve(self, now: int) -> None: ...


class Timers:
    """The timers of one thread, the one added last first."""

    def __init__(self) -> None:
        self.listed: list[Timer] = []

    def add(self, timer: Timer) -> None:
        if timer not in self.listed:
            self.listed.insert(0, timer)

    @property
    def next_due(self) -> int | None:
        return min((each.next_due for each in self.listed if each.next_due is not None), default=None)

    def serve(self, now: int) -> None:
        for each in [*self.listed]:
            if each.next_due is not None and each.next_due <= now:
                each.serve(now)


@dataclass(eq=False)
class _DeadmanTimer:
    deadmen: Deadmen
    deadman: Deadman
    tell: Callable[[str, bool], None]

    @property
    def next_due(self) -> int | None:
        return self.deadman.due

    def serve(self, now: int) -> None:
        assert self.deadman.due is not None
        self.deadmen.serve_one(self.deadman, self.deadman.due, now)
        self.tell(self.deadman.plan.route, True)

    def end(self, now: int) -> None:
        del now
        self.deadmen.end(self.deadman)
        self.tell(self.deadman.plan.route, True)


@dataclass(eq=False)
class _FramesTimer:
    frames: Frames
    tell: Callable[[Frames], None]

    @property
    def next_due(self) -> int | None:
        return self.frames.next_due

    def serve(self, now: int) -> None:
        self.frames.tick(now)
        self.tell(self.frames)

    def end(self, now: int) -> None:
        self.frames.end(now)
        self.tell(self.frames)


class Model:
    """A running table. `happened` has events in order, `changes` those of deadmen: route, and whether tripped."""

    def __init__(self, table: Table, start: int) -> None:
        self.now, self.ahead = start, 0
        self.happened: list[Happened] = []
        self.changes: list[tuple[int, str, bool]] = []
        self.table = table
        self._of_datagrams, self._of_ros = Freshness(), Freshness()
        self._deadmen = Deadmen()
        self._destinations, self._topics = Timers(), Timers()
        self._messages: list[tuple[Target, bytes]] = []
        self._kept: dict[Key, Any] = {}
        self._deadman_timers: dict[str, _DeadmanTimer] = {}
        self.reload(table)

    # messages

    def datagram(
        self, route: str, source: str | None, data: bytes, number: int, arrived: int, topics: Mapping[str, bytes]
    ) -> None:
        """Serve a datagram; `topics` are the messages that topics get."""
        times = self._of_datagrams.times(arrived, self.now + self.ahead, self.now)
        for target in self.table.of(route):
            oldest = times.oldest if target.is_board else times.youngest
            self._deliver(target, source, topics[target.label] if target.is_topic else data, number, oldest)

    def part(self, route: str, part: Part, arrived: int) -> None:
        """Serve a datagram of a route with `collect`, one source and one topic, which gets the payloads."""
        times = self._of_datagrams.times(arrived, self.now + self.ahead, self.now)
        (target,), (source,) = self.table.of(route), self.table.sources[route]
        timer: _FramesTimer = self._kept[_frames_key(self.table, route)]
        made = timer.frames.offer(self.now, part)
        timer.tell(timer.frames)
        if made is not None:
            self._deliver(target, source, b"|".join(made), 0, times.youngest)

    def ros(self, route: str, data: bytes, number: int, sent: int) -> None:
        times = self._of_ros.times(sent, self.now + self.ahead, self.now)
        for target in self.table.of(route):
            self._deliver(target, None, data, number, times.oldest if target.is_board else times.youngest)

    def _deliver(self, target: Target, source: str | None, data: bytes, number: int, event: int) -> None:
        ttl = self.table.ttl.get(target.route)
        expires = None if ttl is None else event + ttl
        self._messages.append((target, data))
        message = Message(len(self._messages) - 1, (target.place, source), len(data), expires, target.rank, self.now)
        limit: RateLimit | None = self._kept.get(_limit_key(self.table, target, source))
        deferral: Deferral | None = self._kept.get(_deferral_key(self.table, target, source))
        if target.only_positive and number <= 0:
            self._tell(target, "filtered")
        elif message.is_stale(self.now):
            self._tell(target, "stale")
        elif limit is not None and not limit.may_pass(self.now):
            self._tell(target, "rate_limited")
        elif deferral is not None:
            deferral.offer(self.now, message)
        else:
            self._fate(self.now, message, "sent")

    def _fate(self, now: int, message: Message, fate: str) -> None:
        assert now == self.now
        target, data = self._messages[message.number]
        if fate != "sent":
            self._tell(target, fate)
        elif target.is_topic:
            self._tell(target, "published", data)
        elif not target.feeds:
            self._tell(target, "sent", data)
        else:
            for name in target.feeds:
                if name != target.route:
                    self._supersede(name, target.label, message.arrived)
            feeds = [(self._deadman_timers[name].deadman, name != target.route) for name in target.feeds]
            self._deadmen.command(now, feeds, target.label, data)
            self._tell_deadmen(target.route, False)

    def _supersede(self, route: str, label: str, before: int) -> None:
        """Drop older commands of a route to an endpoint, which would leave after this one."""
        for key, kept in self._kept.items():
            if isinstance(kept, Deferral) and key[1][0] == (route, label):
                kept.supersede(self.now, before, key[1])

    def _tell(self, target: Target, what: str, data: bytes = b"") -> None:
        self.happened.append(Happened(self.now, *target.place, what, data))

    def _tell_deadmen(self, route: str, by_deadman: bool) -> None:
        what = "braked" if by_deadman else "sent"
        self.happened += [Happened(self.now, route, label, what, data) for label, data in self._deadmen.sent]
        self.changes += [(self.now, name, what == "tripped") for what, name, _, _ in self._deadmen.events]
        self._deadmen.sent.clear()
        self._deadmen.events.clear()

    def _tell_frames(self, target: Target, frames: Frames) -> None:
        """Report losses, which made room for the part counted last."""
        for what in (MAPPING_ERROR, INCOMPLETE, FILTERED, COLLECTED):
            self.happened += [Happened(self.now, *target.place, what)] * frames.counted[what]
        frames.counted.clear()

    # time

    def advance(self, to: int) -> None:
        groups = self._topics, self._destinations
        while (due := min((each.next_due for each in groups if each.next_due is not None), default=to + 1)) <= to:
            self.now = max(self.now, due)
            for each in groups:
                each.serve(self.now)
        self.now = to

    def close(self) -> None:
        for group in (self._topics, self._destinations):
            timers = [*reversed(group.listed)]
            for each in timers:
                if not isinstance(each, _DeadmanTimer):
                    self._end(each)
                    group.listed.remove(each)
            for left in [*group.listed]:
                self._end(left)

    # reloads

    def reload(self, table: Table) -> None:
        """Reload, keeping state with the same key. Messages without a place in the next table leave first."""
        kept: dict[Key, Any] = {}
        for key, make in self._state_of(table, kept):
            kept[key] = self._kept[key] if key in self._kept else make()
        replaced = self._replace_deadmen(table)
        for group, is_topic in ((self._destinations, False), (self._topics, True)):
            left = [each for key, each in self._kept.items() if key not in kept]
            for each in [*left, *([] if is_topic else replaced)]:
                if each in group.listed:
                    self._end(each)
                    group.listed.remove(each)
            for key, each in kept.items():
                if _is_of_topic(key) is is_topic:
                    self._change(table, key, each, group)
        self._kept, self.table = kept, table

    def _state_of(self, table: Table, kept: Mapping[Key, Any]) -> Iterator[tuple[Key, Callable[[], Any]]]:
        """The keys of a table's state with functions that create it, in the order in which timers are added."""
        for endpoint, bandwidth in table.bandwidths.items():
            yield ("pacer", endpoint, bandwidth), partial(Pacer, bandwidth, self._fate)
        for target in table.targets:
            for source in table.sources[target.route]:
                if key := _deferral_key(table, target, source):
                    yield key, partial(Deferral, None, kept.get(_pacer_key(table, target)), self._fate)
                if target.hertz is not None and (key := _limit_key(table, target, source)):
                    yield key, partial(RateLimit, target.hertz)
            if key := _frames_key(table, target.route):
                frames = Frames(table.timeouts[target.route])
                yield key, partial(_FramesTimer, frames, partial(self._tell_frames, target))

    def _change(self, table: Table, key: Key, kept: Any, group: Timers) -> None:
        if isinstance(kept, Deferral):
            place, source = key[1]
            (target,) = [each for each in table.targets if each.place == place]
            assert _deferral_key(table, target, source) == key
            kept.change(self.now, target.hertz if target.is_latest else None)
            if kept.held is not None:
                kept.held = replace(kept.held, rank=target.rank)
        if not isinstance(kept, RateLimit):
            group.add(kept)

    def _replace_deadmen(self, table: Table) -> list[Timer]:
        """Replace the deadmen, and return those that end."""
        ended: list[Timer] = []
        for route, plan in table.deadmen.items():
            earlier = self._deadman_timers.get(route)
            if earlier is not None and earlier.deadman.plan == plan:
                continue
            made = self._deadmen.add(plan)
            self._deadman_timers[route] = timer = _DeadmanTimer(self._deadmen, made, self._tell_deadmen)
            self._destinations.add(timer)
            if earlier is not None:
                self._deadmen.replace(made, earlier.deadman)
                self._tell_deadmen(route, True)
                ended.append(earlier)
        return ended

    def _end(self, timer: Any) -> None:
        timer.end(self.now)
        if isinstance(timer, Deferral) and timer.pacer is not None:
            (whose,) = {key[1] for key, each in self._kept.items() if each is timer}
            timer.pacer.release(self.now, lambda message: message.target == whose)


def _pacer_key(table: Table, target: Target) -> Key:
    bandwidth = None if target.is_topic else table.bandwidths.get(target.label)
    return None if bandwidth is None else ("pacer", target.label, bandwidth)


def _deferral_key(table: Table, target: Target, source: str | None) -> Key:
    """What waits comes from the same source, and goes to the same endpoint, by the same pacer."""
    pacer = _pacer_key(table, target)
    return ("deferral", (target.place, source), target.is_topic, pacer) if pacer or target.is_latest else None


def _limit_key(table: Table, target: Target, source: str | None) -> Key:
    """Each source has its own. Whatever is changed of a target but its condition, its limits begin anew."""
    if target.hertz is None or target.is_latest:
        return None
    return "limit", source, replace(target, only_positive=False), _pacer_key(table, target) is not None


def _frames_key(table: Table, route: str) -> Key:
    """Likewise the frames of a route."""
    if route not in table.timeouts:
        return None
    return "frames", route, table.timeouts[route], tuple(replace(each, only_positive=False) for each in table.of(route))


def _is_of_topic(key: Any) -> bool:
    return bool(key[0] == "frames" or (key[0] == "deferral" and key[2]))
