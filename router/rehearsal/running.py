"""Runs a table test on a rehearsal of its table, step by step. What it finds is told by `table_tests_comparing`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from router.compiler.program import Program
from router.engine.wire import Wire
from router.errors import Diagnostic
from router.rehearsal.comparing import Comparison, Failure
from router.rehearsal.events import Event
from router.rehearsal.given import datagram, message
from router.rehearsal.matching import Moments
from router.rehearsal.model import GivenDatagram, Step, TableTest, TableTestFile
from router.rehearsal.places import Places
from router.rehearsal.rehearsal import START, Rehearsal
from router.rehearsal.words import Happened
from router.table.reading import InvalidValueError


@dataclass(slots=True)
class Result:
    """What came of one test. `findings` are what is wrong with the test itself and shows only when it runs."""

    test: TableTest
    failures: list[Failure] = field(default_factory=list)
    findings: list[Diagnostic] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return not self.failures and not self.findings


class Runner:
    """For the tests of one file. `program` is the one of its table, or the same with probes for the coverage.

    `told` hears after each step that was looked at what happened in it.
    """

    def __init__(self, file: TableTestFile, program: Program, told: Callable[[Happened], None]) -> None:
        self._program = program
        self._told = told
        self._wire = Wire(program.envelope)
        self._comparison = Comparison(self._wire, Places(file.checked), program.table)

    def run(self, test: TableTest) -> Result:
        result, rehearsal = Result(test), Rehearsal(self._program)
        for step in test.steps:
            try:
                happened = self._happened(step, rehearsal)
            except InvalidValueError as error:
                result.findings.append(error.diagnostic)
                return result
            self._told(happened)
            result.failures += self._comparison.failures(step, happened)
        return result

    def _happened(self, step: Step, rehearsal: Rehearsal) -> Happened:
        rehearsal.events.clear()
        begin = rehearsal.now if step.at is None else START + step.at
        rehearsal.advance(begin)
        given = self._give(step, rehearsal)
        if step.until is not None:
            rehearsal.advance(START + step.until)
        if step.stop:
            rehearsal.close()
        early: list[Event] = [event for event in rehearsal.events if event.at < begin]
        events = rehearsal.events[len(early) :]
        return Happened(step, START, early, events, given)

    def _give(self, step: Step, rehearsal: Rehearsal) -> list[tuple[int, bytes]]:
        """When what was given, as often as the step says."""
        if step.given is None:
            return []
        repetition, begin = step.given.repetition, rehearsal.now
        given: list[tuple[int, bytes]] = []
        for number in range(repetition.times):
            rehearsal.advance(begin + number * repetition.every)
            now = rehearsal.now
            moments = Moments(START, now)
            if isinstance(step.given, GivenDatagram):
                data = datagram(step.given, self._wire, moments)
                rehearsal.datagram(step.given.listener, step.given.peer, data, now - repetition.age)
            else:
                data = message(step.given, moments)
                rehearsal.ros(step.given.topic, data, now - repetition.age)
            given.append((now, data))
        return given
