"""What a process can take: its highest rate without loss, and what it still does when too much comes. Knows no aims."""

from __future__ import annotations

import time
from collections.abc import Sequence

from benchmarks.versus.contenders import payload_cases
from benchmarks.versus.helpers import KEEPS_UP, Topic, load, sink
from benchmarks.versus.runs import warm_up
from benchmarks.versus.subject import Subject
from benchmarks.versus.subscriber import Subscriber, subscribed
from benchmarks.versus.trial import Metrics, Pace, Trial

FIRST_RATE = 10_000
BURST = 8
SEARCH_SECONDS, CONFIRM_SECONDS = 1, 10
LOOK_EVERY = 0.1
"""Seconds between looks at what the kernel dropped: a run that lost something need not go on."""

OVERLOAD_RATE, OVERLOAD_BURST = 250_000, 64
OVERLOAD_SECONDS = 4
FILLING = 1
"""Seconds of an overload in which buffers become full, and which do not count."""


class Search:
    """Looks for the highest rate at which nothing is lost. One hiccup of the machine is no limit: two runs are."""

    def __init__(self, subject: Subject, pace: Pace, listening: Subscriber | None) -> None:
        self._subject = subject
        self._pace = pace
        self._listening = listening
        self.generator_gave_up = False
        self.only_ros_lost = False

    def survives(self, rate: float, seconds: float) -> float:
        """The rate that the subject took without loss, about the one that is asked for; 0 if it lost something."""
        subject, drops = self._subject, self._subject.kernel_drops()
        with sink(*subject.destinations()) as receiver:
            if self._listening:
                self._listening.heard()  # what came before is no part of this run
            with load(subject.ports.listen[:1], rate, min(seconds, self._pace.longest), BURST) as generator:
                while generator.is_running():
                    time.sleep(LOOK_EVERY)
                    if subject.kernel_drops() > drops:
                        return 0
                sent = generator.result()
            time.sleep(0.1)
            arrived = sum(port["datagrams"] for port in receiver.stop()["ports"])
        if sent["rate"] < KEEPS_UP * rate:
            self.generator_gave_up = True
            return 0
        if arrived != sent["sent"] * subject.contender.copies:
            return 0
        if self._is_unheard(sent["sent"]):
            self.only_ros_lost = True
            return 0
        return float(sent["rate"])

    def _is_unheard(self, sent: int) -> bool:
        """Whether the subscriber lacks any of what so many datagrams should have become."""
        if not self._listening:
            return False
        expected = self._listening.expected(sent, payload_cases(self._subject.contender.payloads))
        return self._listening.heard().received < expected

    def passes(self, rate: float, seconds: float) -> float:
        return self.survives(rate, seconds) or self.survives(rate, seconds)

    def highest(self) -> float:
        """By doubling and bisection in short runs, then confirmed by a long one; 0 if even FIRST_RATE is too much."""
        low, high = 0.0, float(FIRST_RATE)
        while self.passes(high, SEARCH_SECONDS):
            low, high = high, high * 2
        while low and high / low > self._pace.step:
            middle = (low * high) ** 0.5
            low, high = (middle, high) if self.passes(middle, SEARCH_SECONDS) else (low, middle)
        while low >= FIRST_RATE:
            if confirmed := self.passes(low, CONFIRM_SECONDS):
                return confirmed
            low /= self._pace.step
        return 0


def highest_rate(trial: Trial, topics: Sequence[Topic]) -> Metrics:
    """`max_rate` in datagrams per second; `generator_gave_up` is 1 where a faster generator might have found more.

    `only_ros_lost` is 1 where some run was too much for the way to the subscriber alone.
    """
    with trial.started() as subject, subscribed(topics) as listening:
        warm_up(subject, trial.pace)
        search = Search(subject, trial.pace, listening)
        return subject.conditions() | {
            "max_rate": round(search.highest()),
            "generator_gave_up": search.generator_gave_up,
            "only_ros_lost": search.only_ros_lost,
        }


def overload(trial: Trial, topics: Sequence[Topic]) -> Metrics:
    """Datagrams per second: `offered@alone` and `processed@alone`, and the same with a subscriber, `*@subscribed`.

    `ros_share@subscribed` is how much of what was processed, and is of these topics, the subscriber got.
    """
    metrics: Metrics = {}
    with trial.started() as subject:
        warm_up(subject, trial.pace)
        for condition, wanted in (("alone", ()), ("subscribed", topics)):
            with subscribed(wanted) as listening:
                found = _overloaded(subject, trial.pace, listening)
                metrics |= {f"{name}@{condition}": value for name, value in found.items()}
    return metrics


def _overloaded(subject: Subject, pace: Pace, listening: Subscriber | None) -> Metrics:
    """Counted where they arrive, between two moments at which the subject's buffer is full.

    `lost` are those for which the sink had no room: the subject is not to blame, but was not counted right.
    `not_overloaded` is 1 where the kernel had room for all that was offered meanwhile.
    """
    seconds = min(OVERLOAD_SECONDS, pace.longest)
    with (
        sink(*subject.destinations()) as receiver,
        load(subject.ports.listen[:1], OVERLOAD_RATE, seconds + FILLING + 0.5, OVERLOAD_BURST) as generator,
    ):
        time.sleep(FILLING)
        before = receiver.ask()
        drops = subject.kernel_drops()
        if listening:
            listening.heard()  # what came before does not count
        time.sleep(seconds)
        not_overloaded = subject.kernel_drops() == drops
        after = receiver.ask()
        heard = listening.heard().received if listening else 0
        sent = generator.result()
        dropped = sum(port["drops"] for port in receiver.stop()["ports"])
    processed = after["datagrams"] - before["datagrams"]
    rate = processed * 1e9 / (after["at_ns"] - before["at_ns"])
    metrics: Metrics = {
        "processed": round(rate),
        "offered": round(sent["rate"]),
        "lost": dropped,
        "not_overloaded": not_overloaded,
    }
    if listening and (expected := listening.expected(processed, payload_cases(subject.contender.payloads))):
        metrics["ros_share"] = round(heard / expected, 4)
    return metrics
