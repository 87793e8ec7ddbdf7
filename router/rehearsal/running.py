"""Runs table tests, each on a stage for its table, step by step."""

from __future__ import annotations

from dataclasses import dataclass, field

from router.compiler.compiled_table import CompiledTable
from router.datagrams import Wire, framed
from router.errors import Code, Diagnostic, UsageError
from router.rehearsal import cdr
from router.rehearsal.comparing import Comparison, Failure, Outcome
from router.rehearsal.coverage import Coverage
from router.rehearsal.fields import protobuf_message, ros_values
from router.rehearsal.reading import TableTest, TestFile
from router.rehearsal.rehearsal import START
from router.rehearsal.stage import Stage
from router.rehearsal.steps import Given, Step
from router.table.reading import InvalidValueError


@dataclass(frozen=True, slots=True)
class FailedStep:
    """`events` describe what happened in it, in order; empty if only contents differ."""

    failures: list[Failure]
    events: list[str]


@dataclass(slots=True)
class Result:
    """The result of one test. `findings` are mistakes in the test that only show when it runs."""

    test: TableTest
    failed: list[FailedStep] = field(default_factory=list)
    findings: list[Diagnostic] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return not self.failed and not self.findings

    @property
    def failures(self) -> list[Failure]:
        return [failure for step in self.failed for failure in step.failures]


def run_tests(file: TestFile, only: str = "", coverage: Coverage | None = None) -> list[Result]:
    """Run the tests of a file whose name contains `only`, and record what they touch in `coverage`."""
    comparison, stage = Comparison(file.checked, file.program), Stage(file.program)
    return [_run(test, file.program, stage, comparison, coverage) for test in file.tests if only in test.name]


def _run(
    test: TableTest, program: CompiledTable, stage: Stage, comparison: Comparison, coverage: Coverage | None
) -> Result:
    result = Result(test)
    stage.restart()
    for step in test.steps:
        try:
            outcome = _run_step(step, stage, program)
        except InvalidValueError as error:
            result.findings.append(error.diagnostic)
            return result
        if coverage is not None:
            coverage.record(outcome)
        if failures := list(comparison.failures(outcome)):
            is_of_fields = all(failure.is_of_field for failure in failures)
            happened = () if is_of_fields else (*outcome.early, *outcome.events)
            result.failed.append(FailedStep(failures, comparison.describer.lines(happened)))
    return result


def _run_step(step: Step, stage: Stage, program: CompiledTable) -> Outcome:
    stage.events.clear()
    begin = stage.now if step.at is None else START + step.at
    stage.advance(begin)
    given = _give(step.given, stage, Wire(program.envelopes)) if step.given else []
    if step.until is not None:
        stage.advance(START + step.until)
    if step.stop:
        stage.close()
    early = [event for event in stage.events if event.at < begin]
    return Outcome(step, early, stage.events[len(early) :], given, dict(stage.states))


def _give(given: Given, stage: Stage, wire: Wire) -> list[tuple[int, bytes]]:
    """Give a step's message to the stage. Return the times and bytes of what was given."""
    arrived: list[tuple[int, bytes]] = []
    begin = stage.now
    for number in range(given.times):
        stage.advance(begin + number * given.every)
        now = stage.now
        if given.topic is not None:
            data = _message(given, now)
            stage.ros(given.topic, data, now - given.age)
        elif given.call is not None:
            data = _message(given, now)
            stage.call(given.call, data, now - given.age)
        elif given.answer is not None:
            data = _message(given, now)
            stage.respond(given.answer, data)
        else:
            data = _datagram(given, wire, now)
            stage.datagram(given.listener, given.peer, data, now - given.age)
        arrived.append((now, data))
    return arrived


def _datagram(given: Given, wire: Wire, now: int) -> bytes:
    """Return the bytes that arrive.

    Raises InvalidValueError if they are longer than `pad`, or if the payload lacks a required field.
    """
    data = given.data or b""
    try:
        if given.payloads:
            payloads = [(case, protobuf_message(case.message_class, fields, now)) for case, fields in given.payloads]
            around = wire.envelopes.of(given.payloads[0][0].name).message_class
            beside = protobuf_message(around, given.beside, now) if given.beside is not None else None
            data = wire.encode_all(payloads, beside)
        return framed(data, given.trim, given.pad)
    except UsageError as error:
        raise InvalidValueError(given.span, Code.BAD_VALUE, str(error)) from error


def _message(given: Given, now: int) -> bytes:
    """Return the CDR bytes that arrive."""
    if given.fields is None:
        return given.data or b""
    return cdr.serialize(given.fields.type, ros_values(given.fields, now))
