"""Checks routes against what exists: every name resolved, every mapping typed, all findings collected."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from router.compiler.checked import CheckedRoute, CheckedTarget
from router.compiler.definitions import Definitions
from router.compiler.expressions import Finding, Locals, Scope, Typed, check
from router.compiler.kinds import BoolKind
from router.compiler.mapping import build
from router.compiler.network import loop_finding
from router.compiler.target import Target
from router.compiler.topics import qos_findings, topic_name_finding
from router.errors import Code, Diagnostic, SourceSpan, TableError, did_you_mean, nearest
from router.table.model import ANY, ROS, Destination, Endpoint, EndpointKind, Expression, Route, RouteTable, Topic
from router.types.boards import board_findings
from router.types.model import List, MessageType, Type
from router.types.protobuf import Envelope, PayloadCase, ProtoSchema

_OF_GAPS = frozenset({Code.NO_TARGET, Code.NOTHING_MAPPED, Code.QOS_CONFLICT})
"""What a route may seem to do wrong because a part of it, which has a finding of its own, was left out."""


@dataclass(slots=True)
class RouteChecker:
    """Checks the routes of one table; `findings` fills up, with what several routes share once for each of them."""

    table: RouteTable
    schema: ProtoSchema
    envelope: Envelope
    definitions: Definitions
    board_limit: int
    findings: list[Diagnostic] = field(default_factory=list)

    def check_all(self) -> tuple[CheckedRoute, ...]:
        self._coverage()
        return tuple(checked for route in self.table.routes if (checked := self._checked(route)))

    def _checked(self, route: Route) -> CheckedRoute | None:
        before = len(self.findings)
        checked = self._route(route)
        if f"routes/{route.case.value}" in self.table.broken:
            mine = [finding for finding in self.findings[before:] if finding.code not in _OF_GAPS]
            self.findings[before:] = mine
        return checked

    def _report(self, span: SourceSpan, code: Code, message: str, hint: str = "") -> None:
        self.findings.append(Diagnostic(span, code, message, hint))

    def _coverage(self) -> None:
        names = [route.case.value for route in self.table.routes]
        # a misspelt case is one finding, not two
        covered = {name if name in self.envelope.cases else nearest(name, self.envelope.cases) for name in names}
        covered |= {name.removeprefix("routes/") for name in self.table.broken if name.startswith("routes/")}
        missing = [name for name in self.envelope.cases if name not in covered]
        if missing:
            cases = "payload case" if len(missing) == 1 else "payload cases"
            message = f"no route for the {cases} {', '.join(missing)}"
            self._report(
                self.table.routes_span, Code.UNCOVERED_PAYLOAD_CASE, message, "route it, or say `ignore: reason`"
            )

    def _route(self, route: Route) -> CheckedRoute | None:
        case = self.envelope.cases.get(route.case.value)
        if case is None:
            message = f"{self.envelope.name} has no payload case '{route.case.value}'"
            self._report(
                route.case.span, Code.UNKNOWN_PAYLOAD_CASE, message, did_you_mean(route.case.value, self.envelope.cases)
            )
            return None
        if route.ignore is not None:
            return CheckedRoute(route, case)
        self._sources(route)
        if not route.destinations and not route.topics:
            self._report(route.case.span, Code.NO_TARGET, f"'{route.case.value}' goes nowhere",
                         "name destinations or topics, or say `ignore: reason`")  # fmt: skip
        for topic in route.topics:
            found = (topic_name_finding(topic), *qos_findings(topic, publishes=not route.is_outbound))
            self.findings += [finding for finding in found if finding]
        targets = self._outbound(route, case) if route.is_outbound else self._inbound(route, case)
        return CheckedRoute(route, case, tuple(targets))

    def _sources(self, route: Route) -> None:
        for source in route.sources:
            if source.value not in (ANY, ROS):
                self._known_endpoint(source.value, source.span, (ANY, ROS))
            elif len(route.sources) > 1:
                self._report(
                    source.span, Code.BAD_VALUE, f"'{source.value}' stands alone", "name endpoints, or it, not both"
                )

    def _known_endpoint(self, name: str, span: SourceSpan, also: Iterable[str] = ()) -> bool:
        if name in self.table.endpoints:
            return True
        if f"endpoints/{name}" not in self.table.broken:
            known = [*self.table.endpoints, *also]
            used = [used for route in self.table.routes for used in route.endpoint_names]
            meant = self.table.endpoints.get(nearest(name, known) or "")
            if meant and meant.name not in used and used.count(name) > 1:  # its declaration is what is misspelt
                message = f"no route names the endpoint '{meant.name}', several name '{name}'"
                self._report(meant.span, Code.UNKNOWN_ENDPOINT, message, f"did you mean '{name}'?")
            else:
                self._report(span, Code.UNKNOWN_ENDPOINT, f"there is no endpoint '{name}'", did_you_mean(name, known))
        return False

    # UDP to ROS and UDP to UDP

    def _inbound(self, route: Route, case: PayloadCase) -> Iterable[CheckedTarget]:
        if route.fields is not None:
            self._report(route.fields.span, Code.UNKNOWN_KEY, "'fields' of a route belongs to `source: ros`",
                         "a topic has its own 'fields'")  # fmt: skip
        targets = [self._forward(route, case, destination) for destination in route.destinations]
        for topic in route.topics:
            ros_type = self._ros_type(topic)
            if ros_type is not None:
                targets.append(self._publish(topic, ros_type, self._scope(case.type, ros_type)))
        return targets

    def _forward(self, route: Route, case: PayloadCase, destination: Destination) -> CheckedTarget:
        endpoint = self._destination(route, case, destination)
        if destination.fields is not None:
            self._report(destination.fields.span, Code.UNKNOWN_KEY, "a datagram is forwarded unchanged",
                         "'fields' of a destination belongs to `source: ros`")  # fmt: skip
        scope = self._scope(case.type)
        when = self._when(destination.when, scope)
        trim = endpoint is not None and endpoint.trim_trailing_zeros
        name, rate = destination.endpoint.value, _rate(destination)
        return CheckedTarget(Target(name, destination.span, False, scope.locals, when, rate, trim=trim))

    def _publish(self, topic: Topic, ros_type: MessageType, scope: Scope) -> CheckedTarget:
        when = self._when(topic.when, scope)
        mapping = build(topic.fields, ros_type, scope, topic.topic.span)
        self.findings += mapping.findings
        target = Target(topic.topic.value, topic.span, True, scope.locals, when, _rate(topic), plan=mapping.plan)
        return CheckedTarget(target, topic, ros_type, tuple(mapping.rows))

    # ROS to UDP

    def _outbound(self, route: Route, case: PayloadCase) -> Iterable[CheckedTarget]:
        if not route.topics:
            self._report(route.case.span, Code.NO_TARGET, f"'{route.case.value}' comes from ROS, but from no topic",
                         "name it under 'topics'")  # fmt: skip
        if route.topics and not route.destinations:
            self._report(route.case.span, Code.NO_TARGET, f"'{route.case.value}' goes to no destination",
                         "name it under 'destinations'")  # fmt: skip
        for destination in route.destinations:
            self._destination(route, case, destination)
        targets: list[CheckedTarget] = []
        for topic in route.topics:
            if topic.fields is not None:
                message = "with `source: ros` the fields to fill are the payload's"
                self._report(topic.fields.span, Code.UNKNOWN_KEY, message, "move 'fields' up to the route")
            ros_type = self._ros_type(topic)
            if ros_type is not None:
                targets += [self._command(route, case, topic, ros_type, to) for to in route.destinations]
        return targets

    def _command(
        self, route: Route, case: PayloadCase, topic: Topic, ros_type: MessageType, destination: Destination
    ) -> CheckedTarget:
        scope = self._scope(ros_type, ros_type)
        self._when(topic.when, scope)
        when = self._when(destination.when, scope)
        mapping = build(destination.fields or route.fields, case.type, scope, route.case.span)
        self.findings += mapping.findings
        name, rate = destination.endpoint.value, _rate(destination)
        target = Target(name, destination.span, False, scope.locals, when, rate, plan=mapping.plan)
        return CheckedTarget(target, topic, ros_type, tuple(mapping.rows))

    # names

    def _destination(self, route: Route, case: PayloadCase, destination: Destination) -> Endpoint | None:
        """The endpoint that a destination names, None where there is none; what is wrong with it is reported."""
        name = destination.endpoint
        if not self._known_endpoint(name.value, name.span):
            return None
        twice = [other for other in route.destinations if other.endpoint.value == name.value]
        if twice[0] is not destination:
            self._report(name.span, Code.BAD_VALUE, f"'{name.value}' is a destination twice", "name it once")
        endpoint = self.table.endpoints[name.value]
        finding = loop_finding(self.table, route, destination, endpoint)
        if finding and finding.message not in {earlier.message for earlier in self.findings}:
            self.findings.append(finding)  # an endpoint that is the router itself is one mistake, not one per route
        if endpoint.kind is EndpointKind.BOARD:
            self.findings += board_findings(case, self.schema, self.board_limit, name.span)
        return endpoint

    def _ros_type(self, topic: Topic) -> MessageType | None:
        name = topic.type.value
        try:
            found = self.definitions.interfaces.get(name)
        except TableError as error:
            self.findings += error.diagnostics
            return None
        if found is None:
            hint = did_you_mean(name, self.definitions.interfaces.names())
            self._report(topic.type.span, Code.UNKNOWN_ROS_TYPE, f"there is no ROS message type '{name}'", hint)
        return found

    def _scope(self, message: MessageType, ros_type: MessageType | None = None) -> Scope:
        nested = tuple(nested_types(ros_type)) if ros_type else ()
        return Scope(message, tuple(self.schema.enums.values()), nested, Locals())

    def _when(self, expression: Expression | None, scope: Scope) -> Typed | None:
        if expression is None:
            return None
        try:
            typed = check(expression, scope)
            if not isinstance(typed.kind, BoolKind):
                hint = "compare something, as in fix_quality != GPSFixQuality.NO_FIX"
                raise Finding(typed.span, Code.TYPE_MISMATCH, f"'when' takes a bool, not {typed.kind}", hint)
        except Finding as finding:
            self.findings.append(finding.diagnostic)
            return None
        return typed


def _rate(limited: Destination | Topic) -> float | None:
    return limited.max_rate.value if limited.max_rate else None


def nested_types(declared: Type) -> Iterable[MessageType]:
    """A ROS message type and all types in it, each once."""
    found: dict[str, MessageType] = {}
    waiting: list[Type] = [declared]
    while waiting:
        current = waiting.pop()
        if isinstance(current, List):
            waiting.append(current.element)
        elif isinstance(current, MessageType) and current.name not in found:
            found[current.name] = current
            waiting += [member.type for member in current.fields]
    return found.values()


def sorted_findings(findings: Sequence[Diagnostic]) -> list[Diagnostic]:
    """Each once, in the order in which a person reads the files."""
    return sorted(dict.fromkeys(findings), key=lambda finding: (finding.span, finding.code.value, finding.message))
