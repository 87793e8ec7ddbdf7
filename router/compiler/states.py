"""Checks states: what sets them, and the conditions that read them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from router.compiler.checked import CheckedRoute, CheckedState, CheckedSubscription, Target
from router.compiler.expressions import Scope
from router.compiler.expressions.kinds import BoolKind, EnumKind, IntKind, Kind, StringKind
from router.compiler.expressions.states import operands_of, reads_message, states_in
from router.compiler.expressions.tree import Call, Node, constant_of, whole
from router.compiler.lookup import Lookup
from router.compiler.topics import qos_findings, resolved, stamp_of, topic_name_finding
from router.declared import MOST_STATE_TEXT
from router.errors import Code, Diagnostic
from router.table.model.routes import ANY, Route
from router.table.model.state import State
from router.table.model.targets import OnLimit, Topic
from router.types.model import MessageType, String

_KINDS = (BoolKind, EnumKind, IntKind, StringKind)
_NOTHING = MessageType("a state")
"""The source message of an initial value: a message without fields."""


def check_states(lookup: Lookup) -> Mapping[str, CheckedState]:
    """Check the states of the table, and make them known to conditions. Findings go to `lookup`."""
    lookup.states |= dict.fromkeys(name.removeprefix("state/") for name in lookup.table.broken if "state/" in name)
    checked = {}
    for name, declared in lookup.table.states.items():
        state = _checked(lookup, declared)
        lookup.states[name] = state.kind if state else None
        if state is not None:
            checked[name] = state
    return checked


def sets_state(states: Iterable[State], route: Route) -> Iterator[State]:
    """Yield the states that messages of a route from UDP set."""
    sources = {source.value for source in route.sources}
    for state in states:
        is_taken = any({source.value, ANY} & sources for source in state.sources)
        if is_taken and state.case is not None and state.case.value == route.case.value:
            yield state


def _checked(lookup: Lookup, declared: State) -> CheckedState | None:
    return _of_topic(lookup, declared, declared.topic) if declared.topic else _of_case(lookup, declared)


def _of_topic(lookup: Lookup, declared: State, topic: Topic) -> CheckedState | None:
    findings = (topic_name_finding(topic), *qos_findings(topic, publishes=False))
    lookup.findings += [finding for finding in findings if finding]
    ros_type = lookup.ros_type(topic)
    if ros_type is None:
        return None
    scope = lookup.scope(ros_type, ros_type)
    feed = CheckedSubscription(topic, ros_type, None, None, stamp_of(scope, topic.span), ())
    valued = _valued(lookup, declared, scope)
    return CheckedState(declared, *valued, feed=feed) if valued else None


def _of_case(lookup: Lookup, declared: State) -> CheckedState | None:
    assert declared.case is not None  # noqa: S101 - required without a topic
    case = lookup.case(declared.case)
    known = [lookup.endpoint(source) for source in declared.sources]
    if case is None:
        return None
    if all(known):
        _require_route(lookup, declared, case.name)
    valued = _valued(lookup, declared, lookup.received(case))
    return CheckedState(declared, *valued, case=case) if valued else None


def _valued(lookup: Lookup, declared: State, scope: Scope) -> tuple[Node, int | str] | None:
    """Return what computes the value from a message, and the initial value; None with a finding."""
    value = lookup.value(declared.value, scope, _KINDS, "a state takes an integer, a bool, an enum or a text")
    initial = _initial(lookup, declared, value.kind, scope) if value is not None else None
    if value is None or initial is None:
        return None
    if isinstance(value.kind, EnumKind):  # conditions would read a number that the enum lacks as "not MANUAL"
        value = Call(value.kind, value.span, "member", (value,))
    elif isinstance(value.kind, StringKind):
        value = Call(value.kind, value.span, "fit_text", (value, whole(MOST_STATE_TEXT, value.span)))
    return value, initial


def _require_route(lookup: Lookup, declared: State, case: str) -> None:
    """Report the first source from which no route takes the messages of a state."""
    if f"routes/{case}" in lookup.table.broken:
        return
    routes = [route for route in lookup.table.routes if route.ignore is None and not route.is_outbound]
    for source in declared.sources:
        only = replace(declared, sources=(source,))
        if not any(True for route in routes for _ in sets_state([only], route)):
            message = f"no route takes '{case}' from '{source.value}', so nothing sets 'state.{declared.name}'"
            is_taken = any(route.case.value == case for route in routes)
            hint = f"write a route, which needs no targets: `{case}: {{source: {source.value}}}`"
            hint = f"add '{source.value}' to the sources of a route of '{case}'" if is_taken else hint
            lookup.report(source.span, Code.NEVER_SET, message, hint)
            return


def _initial(lookup: Lookup, declared: State, kind: Kind, scope: Scope) -> int | str | None:
    """Return the initial value, None with a finding. `scope` is that of the value, whose constants are visible."""
    scope = replace(scope, message=_NOTHING, given=(), envelope=None)
    expected = kind.enum if isinstance(kind, EnumKind) else String() if isinstance(kind, StringKind) else None
    wanted = f"'initial' takes a value of 'state.{declared.name}', which is {kind}"
    node = lookup.value(declared.initial, scope, (type(kind),), wanted, expected=expected)
    if node is None:
        return None
    value = constant_of(node)
    if value is None:
        message = "'initial' takes a constant, and this is computed"
        lookup.report(node.span, Code.BAD_VALUE, message, "write the result")
        return None
    if isinstance(value, str):
        if (size := len(value.encode())) > MOST_STATE_TEXT:
            message = f"the text has {size} bytes; a state takes at most {MOST_STATE_TEXT}"
            lookup.report(node.span, Code.OUT_OF_RANGE, message, "shorten it")
            return None
        return value
    fits = not isinstance(kind, IntKind) or kind.low <= int(value) <= kind.high
    if not fits or (isinstance(kind, EnumKind) and node.kind != kind):
        lookup.report(node.span, Code.TYPE_MISMATCH, f"{wanted}, not {node.kind}")
        return None
    return int(value)


# conditions


def states_read(checked: CheckedRoute) -> set[str]:
    """Return the names of the states that the conditions of a route read."""
    return {name for _, conditions in _with_conditions(checked) for name in states_in(conditions)}


def condition_findings(lookup: Lookup, routes: Iterable[CheckedRoute]) -> Iterator[Diagnostic]:
    """Yield findings for conditions that read states, and for states that commands depend on."""
    states = lookup.table.states
    commanded: dict[str, str] = {}
    for checked in routes:
        own = {state.name for state in sets_state(states.values(), checked.route)}
        topics = {resolved(feed.topic.topic.value, lookup.table.node) for feed in checked.subscriptions}
        own |= {
            state.name
            for state in states.values()
            if state.topic is not None and resolved(state.topic.topic.value, lookup.table.node) in topics
        }
        for target, conditions in _with_conditions(checked):
            read = states_in(conditions)
            if target.is_command:
                commanded |= {name: target.label for name in read if name not in commanded}
            for condition in (each for each in conditions if each is not None):
                yield from _own_findings(condition, own)
                if target.is_deferred:
                    yield from _mixed_findings(target, condition)
    for name, label in commanded.items():
        yield from _validity_findings(states[name], label)


def _with_conditions(checked: CheckedRoute) -> Iterator[tuple[Target, tuple[Node | None, ...]]]:
    yield from ((target, (target.when,)) for target in checked.targets)
    for feed in checked.subscriptions:
        yield from ((target, (feed.when, target.when)) for target in feed.targets)


def _own_findings(condition: Node, own: Iterable[str]) -> Iterator[Diagnostic]:
    for name in own:
        if name in states_in([condition]):
            message = f"messages of this route set 'state.{name}': this may see the value before or after them"
            hint = "compare the field of the message that sets it"
            yield Diagnostic(condition.span, Code.BAD_VALUE, message, hint)


def _mixed_findings(target: Target, condition: Node) -> Iterator[Diagnostic]:
    waits_for = "`on_limit: latest`" if target.declared.on_limit is OnLimit.LATEST else "the endpoint's bandwidth"
    for operand in operands_of([condition]):
        if states_in([operand]) and reads_message(operand):
            message = f"a message that waits for {waits_for} is checked against states again, without its fields"
            hint = "join the part with states by `and`, as in `state.mode == MODE_AUTO and speed > 0`"
            yield Diagnostic(operand.span, Code.BAD_VALUE, message, hint)


def _validity_findings(state: State, label: str) -> Iterator[Diagnostic]:
    """Yield a finding for a state that commands to `label` depend on, if it may be of any age."""
    message = f"commands to '{label}' depend on 'state.{state.name}', which keeps its value when messages stop"
    if state.valid_for is None:
        hint = "add `valid_for: 5s`, or `valid_for: never` with `because: why`"
        yield Diagnostic(state.span, Code.MISSING_KEY, message, hint)
    elif not state.valid_for.value and state.because is None:
        hint = "write a time, such as `valid_for: 5s`, or add `because: why`"
        yield Diagnostic(state.valid_for.span, Code.MISSING_KEY, message, hint)
